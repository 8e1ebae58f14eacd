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
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from types import FrameType

from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf

from cadam3d.core.errors import UserError
from cadam3d.io.lock import locked
from cadam3d.io.records import read_config
from cadam3d.io.run_folder import (
    CONFIG,
    CONSOLE,
    LOCK,
    OVERRIDES,
    SHARED,
    STOP,
    TABLE,
    claim,
    expanded,
    has_file,
    holds_run,
    numbered,
    occupant_of_sweep,
    shown,
    spare,
    typed_path,
)
from cadam3d.settings.compose import flatten, quote
from cadam3d.settings.hydra import run_hydra
from cadam3d.settings.line import SWEEP_FOLDER, key_of, setting_word
from cadam3d.settings.place import in_use
from cadam3d.settings.trust import is_trusted, require_contained
from cadam3d.sweep import preview, worker
from cadam3d.sweep.folder import Plan, PlannedJob, Row, is_sweep, outcomes, rows_of, write_plan
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
    was_dry: bool = False  # nothing has run, and the folder may not exist


def start(command: str, overrides: Sequence[str], flags: Sequence[str], options: Namespace) -> Ended:
    """Run the sweep of a line until all jobs have ended or a signal stops it.

    With ``dry_run=true`` only list the jobs. Raises an exception before anything runs if a job cannot be
    composed, and ``UserError`` if the folder has results that were made with other settings.
    """
    sweep, composer = read_sweep(command, overrides, options)
    composed = compose_all(sweep, composer)
    folder = _folder(sweep)
    if folder.is_dir() and not is_trusted(overrides):
        require_contained(folder, shlex.join(["cadam3d", "sweep", *overrides, *flags, "trust=true"]))
    jobs = _planned(sweep, composed)
    _refuse_other_settings(folder, rows_of(folder, jobs), composed)
    if sweep.is_dry:
        return _preview(folder, sweep, jobs, composed, flags)
    claim(folder, SWEEP_FOLDER, is_chosen=True)
    with _locked(folder), _stoppable(folder) as stop:
        _refuse_occupied(folder)
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


def _preview(
    folder: Path,
    sweep: Sweep,
    jobs: list[PlannedJob],
    composed: Sequence[Composed],
    flags: Sequence[str],
) -> Ended:
    """List the jobs and estimate their time. Nothing is written except in a temporary folder."""
    rows = rows_of(folder, jobs)
    pending = sum(not row.has_result for row in rows)
    done = len(rows) - pending
    print(f"{_jobs(len(rows))} in {shown(folder)}; {done} already {_has(done)} a result")
    print(f"\n{preview.listing(rows)}\n", flush=True)
    plan = Plan(
        cwd=str(Path.cwd()),
        flags=_flags_named(flags, JOB_FLAGS),
        threads=_threads(sweep.cfg, pending),
        jobs=jobs,
    )
    steps = [job.get("steps") for job in composed]
    # Hydra's own launcher runs one job after another.
    is_alone = sweep.cfg.hydra.runtime.choices.get("hydra/launcher") == "basic"
    at_a_time = 1 if is_alone else _side_by_side(sweep.cfg)
    with TemporaryDirectory(prefix="cadam3d-") as name, _stoppable(Path(name)) as stop:
        print(preview.estimate(rows, steps, plan, at_a_time, Path(name)))
    code = 0 if stop.received is None else 128 + stop.received
    return Ended(folder, code, was_stopped=stop.received is not None, was_dry=True)


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
    place = PARENT / sweep_name(sweep.grid_name, sweep.axes, sweep.prompts)
    if sweep.parts.folder:
        text = OmegaConf.select(sweep.cfg, SWEEP_FOLDER)
        if not text:
            example = shlex.quote(f"{SWEEP_FOLDER}={place}")
            raise UserError(f"{SWEEP_FOLDER}: expected a folder, got nothing. Try: {example}")
        place = expanded(str(text))
    _refuse_occupied(place)
    return typed_path(str(place))


def _refuse_occupied(folder: Path) -> None:
    """Refuse the folder of a run, and one with something that a sweep would overwrite or remove."""
    name = occupant_of_sweep(folder)
    if has_file(folder, OVERRIDES) or holds_run(folder):
        name = "a run"
    if name is not None and not is_sweep(folder):
        raise UserError(f"{SWEEP_FOLDER}: {shown(folder)} holds {name}. Try: {_beside(folder)}")


def _beside(folder: Path) -> str:
    """Return the words that choose a new folder beside ``folder`` for a sweep."""
    return setting_word(SWEEP_FOLDER, shown(numbered(folder)))


def _planned(sweep: Sweep, composed: Sequence[Composed]) -> list[PlannedJob]:
    keys = shown_keys(sweep)
    return [
        PlannedJob(
            arm=job.arm,
            folder=job.name,
            overrides=list(job.overrides),
            swept={key: settings.get(key) for key in keys},
            prompt_name=job.prompt.name if job.prompt else "",
            category=job.prompt.category if job.prompt else "",
        )
        for job, settings in zip(sweep.jobs, composed, strict=True)
    ]


def _refuse_other_settings(folder: Path, rows: Sequence[Row], composed: Sequence[Composed]) -> None:
    """Refuse results on disk that were made with other settings, because the table would mislabel them."""
    for row, now in zip(rows, composed, strict=True):
        config = row.folder / CONFIG
        if not config.is_file() or not (row.has_result or row.has_checkpoint):
            continue
        before = dict(flatten(read_config(config)))
        for key in sorted((before.keys() | now.values.keys()) - now.unknown - {"resume", "trust"}):
            if before.get(key) != now.values.get(key):
                raise UserError(
                    f"{key}: was {before.get(key)} in {shown(row.folder)}, is {now.values.get(key)} now. "
                    "The earlier settings or another folder are possible. "
                    f"Try: {_beside(folder)}"
                )


def _threads(cfg: DictConfig, pending: int) -> int | None:
    """Return the OpenMP threads of a job: a share of the cores, unless the user has chosen a number."""
    if "OMP_NUM_THREADS" in os.environ:
        return None
    if threads := (cfg.get("launcher") or {}).get("threads"):
        return threads
    side_by_side = _side_by_side(cfg)
    return None if side_by_side is None else max(1, _cores() // max(1, min(side_by_side, pending)))


def _side_by_side(cfg: DictConfig) -> int | None:
    """Return how many jobs the launcher runs at a time; None if it has no such setting."""
    number = OmegaConf.select(cfg, "hydra.launcher.n_jobs") or (cfg.get("launcher") or {}).get("n_jobs")
    # In joblib, -1 means all cores, -2 all except one, and so on.
    return number if number is None or number >= 0 else max(1, _cores() + 1 + number)


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


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
    """Keep other sweeps and runs out of the folder until this process ends, in whatever way."""
    with ExitStack() as stack:
        try:
            stack.enter_context(locked(folder / LOCK, lambda holder: in_use(folder, holder, SWEEP_FOLDER)))
        except OSError as error:
            raise UserError(
                f"{SWEEP_FOLDER}: cannot write to {shown(folder)} ({error.strerror or error}). "
                f"Try: {setting_word(SWEEP_FOLDER, spare('cadam3d'))}"
            ) from error
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
