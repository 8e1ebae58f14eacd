"""Attempts: several seeds of one run as the jobs of a sweep, and the numbers of each of them."""

import shlex
from argparse import Namespace
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from omegaconf import DictConfig

from cadam3d.core.checks import require_choice, require_whole
from cadam3d.core.errors import UserError
from cadam3d.core.number import COUNT, Number
from cadam3d.core.outcome import Outcome
from cadam3d.io.jsonl import is_number
from cadam3d.io.records import declared, difference, read_evaluation, read_scores
from cadam3d.io.run_folder import LATEST, expanded, shown
from cadam3d.settings.compose import slug
from cadam3d.settings.line import RUN_FOLDER, key_of
from cadam3d.settings.options import config_dir, option_class, option_names
from cadam3d.sweep.choice import Attempt, Choice, choose, preferred
from cadam3d.sweep.folder import PlannedJob, Row, rows_of
from cadam3d.sweep.grid import Axes, Grid, Job, read_line, sweep_name
from cadam3d.sweep.plan import Composer, Sweep, compose_sweep, search_path, sort_overrides

SEED = "seed="  # the name of the folder of an attempt begins with it
PARENT = Path(LATEST).parent
# The settings of a line that are not those of a single attempt.
OF_THE_LINE = ("attempts", "select", RUN_FOLDER)


def read_attempts(
    cfg: DictConfig, overrides: Sequence[str], options: Namespace, words: Sequence[str]
) -> tuple[Sweep, Composer]:
    """Return the attempts that a line of ``cadam3d train`` asks for as a sweep, and the composer of its jobs.

    ``cfg`` is the configuration of the line. ``overrides`` are quoted for Hydra, and ``words`` are the same
    as they were typed. The folder is that of ``hydra.run.dir=`` in the line. Otherwise its name follows from
    the line without ``attempts=`` and ``select=``, so that more attempts, or a choice by another number, find
    the attempts that exist. Raises ``UserError`` for settings that cannot be combined with attempts.
    """
    require_whole("seed", cfg.seed, low=0, example=3)
    if cfg.get("resume") is not None:
        kept = [word for word in words if key_of(word) not in OF_THE_LINE]
        raise UserError(
            f"attempts: expected 1 with resume=, which continues a single run, got {cfg.attempts}. "
            f"Try: {shlex.join(['cadam3d', 'train', *kept])}"
        )
    parts = sort_overrides([override for override in overrides if key_of(override) not in OF_THE_LINE])
    axes = read_line(parts.jobs)
    common = [override for override in parts.jobs if key_of(override) != "seed"]
    # Attempts that YAML files ask for would otherwise start attempts themselves.
    common += [] if any(key_of(override) == "attempts" for override in overrides) else ["attempts=1"]
    is_chosen = any(key_of(override) == RUN_FOLDER for override in overrides)
    seeds = range(cfg.seed, cfg.seed + cfg.attempts)
    sweep = Sweep(
        cfg=compose_sweep(parts, options),
        parts=parts,
        grid=Grid(each={}, arms={"": {}}, figures=["growth"]),
        axes=axes,
        prompts=None,
        jobs=[Job("", f"{SEED}{seed}", (*common, f"seed={seed}"), None, ()) for seed in seeds],
        command="train",
        place=expanded(str(cfg.hydra.run.dir)) if is_chosen else _place(cfg, axes),
    )
    return sweep, Composer(options, search_path(overrides))


def _place(cfg: DictConfig, axes: Axes) -> Path:
    """Return the folder of attempts with these settings: the prompt, and a digest of everything typed."""
    digest = sweep_name(None, axes).rpartition("_")[2]
    return PARENT / f"{slug(str(cfg.prompt))}_{digest}"


def existing_attempts(sweep: Sweep, folder: Path) -> list[Attempt]:
    """Return the attempts of a sweep with the numbers in its folder, which may not exist yet."""
    seeds = [int(job.name.removeprefix(SEED)) for job in sweep.jobs]
    jobs = [PlannedJob("", f"{SEED}{seed}", [], {"seed": seed}) for seed in seeds]
    return [attempt_of(row) for row in rows_of(folder, jobs)]


def attempt_of(row: Row) -> Attempt:
    """Return an attempt with its numbers; it has none if it has left no asset."""
    seed, summary = row.swept["seed"], row.summary
    if not row.has_result or row.outcome == Outcome.VANISHED or not summary.get("num_gaussians"):
        return Attempt(seed)
    evaluation = read_evaluation(row.folder, summary)
    numbers = {
        name: number
        for name, number in (declared(evaluation) | declared(summary)).items()
        if number.is_more_better is not None
    }
    measured, evaluated = (
        {name: float(known[name]) for name in numbers if is_number(known.get(name))}
        for known in (summary, evaluation)
    )
    # As in the tables, scores of an evaluation replace those of training. ``require_one_method`` then refuses
    # to compare scores that were measured in different ways.
    scores = {name: score.value for name, score in read_scores(row.folder, summary).items()}
    own = measured | {name: scores[name] for name in numbers if name in scores}
    return Attempt(seed, own, evaluated, numbers)


def require_one_method(choice: Choice, rows: Sequence[Row], folder: Path) -> None:
    """Raise ``UserError`` if the numbers that a choice compares were measured in different ways."""
    name = choice.number.name
    compared = [row for row in rows if row.swept["seed"] in choice.values]
    scores = [read_scores(row.folder, row.summary).get(name) for row in compared]
    problem = difference(name, [score for score in scores if score is not None])
    if problem is not None:
        line = measuring_line(folder, choice.number)
        raise UserError(f"select: {problem}. Measure all attempts in one way. Try: {line}")


def measuring_line(folder: Path, number: Number) -> str:
    """Return the line that measures a number of all attempts in a folder."""
    # A run that did not measure this number may know no truth, so the line names one.
    truth = ["truth=shapes"] if number.needs_truth else []
    return shlex.join(["cadam3d", "eval", f"run={shown(folder)}", f"metric=[{number.metric}]", *truth])


def selectable_numbers(options: Namespace) -> dict[str, Number]:
    """Return the numbers by which attempts can be compared, whichever metrics are chosen, by name.

    These are the numbers of which more or less is better, of all metrics of the package and ``--config-dir``.
    """
    folders = [*([Path(options.config_dir)] if options.config_dir else []), config_dir()]
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
    folder: Path,
    words: Sequence[str],
) -> None:
    """Raise ``UserError`` if the attempts will lack the number that they are compared by.

    ``known`` are the numbers by which attempts can be compared, whichever metrics were chosen. ``chosen`` are
    the metrics of the line, and ``words`` is the line as it was typed. ``attempts`` are those that are in
    ``folder`` already, where ``cadam3d eval`` may have measured the number.
    """
    if select is not None:
        require_choice("select", select, tuple(known))
    names = preferred(known.values()) if select is None else [select]
    metrics = [known[name].metric for name in names]
    if set(metrics) & set(chosen) or select == COUNT.name:
        return
    choice = choose(attempts, select)
    if choice is not None and not choice.without:
        return
    numbers = f"one of {', '.join(names)}" if select is None else select
    got = ", ".join(chosen) or "none"
    if all(attempt.measured for attempt in attempts):
        line = measuring_line(folder, known[names[0]])
        then = " The attempts exist: measure them, and type this again."
    else:
        kept = [word for word in words if key_of(word) != "metric"]
        metric = f"metric=[{','.join([*chosen, metrics[0]])}]"
        line = shlex.join(["cadam3d", "train", *kept, metric])
        then = ""
    raise UserError(f"select: expected metrics that measure {numbers}, got {got}.{then} Try: {line}")
