"""Start: run a sweep. Finished jobs are skipped, a launcher of Hydra runs the others, and a table is written.

The same line always has the same folder, so typing the line again continues the sweep.
"""

import os
import shlex
import shutil
import signal
import sys
from argparse import Namespace
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import yaml
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf

from cadam3d.core.errors import UserError
from cadam3d.io.lock import try_lock
from cadam3d.io.run_folder import (
    CONFIG,
    CONSOLE,
    LOCK,
    SHARED,
    STOP,
    TABLE,
    claim,
    holds_run,
    numbered,
    shown,
)
from cadam3d.settings.compose import flatten, quote
from cadam3d.settings.hydra import run_hydra
from cadam3d.settings.line import SWEEP_FOLDER, key_of
from cadam3d.sweep import worker
from cadam3d.sweep.folder import Plan, PlannedJob, Row, outcomes, rows_of, write_plan
from cadam3d.sweep.grid import sweep_name
from cadam3d.sweep.plan import Composed, Sweep, compose_all, read_sweep, shown_keys
from cadam3d.sweep.table import as_text, write_table
from cadam3d.sweep.watch import Watch

PARENT = Path("multirun")
LONGEST = 40  # rows of a table in the terminal
FOLDER_FLAGS = ("--config-dir", "-cd", "--config-path", "-cp")
# The flags of a sweep that its jobs need too.
JOB_FLAGS = (*FOLDER_FLAGS, "--config-name", "-cn")


@dataclass(frozen=True)
class Ended:
    """A sweep that has ended."""

    folder: Path
    code: int  # exit code; 0 if every job has a result
    was_stopped: bool  # by a signal


def start(command: str, overrides: Sequence[str], flags: Sequence[str], options: Namespace) -> Ended:
    """Run the sweep of a line until all jobs have ended or a signal stops it.

    Raises an exception before anything runs if a job cannot be composed, and ``UserError`` if the folder has
    results that were made with other settings.
    """
    sweep, composer = read_sweep(command, overrides, options)
    composed = compose_all(sweep, composer)
    folder = _folder(sweep)
    jobs = _planned(sweep, composed)
    _refuse_other_settings(folder, rows_of(folder, jobs), composed)
    claim(folder, SWEEP_FOLDER, is_chosen=True)
    with _locked(folder), _stoppable(folder) as stop:
        rows = rows_of(folder, jobs)
        pending = [row for row in rows if not row.has_result]
        plan = Plan(
            cwd=str(Path.cwd()),
            flags=_flags_named(flags, JOB_FLAGS),
            threads=_threads(sweep.cfg, len(pending)),
            jobs=jobs,
            figures=sweep.grid.figures,
            line=[*_flags_named(flags, JOB_FLAGS), *overrides],
        )
        write_plan(folder, plan)
        done = len(rows) - len(pending)
        already = f"; {done} already {_has(done)} a result" if done else ""
        print(f"{_jobs(len(rows))} in {shown(folder)}{already}")
        problem = ""
        try:
            if pending:
                with Watch(rows, pending):
                    problem = _launch(folder, sweep, pending, flags)
        finally:
            shutil.rmtree(folder / SHARED, ignore_errors=True)
            code = _report_results(folder, write_table(folder), problem)
    if stop.received is not None:
        return Ended(folder, 128 + stop.received, was_stopped=True)
    return Ended(folder, code, was_stopped=False)


class Stop:
    """Handles SIGINT and SIGTERM: after the first one, all jobs save and end, on whatever machine they run.

    The second one ends everything at once.
    """

    def __init__(self, folder: Path) -> None:
        self.received: int | None = None
        self._mark = folder / STOP

    def __call__(self, number: int, _frame: FrameType | None) -> None:
        """Handle a signal."""
        if self.received is not None:
            raise KeyboardInterrupt
        self.received = number
        self._mark.touch()
        print(
            "\nStopping as soon as all running jobs have saved; interrupt again to stop at once.",
            file=sys.stderr,
        )


def _folder(sweep: Sweep) -> Path:
    """Return the folder of the sweep, which may not exist yet."""
    place = PARENT / sweep_name(sweep.grid_name, sweep.axes)
    if sweep.parts.folder:
        text = OmegaConf.select(sweep.cfg, SWEEP_FOLDER)
        if not text:
            example = shlex.quote(f"{SWEEP_FOLDER}={place}")
            raise UserError(f"{SWEEP_FOLDER}: expected a folder, got nothing. Try: {example}")
        place = Path(str(text)).expanduser()
    if holds_run(place):
        raise UserError(f"{SWEEP_FOLDER}: {place} holds a run. Try: {_beside(place)}")
    return place.resolve()


def _beside(folder: Path) -> str:
    """Return the words that choose a new folder beside ``folder`` for a sweep."""
    return shlex.quote(f"{SWEEP_FOLDER}={shown(numbered(folder))}")


def _planned(sweep: Sweep, composed: Sequence[Composed]) -> list[PlannedJob]:
    keys = shown_keys(sweep)
    return [
        PlannedJob(
            arm=job.arm,
            folder=job.name,
            overrides=list(job.overrides),
            swept={key: settings.get(key) for key in keys},
        )
        for job, settings in zip(sweep.jobs, composed, strict=True)
    ]


def _refuse_other_settings(folder: Path, rows: Sequence[Row], composed: Sequence[Composed]) -> None:
    """Refuse results on disk that were made with other settings, because the table would mislabel them."""
    for row, now in zip(rows, composed, strict=True):
        config = row.folder / CONFIG
        if not config.is_file() or not (row.has_result or row.has_checkpoint):
            continue
        before = dict(flatten(_read_yaml(config)))
        for key in sorted((before.keys() | now.values.keys()) - now.unknown - {"resume"}):
            if before.get(key) != now.values.get(key):
                raise UserError(
                    f"{key}: was {before.get(key)} in {shown(row.folder)}, is {now.values.get(key)} now. "
                    "The earlier settings or another folder are possible. "
                    f"Try: {_beside(folder)}"
                )


def _read_yaml(path: Path) -> Any:
    # The loader in C is ten times as fast, but not every build of PyYAML has it.
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    return yaml.load(path.read_text(encoding="utf-8"), loader)


def _threads(cfg: DictConfig, pending: int) -> int | None:
    """Return the OpenMP threads of a job: a share of the cores, unless the user has chosen a number."""
    if "OMP_NUM_THREADS" in os.environ:
        return None
    launcher = cfg.get("launcher") or {}
    if threads := launcher.get("threads"):
        return threads
    side_by_side = OmegaConf.select(cfg, "hydra.launcher.n_jobs") or launcher.get("n_jobs")
    if side_by_side is None:
        return None
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    # In joblib, -1 means all cores, -2 all except one, and so on.
    if side_by_side < 0:
        side_by_side = max(1, cores + 1 + side_by_side)
    return max(1, cores // max(1, min(side_by_side, pending)))


def _flags_named(flags: Sequence[str], names: Sequence[str]) -> list[str]:
    """Return the flags with one of these names, each with its value."""
    kept: list[str] = []
    for position, flag in enumerate(flags):
        if flag.partition("=")[0] in names:
            kept += [flag] if "=" in flag else flags[position : position + 2]
    return kept


def _launch(folder: Path, sweep: Sweep, pending: Sequence[Row], flags: Sequence[str]) -> str:
    """Run the jobs with Hydra, and return what went wrong with the launcher itself."""
    numbers = ",".join(str(row.number) for row in pending)
    overrides = [override for override in sweep.parts.grid if key_of(override) == "hydra.searchpath"]
    overrides += [*sweep.parts.launcher, f"job={numbers}", f"{SWEEP_FOLDER}={quote(str(folder))}"]
    try:
        run_hydra("jobs", [*overrides, *_flags_named(flags, FOLDER_FLAGS), "--multirun"], worker.run)
    except (UserError, HydraException, KeyboardInterrupt):
        raise
    except Exception as error:
        # A launcher may raise anything. The results of the jobs are in their folders.
        reason = (str(error).strip().splitlines() or ["no reason given"])[0]
        return f"the launcher failed. {type(error).__name__}: {reason}"
    return ""


def _report_results(folder: Path, rows: Sequence[Row], problem: str) -> int:
    """Print the table and what is left to do. A long table is cut down to the jobs without a result."""
    listed = rows if len(rows) <= LONGEST else [row for row in rows if not row.has_result][:LONGEST]
    table = f"\n{as_text(listed)}\n" if listed else ""
    print(f"{table}\n{_jobs(len(rows))}: {shown(folder / TABLE)}", flush=True)
    if problem:
        print(f"cadam3d: {problem}", file=sys.stderr)
    left = outcomes(rows)
    if not left:
        return 0
    count = sum(left.values())
    which = ", ".join(f"{number} {outcome}" for outcome, number in left.items())
    consoles = [
        row.folder / CONSOLE for row in rows if not row.has_result and (row.folder / CONSOLE).is_file()
    ]
    see = f"; see {shown(consoles[0])}" if consoles else ""
    them = "it" if count == 1 else "them"
    print(
        f"cadam3d: {count} of {_jobs(len(rows))} {_has(count)} no result ({which}){see}. "
        f"Rerun the same command to retry {them}.",
        file=sys.stderr,
    )
    return 1


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Keep a second sweep out of the folder. The lock is released when this process ends, in whatever way."""
    with (folder / LOCK).open("w") as file:
        if not try_lock(file):
            raise UserError(
                f"{SWEEP_FOLDER}: another sweep is running in {shown(folder)}. "
                f"Wait until it has ended, or use another folder. Try: {_beside(folder)}"
            )
        yield


@contextmanager
def _stoppable(folder: Path) -> Iterator[Stop]:
    """Handle signals with a ``Stop``, and restore the previous handlers at the end."""
    (folder / STOP).unlink(missing_ok=True)
    stop = Stop(folder)
    previous = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def _jobs(count: int) -> str:
    return "1 job" if count == 1 else f"{count} jobs"


def _has(count: int) -> str:
    return "has" if count == 1 else "have"
