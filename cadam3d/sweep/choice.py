"""Choice: several seeds of one run as the jobs of a sweep, and the best of them by one number."""

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import mean

from omegaconf import DictConfig

from cadam3d.core.checks import fail, require_choice
from cadam3d.core.errors import UserError
from cadam3d.core.number import COUNT, Number, preferred
from cadam3d.core.outcome import Outcome
from cadam3d.io.records import difference, read_scores
from cadam3d.io.run_folder import LATEST, RUN_FOLDER, shown
from cadam3d.settings.compose import slug
from cadam3d.settings.line import Line, key_of
from cadam3d.settings.options import option_class, option_names
from cadam3d.sweep.folder import Job, Row, numbers_of
from cadam3d.sweep.grid import read_line, sweep_name
from cadam3d.sweep.plan import (
    Composer,
    Sweep,
    compose_all,
    compose_sweep,
    folder_of,
    plan_of,
    search_path,
    sort_overrides,
)

SEED = "seed="  # the name of the folder of an attempt begins with it
PARENT = Path(LATEST).parent
# The settings of a line that no single attempt has.
OF_THE_LINE = ("attempts", "select", RUN_FOLDER)


@dataclass(frozen=True)
class Attempt:
    """One attempt, with the numbers of its asset. Without an asset that can be compared it has none."""

    seed: int
    numbers: Mapping[str, float] = field(default_factory=dict)
    declared: Mapping[str, Number] = field(default_factory=dict)  # what is known about these numbers


@dataclass(frozen=True)
class Choice:
    """The best of several attempts."""

    number: Number
    values: Mapping[int, float]  # by seed, the best first; at least one
    without: Sequence[int]  # the seeds of the attempts that do not have this number

    @property
    def best(self) -> int:
        """Return the seed of the best attempt."""
        return next(iter(self.values))

    @property
    def sentence(self) -> str:
        """Say which attempt is the best, and give the numbers of all."""
        written = self.number.written
        listed = ", ".join(f"{written(value)} (seed={seed})" for seed, value in self.values.items())
        missing = "".join(f"; seed={seed} has none" for seed in self.without)
        return (
            f"Best of {len(self.values)} by {self.number.label}: seed={self.best}. All: {listed}{missing}. "
            f"Mean: {written(mean(self.values.values()))}."
        )


def read_attempts(cfg: DictConfig, line: Line) -> Sweep:
    """Return the attempts that a line of ``cadam3d train`` asks for as a sweep.

    ``cfg`` is the configuration of the line. The folder is that of ``hydra.run.dir=`` in the line. Otherwise
    its name follows from the line without ``attempts=`` and ``select=``, so that more attempts, or a choice
    by another number, find the attempts that exist. Raises ``UserError`` for settings that cannot be combined
    with attempts.
    """
    if cfg.get("resume") is not None:
        raise fail("attempts", expected="1 with resume=", got=cfg.attempts)
    given = {key_of(override) for override in line.overrides}
    parts = sort_overrides([override for override in line.overrides if key_of(override) not in OF_THE_LINE])
    common = [override for override in parts.jobs if key_of(override) != "seed"]
    # Attempts that YAML files ask for would otherwise start attempts themselves.
    common += [] if "attempts" in given else ["attempts=1"]
    jobs = [
        Job("", f"{SEED}{seed}", [*common, f"seed={seed}"], {"prompt": cfg.prompt, "seed": seed})
        for seed in range(cfg.seed, cfg.seed + cfg.attempts)
    ]
    own = compose_sweep(parts, line.options)
    place = Path(str(cfg.hydra.run.dir))
    if RUN_FOLDER not in given:
        # The prompt, and a digest of everything typed.
        digest = sweep_name(None, read_line(parts.jobs)).rpartition("_")[2]
        place = PARENT / f"{slug(str(cfg.prompt))}_{digest}"
    composed = compose_all(jobs, Composer(line.options, search_path(line.overrides)))
    plan = plan_of(line, jobs, composed, "train", figures=["growth"])
    return Sweep(line, own, parts, folder_of(own, parts, place), plan, composed)


def attempt_of(row: Row) -> Attempt:
    """Return an attempt with its numbers; it has none if it has left no asset."""
    seed = row.swept["seed"]
    if not row.has_result or row.outcome == Outcome.VANISHED or not row.summary.get("num_gaussians"):
        return Attempt(seed)
    known, numbers, _ = numbers_of(row)
    compared = {name: each for name, each in known.items() if each.is_more_better is not None}
    return Attempt(seed, {name: numbers[name] for name in compared if name in numbers}, compared)


def choose(attempts: Sequence[Attempt], select: str | None) -> Choice | None:
    """Return the best attempt by the number ``select``; None if no attempt has that number.

    ``None`` stands for the most preferred number that an attempt has (``Number.preference``). Of attempts
    with equal numbers, the one with the lowest seed is the best.
    """
    known = {name: number for attempt in attempts for name, number in attempt.declared.items()}
    names = [each.name for each in preferred(known.values())] if select is None else [select]
    for name in names:
        replacing = [number.name for number in known.values() if number.replaces == name]
        for key in (*replacing, name):
            values = {each.seed: each.numbers[key] for each in attempts if key in each.numbers}
            if values:
                merit = known[key].merit
                ordered = sorted(values, key=lambda seed: (-merit(values[seed]), seed))
                without = sorted(each.seed for each in attempts if each.seed not in values)
                return Choice(known[key], {seed: values[seed] for seed in ordered}, without)
    return None


def selectable_numbers(folders: Sequence[Path]) -> dict[str, Number]:
    """Return the numbers by which attempts can be compared, whichever metrics are chosen, by name.

    These are the numbers of which more or less is better. ``folders`` have the YAML files of the metrics.
    """
    found = [
        replace(number, metric=name)
        for name in option_names("metric", folders)
        for number in getattr(option_class("metric", name, folders), "numbers", ())
    ]
    return {number.name: number for number in found if number.is_more_better is not None}


def require_measured(
    select: str | None,
    known: Mapping[str, Number],
    chosen: Sequence[str],
    attempts: Sequence[Attempt],
) -> None:
    """Raise ``UserError`` if the attempts will lack the number that they are compared by.

    ``known`` are the numbers by which attempts can be compared, whichever metrics were chosen. ``chosen`` are
    the metrics of the line. ``attempts`` exist already, and ``cadam3d eval`` may have measured the number.
    """
    if select is not None:
        require_choice("select", select, tuple(known))
    names = [each.name for each in preferred(known.values())] if select is None else [select]
    metrics = [known[name].metric for name in names]
    if set(metrics) & set(chosen) or select == COUNT.name:
        return
    choice = choose(attempts, select)
    if choice is not None and not choice.without:
        return
    example = f"'metric=[{','.join([*chosen, metrics[0]])}]'"
    expected = f"metrics that measure {' or '.join(names)}"
    raise fail("select", expected=expected, got=", ".join(chosen) or "none", example=example)


def require_one_method(choice: Choice, rows: Sequence[Row], sweep: Sweep) -> None:
    """Raise ``UserError`` if the numbers of a choice were measured in different ways."""
    name = choice.number.name
    compared = [row for row in rows if row.swept["seed"] in choice.values]
    scores = [read_scores(row.folder, row.summary).get(name) for row in compared]
    problem = difference(name, [score for score in scores if score is not None])
    if problem is not None:
        line = measuring_line(sweep, choice.number)
        raise UserError(f"select: {problem}. Try: {line}")


def measuring_line(sweep: Sweep, number: Number) -> str:
    """Return the line that measures a number of all attempts."""
    words = [*sweep.line.config_flags, f"run={shown(sweep.folder)}", f"metric=[{number.metric}]"]
    return shlex.join(["cadam3d", "eval", *words])
