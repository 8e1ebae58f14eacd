"""Runs: find the arms of a study and the pairs of runs that raters compare.

An *arm* is what is compared, such as a densifier. Two runs of different arms are a pair if they have the same
prompt and agree in everything else that varies, such as the seed or the objective.
"""

from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, combinations, pairwise
from pathlib import Path
from random import Random
from typing import Any

from cadam3d.core.checks import fail
from cadam3d.core.errors import UserError
from cadam3d.io.caption import plain
from cadam3d.io.records import read_summary
from cadam3d.io.run_folder import ASSET, CONFIG, has_file, setting_word, shown, typed_path
from cadam3d.report.results import PROMPT, SEED, read
from cadam3d.sweep.folder import is_sweep

MOST_ARMS = 12
LONGEST_LABEL = 80  # characters


@dataclass(frozen=True)
class StudyRun:
    """A finished run as one arm of a study."""

    folder: Path
    arm: str
    prompt: str
    seed: int
    conditions: tuple[
        tuple[str, str], ...
    ] = ()  # keys besides prompt and seed in which runs of an arm differ


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


@dataclass(frozen=True)
class Found:
    """The runs that a line names and that left an asset, and the number of those that left none."""

    runs: list[StudyRun]
    without_asset: int


def find_runs(places: Sequence[str], labels: Sequence[str] | None) -> Found:
    """Return the runs of all arms that ``runs=`` names.

    A single place is the folder of a sweep, and its arms are those of its report. Of several places, each is
    an arm: a run, a sweep, or a folder with runs in it. ``labels`` are the names of these arms, by default
    their densifiers if these differ, else the names of the folders. Raises ``UserError`` if a place is not
    one of these, or if there are fewer than two arms.
    """
    folders = [typed_path(place) for place in places]
    if len(folders) == 1 and is_sweep(folders[0]):
        if labels is not None:
            raise UserError(
                "labels: expected null for a sweep, because its arms have names already. Try: labels=null"
            )
        return _arms_of_sweep(folders[0])
    if not 2 <= len(set(folders)) == len(folders) <= MOST_ARMS:
        raise UserError(
            f"runs: expected the folder of a sweep, or a list of 2 to {MOST_ARMS} different folders, each of "
            f"which is an arm, got {', '.join(str(shown(each)) for each in folders)}. "
            "Try: cadam3d study --help"
        )
    results = [_results(place, folder) for place, folder in zip(places, folders, strict=True)]
    names = _default_labels(folders, results) if labels is None else [plain(label) for label in labels]
    are_names = all(0 < len(name) <= LONGEST_LABEL for name in names)
    if len(set(names)) != len(folders) or len(names) != len(folders) or not are_names:
        raise fail(
            "labels",
            expected=f"{len(folders)} different texts of 1 to {LONGEST_LABEL} characters, one for each arm",
            got=names,
        )
    runs = [
        StudyRun(folder, name, str(summary["prompt"]), int(summary["seed"]))
        for name, summaries in zip(names, results, strict=True)
        for folder, summary in summaries.items()
        if has_file(folder, ASSET)
    ]
    return Found(runs, sum(map(len, results)) - len(runs))


def select(
    found: Sequence[StudyRun], arms: Collection[str] | None, prompts: Collection[str] | None
) -> list[StudyRun]:
    """Return the runs of some arms and prompts; None stands for all.

    Raises ``UserError`` if an arm has no run, or if none of the prompts has one.
    """
    known = sorted({run.arm for run in found})
    wanted = known if arms is None else list(arms)
    if missing := [arm for arm in wanted if arm not in known]:
        raise UserError(f"arms: expected some of {', '.join(known)}, got {missing[0]!r}. Try: arms=null")
    if len(set(wanted)) < 2:
        listed = ", ".join(map(repr, wanted)) or "none"
        raise UserError(f"arms: expected at least two with assets, got {listed}. Try: arms=null")
    runs = [run for run in found if run.arm in wanted and (prompts is None or run.prompt in prompts)]
    if not runs:
        some = ", ".join(sorted({repr(run.prompt) for run in found})[:3])
        raise UserError(
            f"prompts: expected prompts of the runs, such as {some}, got others. Try: prompts=null"
        )
    return runs


def pair_runs(runs: Sequence[StudyRun], *, same_seed: bool) -> list[RunPair]:
    """Return every pair of runs of different arms with the same prompt, conditions and seed.

    Without ``same_seed``, the runs of a prompt are paired in the order of their seeds: the first run of an
    arm with the first run of another one. Raises ``UserError`` if an arm has two runs of one prompt and seed
    under the same conditions, or if there is no pair.
    """
    groups: dict[tuple, dict[str, list[StudyRun]]] = defaultdict(lambda: defaultdict(list))
    for run in sorted(runs, key=lambda run: (run.prompt, run.conditions, run.seed, run.arm)):
        groups[run.prompt, run.conditions, run.seed if same_seed else None][run.arm].append(run)
    pairs = []
    for arms in groups.values():
        for one, other in chain(*(pairwise(members) for members in arms.values())):
            if one.seed == other.seed:
                raise UserError(
                    f"runs: expected one run of each prompt and seed in the arm {one.arm!r}, got two of "
                    f"{one.prompt!r} with seed {one.seed}: {one.folder.name} and {other.folder.name}. "
                    f"Try: {setting_word('runs', f'[{shown(one.folder)},{shown(other.folder)}]')}"
                )
        for one, other in combinations(sorted(arms), 2):
            # An arm may have more runs of a prompt than another one; the rest has no partner.
            pairs += [RunPair(both) for both in zip(arms[one], arms[other], strict=False)]
    if not pairs:
        shared, example = "prompt", "cadam3d sweep --help"
        if same_seed:
            shared, example = "prompt and seed", "same_seed=false"
        raise UserError(
            f"runs: expected runs of different arms with the same {shared}, got none. Try: {example}"
        )
    return pairs


def draw_pairs(pairs: Sequence[RunPair], most: int | None, generator: Random) -> list[RunPair]:
    """Return at most ``most`` pairs, drawn so that every two arms meet equally often; None stands for all.

    Prompts repeat only after each of them has been drawn for these two arms.
    """
    if most is None or most >= len(pairs):
        return list(pairs)
    queues: dict[tuple[str, str], list[RunPair]] = defaultdict(list)
    for pair in generator.sample(list(pairs), len(pairs)):
        queues[pair.arms].append(pair)
    ordered = [_prompts_first(queues[arms]) for arms in sorted(queues)]
    rounds = [queue[i] for i in range(max(map(len, ordered))) for queue in ordered if i < len(queue)]
    chosen = set(rounds[:most])
    return [pair for pair in pairs if pair in chosen]


def _prompts_first(pairs: Sequence[RunPair]) -> list[RunPair]:
    """Return the pairs with the first one of every prompt in front, then the second ones, and so on."""
    seen: dict[str, int] = defaultdict(int)
    turns = []
    for pair in pairs:
        turns.append(seen[pair.prompt])
        seen[pair.prompt] += 1
    return [pair for _, pair in sorted(zip(turns, pairs, strict=True), key=lambda item: item[0])]


def _arms_of_sweep(folder: Path) -> Found:
    """Return the jobs of a sweep that left an asset, with the arms and the conditions of its report."""
    runs, left = [], 0
    for job in read(folder):
        summary = read_summary(job.folder)
        if not {"prompt", "seed"} <= summary.keys() or not has_file(job.folder, ASSET):
            left += 1
            continue
        arm = plain(job.setting.name)
        runs.append(
            StudyRun(job.folder, arm, summary["prompt"], summary["seed"], job.cell.without(PROMPT, SEED).axes)
        )
    return Found(runs, left)


def _results(place: str, folder: Path) -> Mapping[Path, Mapping[str, Any]]:
    """Return the summaries of the runs in a place by their folders. Raises ``UserError`` if it has none."""
    if is_sweep(folder):
        folders = [job.folder for job in read(folder)]
    elif has_file(folder, CONFIG):
        folders = [folder]
    else:
        folders = sorted(config.parent for config in folder.glob(f"*/{CONFIG}"))
    summaries = {each: read_summary(each) for each in folders}
    found = {each: facts for each, facts in summaries.items() if {"prompt", "seed"} <= facts.keys()}
    if not found:
        reason = "no such folder" if not folder.exists() else "it has no finished run"
        raise UserError(
            f"runs: expected the folder of a run or of several runs, got {place!r} ({reason}). "
            "Try: cadam3d study --help"
        )
    return found


def _default_labels(
    folders: Sequence[Path], results: Sequence[Mapping[Path, Mapping[str, Any]]]
) -> list[str]:
    """Return the densifier of each arm if these differ, else the name or the path of its folder."""
    densifiers = [
        {plain(str(facts.get("densifier") or "")) for facts in summaries.values()} for summaries in results
    ]
    by_densifier = [min(names) if len(names) == 1 else "" for names in densifiers]
    for names in (by_densifier, [plain(folder.name) for folder in folders]):
        if all(names) and len(set(names)) == len(names):
            return [name[:LONGEST_LABEL] for name in names]
    return [plain(str(shown(folder)))[-LONGEST_LABEL:] for folder in folders]
