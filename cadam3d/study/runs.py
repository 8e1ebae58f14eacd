"""Runs: find the arms of a study and the pairs of runs that raters compare.

An *arm* is what is compared, such as a densifier. Two runs of different arms are a pair if they have the same
prompt and agree in everything else that varies, such as the seed or the objective.
"""

from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Hashable, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from random import Random
from typing import Any

from cadam3d.core.checks import fail
from cadam3d.core.errors import UserError
from cadam3d.io.caption import plain
from cadam3d.io.records import read_summary
from cadam3d.io.run_folder import ASSET, CONFIG, has_file, shown, typed_path
from cadam3d.report.results import PROMPT, SEED, read
from cadam3d.sweep.folder import is_sweep


@dataclass(frozen=True)
class StudyRun:
    """A finished run as one arm of a study."""

    folder: Path
    arm: str
    prompt: str
    seed: int
    # The settings besides prompt and seed in which runs of an arm differ.
    conditions: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class RunPair:
    """Two runs of different arms that a rater compares."""

    runs: tuple[StudyRun, StudyRun]  # in the order of the names of their arms

    @property
    def prompt(self) -> str:
        """Return the prompt of both runs."""
        return self.runs[0].prompt

    @property
    def arms(self) -> tuple[str, str]:
        """Return the names of both arms, in alphabetical order."""
        return self.runs[0].arm, self.runs[1].arm


def find_runs(places: Sequence[str], labels: Sequence[str] | None) -> list[StudyRun]:
    """Return the runs with an asset of all arms that ``runs=`` names.

    A single place is the folder of a sweep, and its arms are its report's arms. Of several places, each is
    an arm: a run, a sweep, or a folder with runs in it. ``labels`` are the names of these arms, by default
    those of the folders. Raises ``UserError`` if a place is not one of these, or if names are missing.
    """
    folders = [typed_path(place) for place in places]
    if len(folders) == 1 and is_sweep(folders[0]) and labels is None:
        return _arms_of_sweep(folders[0])
    if len(folders) < 2:
        raise fail("runs", expected="the folder of a sweep, or a list with a folder for each arm", got=places)
    names = [plain(name) for name in labels or [folder.name for folder in folders]]
    if len(set(names)) != len(names) or len(names) != len(folders):
        raise fail("labels", expected=f"{len(folders)} different names, one for each arm", got=names)
    return [
        StudyRun(run, name, str(summary["prompt"]), int(summary["seed"]))
        for name, folder in zip(names, folders, strict=True)
        for run, summary in _summaries(folder).items()
        if has_file(run, ASSET)
    ]


def select(
    found: Sequence[StudyRun], arms: Collection[str] | None, prompts: Collection[str] | None
) -> list[StudyRun]:
    """Return the runs of some arms and prompts; None stands for all.

    Raises ``UserError`` if an arm has no run, or if none of the prompts has one.
    """
    known = {run.arm for run in found}
    wanted = known if arms is None else set(arms)
    if len(wanted) < 2 or not wanted <= known:
        expected = f"at least two of those with assets ({', '.join(sorted(known))})"
        raise fail("arms", expected=expected, got=sorted(wanted))
    runs = [run for run in found if run.arm in wanted and (prompts is None or run.prompt in prompts)]
    if not runs:
        raise fail("prompts", expected=f"prompts of the runs, such as {found[0].prompt!r}", got=prompts)
    return runs


def pair_runs(runs: Sequence[StudyRun], *, same_seed: bool) -> list[RunPair]:
    """Return every pair of runs of different arms with the same prompt, conditions and seed.

    Without ``same_seed``, the runs of a prompt are paired in the order of their seeds: the first run of an
    arm with the first run of another one. Raises ``UserError`` if an arm has two runs that could be in one
    pair, or if there is no pair.
    """
    groups: dict[tuple, dict[str, list[StudyRun]]] = defaultdict(lambda: defaultdict(list))
    for run in sorted(runs, key=lambda run: (run.prompt, run.conditions, run.seed, run.arm)):
        same = groups[run.prompt, run.conditions, run.seed if same_seed else None][run.arm]
        if same_seed and same:
            both = [str(shown(each.folder)) for each in (same[0], run)]
            raise fail("runs", expected="one run of each prompt and seed in an arm", got=both)
        same.append(run)
    pairs = []
    for arms in groups.values():
        for one, other in combinations(sorted(arms), 2):
            # An arm may have more runs of a prompt than another one; the rest has no partner.
            pairs += [RunPair(both) for both in zip(arms[one], arms[other], strict=False)]
    if not pairs:
        raise UserError(
            "runs: expected runs of different arms with the same prompt and seed, got none. "
            "Try: same_seed=false"
        )
    return pairs


def draw_pairs(pairs: Sequence[RunPair], most: int | None, generator: Random) -> list[RunPair]:
    """Return at most ``most`` pairs, drawn so that every two arms meet equally often; None stands for all.

    Prompts repeat only after each of them has been drawn for these two arms.
    """
    if most is None or most >= len(pairs):
        return list(pairs)
    drawn = generator.sample(list(pairs), len(pairs))
    prompts_first = _spread(drawn, lambda pair: (pair.arms, pair.prompt))
    chosen = set(_spread(prompts_first, lambda pair: pair.arms)[:most])
    return [pair for pair in pairs if pair in chosen]


def _spread(pairs: Sequence[RunPair], kind: Callable[[RunPair], Hashable]) -> list[RunPair]:
    """Return the pairs with the first one of every kind in front, then the second ones, and so on."""
    seen = Counter()
    turns = []
    for pair in pairs:
        turns.append(seen[kind(pair)])
        seen[kind(pair)] += 1
    return [pair for _, pair in sorted(zip(turns, pairs, strict=True), key=lambda item: item[0])]


def _arms_of_sweep(folder: Path) -> list[StudyRun]:
    """Return the jobs of a sweep with an asset, with the arms and the conditions of its report."""
    summaries = _summaries(folder)
    runs = []
    for job in read(folder):
        if job.folder in summaries and has_file(job.folder, ASSET):
            facts, axes = summaries[job.folder], job.cell.without(PROMPT, SEED).axes
            runs.append(StudyRun(job.folder, plain(job.setting.name), facts["prompt"], facts["seed"], axes))
    return runs


def _summaries(folder: Path) -> dict[Path, dict[str, Any]]:
    """Return the summaries of the finished runs in a place. Raises ``UserError`` if there are none."""
    if is_sweep(folder):
        folders = [job.folder for job in read(folder)]
    elif has_file(folder, CONFIG):
        folders = [folder]
    else:
        folders = sorted(config.parent for config in folder.glob(f"*/{CONFIG}"))
    summaries = {each: read_summary(each) for each in folders}
    found = {each: facts for each, facts in summaries.items() if {"prompt", "seed"} <= facts.keys()}
    if not found:
        raise fail("runs", expected="folders of finished runs", got=str(shown(folder)))
    return found
