"""A sweep from its line to its table: plan, skip what is done, let Hydra's launcher run the rest, and tell.

The folder has the same name whenever the line is the same, so typing the line again is how to go on.
"""

import fcntl
import os
import shutil
import signal
import sys
from argparse import Namespace
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import FrameType
from typing import Any

import yaml
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import InterpolationResolutionError

from cadam3d.commands.paths import shown
from cadam3d.core.errors import UserError
from cadam3d.launch import RUN_MARKS, Task, claim, key_of, run_hydra
from cadam3d.settings.advice import explain
from cadam3d.settings.compose import flatten, quote
from cadam3d.sweep.folder import LOCK, STOP, TRACED, Plan, PlannedJob, Row, outcomes, rows_of, write_plan
from cadam3d.sweep.grid import sweep_name
from cadam3d.sweep.plan import FOLDER, Composed, Sweep, compose_all, read_sweep, told_keys
from cadam3d.sweep.table import TABLE, as_text, write_table
from cadam3d.sweep.watch import Watch

PLACE = Path("multirun")
COMPARISON = "cadam3d.report"  # makes figures and a report of the rows of a sweep
LONGEST = 40  # jobs that a table in the terminal has at most
FOR_JOBS = ("--config-dir", "-cd", "--config-path", "-cp", "--config-name", "-cn")  # flags that they need too


def start(command: str, overrides: Sequence[str], flags: Sequence[str], options: Namespace) -> int:
    """Run the sweep of a line and return its exit code: 0 if every job has a result.

    Raises ``UserError`` before anything runs if any of its jobs cannot be composed, or if its folder holds
    results that were made with other settings.
    """
    sweep, composer = read_sweep(command, overrides, options)
    composed = compose_all(sweep, composer)
    folder = _folder(sweep, command)
    jobs = _planned(sweep, composed)
    _refuse_other_settings(folder, rows_of(folder, jobs), composed)
    claim(folder, FOLDER, is_chosen=True)
    with _locked(folder), _stoppable(folder) as stop:
        rows = rows_of(folder, jobs)
        pending = [row for row in rows if not row.has_result]
        threads = _threads(sweep.cfg, len(pending))
        plan = Plan(
            cwd=str(Path.cwd()),
            flags=_flags_of_jobs(flags),
            threads=threads,
            jobs=jobs,
            figures=sweep.grid.figures,
            line=[*_flags_of_jobs(flags), *overrides],
        )
        write_plan(folder, plan)
        done = len(rows) - len(pending)
        print(f"{_jobs(len(rows))} in {shown(folder)}" + f"; {done} with a result already" * (done > 0))
        problem = ""
        try:
            if pending:
                with Watch(rows, pending):
                    problem = _launch(folder, sweep, pending, flags)
        finally:
            shutil.rmtree(folder / TRACED, ignore_errors=True)
            code = _tell(folder, write_table(folder), problem)
    if stop.received is not None:
        return 128 + stop.received
    _compare(folder)
    return code


class Stop:
    """The first SIGINT or SIGTERM asks all jobs, wherever they run, to save and end; the second is final."""

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
            "\nStopping as soon as all running jobs have saved; once more to stop at once.", file=sys.stderr
        )


def _folder(sweep: Sweep, command: str) -> Path:
    """Where the sweep lies, whether that exists or not."""
    place = PLACE / sweep_name(sweep.grid_name, sweep.axes)
    if sweep.line.folder:
        try:
            text = OmegaConf.select(sweep.cfg, FOLDER)
        except InterpolationResolutionError as error:
            raise explain(error, command, sweep.line.folder) or error from error
        if not text:
            raise UserError(f"{FOLDER}: expected a folder, got nothing. Try: {FOLDER}={place}, or without it")
        place = Path(str(text)).expanduser()
    if any((place / name).exists() for name in RUN_MARKS):
        raise UserError(f"{FOLDER}: {place} holds a run. Try: {FOLDER}=multirun/mine, or without it")
    return place.resolve()


def _planned(sweep: Sweep, composed: Sequence[Composed]) -> list[PlannedJob]:
    keys = told_keys(sweep)
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
    """A row says what the line says, so what is on disk must have been made with the settings of now."""
    for row, now in zip(rows, composed, strict=True):
        config = row.folder / "config.yaml"
        if not config.is_file() or not (row.has_result or row.has_checkpoint):
            continue
        before = dict(flatten(_read_yaml(config)))
        for key in sorted((before.keys() | now.values.keys()) - now.unknown - {"resume"}):
            if before.get(key) != now.values.get(key):
                raise UserError(
                    f"{key}: was {before.get(key)} in {shown(row.folder)}, is {now.values.get(key)} now. "
                    f"Try: {FOLDER}={_free(folder)}, which is another folder, or the settings of before"
                )


def _read_yaml(path: Path) -> Any:
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # the same, ten times as fast
    return yaml.load(path.read_text(encoding="utf-8"), loader)


def _free(folder: Path) -> Path:
    number = 2
    while (place := folder.with_name(f"{folder.name}-{number}")).exists():
        number += 1
    return shown(place)


def _threads(cfg: DictConfig, pending: int) -> int | None:
    """OpenMP threads of a job: those side by side share the cores, unless the user has said otherwise."""
    if "OMP_NUM_THREADS" in os.environ:
        return None
    launcher = cfg.get("launcher") or {}
    if threads := launcher.get("threads"):
        return threads
    side_by_side = OmegaConf.select(cfg, "hydra.launcher.n_jobs") or launcher.get("n_jobs")
    if side_by_side is None:
        return None
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if side_by_side < 0:  # joblib: -1 is all cores, -2 all but one
        side_by_side = max(1, cores + 1 + side_by_side)
    return max(1, cores // max(1, min(side_by_side, pending)))


def _flags_of_jobs(flags: Sequence[str]) -> list[str]:
    """The flags that a job needs too; the others concern the sweep."""
    kept: list[str] = []
    for position, flag in enumerate(flags):
        if flag.partition("=")[0] in FOR_JOBS:
            kept += [flag] if "=" in flag else flags[position : position + 2]
    return kept


def _launch(folder: Path, sweep: Sweep, pending: Sequence[Row], flags: Sequence[str]) -> str:
    """Let Hydra run the jobs, and return what went wrong with the launcher itself."""
    numbers = ",".join(str(row.number) for row in pending)
    lines = [line for line in sweep.line.grid if key_of(line) == "hydra.searchpath"]
    lines += [*sweep.line.launcher, f"job={numbers}", f"{FOLDER}={quote(str(folder))}"]
    own = [word for word in _flags_of_jobs(flags) if word not in ("--config-name", "-cn")]
    try:
        run_hydra("jobs", [*lines, *own, "--multirun"], Task("sweep"))
    except (UserError, KeyboardInterrupt):
        raise
    except Exception as error:  # of the launcher: what became of the jobs is in their folders
        reason = (str(error).strip().splitlines() or ["no reason given"])[0]
        return f"the launcher gave up. {type(error).__name__}: {reason}"
    return ""


def _tell(folder: Path, rows: Sequence[Row], problem: str) -> int:
    """Print the table and what is left to do; the exit code. Of a long table only what has no result."""
    told = rows if len(rows) <= LONGEST else [row for row in rows if not row.has_result][:LONGEST]
    table = f"\n{as_text(told)}\n" if told else ""
    print(f"{table}\n{_jobs(len(rows))}: {shown(folder / TABLE)}", flush=True)
    if problem:
        print(f"cadam3d: {problem}", file=sys.stderr)
    left = outcomes(rows)
    if not left:
        return 0
    which = ", ".join(f"{count} {outcome}" for outcome, count in left.items())
    print(
        f"cadam3d: {sum(left.values())} of {_jobs(len(rows))} without a result ({which}). "
        "The same line again runs only those.",
        file=sys.stderr,
    )
    return 1


def _compare(folder: Path) -> None:
    """Figures, a report and its verdict, where there is a module that makes them."""
    if find_spec(COMPARISON) is None:
        return
    report = import_module(COMPARISON)
    try:
        page = report.write_sweep(folder)
        print("".join(f"\n{sentence}\n" for sentence in report.verdict(folder)))
        print(f"report: {shown(page)}", flush=True)
    except UserError as error:
        print(f"cadam3d: {error}", file=sys.stderr)


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Keep a second sweep out of the folder; the lock goes with the process, however that ends."""
    with (folder / LOCK).open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise UserError(
                f"{FOLDER}: another sweep is at work in {shown(folder)}. "
                f"Try: again when it has ended, or {FOLDER}={_free(folder)}"
            ) from error
        except OSError:  # a file system without locks
            pass
        yield


@contextmanager
def _stoppable(folder: Path) -> Iterator[Stop]:
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
