"""Start: run a sweep. Finished jobs are skipped, a launcher of Hydra runs the others, and a table is written.

The same line always has the same folder, so typing the line again continues the sweep.
"""

import os
import shlex
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf

from cadam3d.core.checks import fail
from cadam3d.core.console import complain, show
from cadam3d.core.errors import UserError
from cadam3d.core.signals import ENDING, StopOnSignal
from cadam3d.io.lock import locked
from cadam3d.io.occupied import in_use
from cadam3d.io.records import read_config
from cadam3d.io.run_folder import (
    CONFIG,
    CONSOLE,
    LOCK,
    OVERRIDES,
    STOP,
    TABLE,
    claim,
    has_file,
    holds_run,
    numbered,
    occupant_of_sweep,
    setting_word,
    shown,
)
from cadam3d.settings.compose import flatten, quote, run_hydra
from cadam3d.settings.line import NOT_OF_A_RUN, SWEEP_FOLDER
from cadam3d.settings.trust import is_trusted, require_contained
from cadam3d.sweep import process
from cadam3d.sweep.folder import Row, is_sweep, load, rows_of, write_plan
from cadam3d.sweep.plan import Sweep, search_path
from cadam3d.sweep.progress import reporting
from cadam3d.sweep.table import as_text, listing, write_table

LONGEST = 40  # rows of a table in the terminal


@dataclass(frozen=True)
class Ended:
    """A sweep that has ended."""

    folder: Path
    code: int  # exit code; 0 if every job has a result
    was_stopped: bool = False  # by a signal
    was_dry: bool = False  # nothing has run, and the folder may not exist


def run_sweep(
    sweep: Sweep, on_start: Callable[[Path], None] = lambda _: None, signals: Sequence[int] = ENDING
) -> Ended:
    """Run a sweep until all its jobs have ended, or a signal stops it. A dry run only lists the jobs.

    ``on_start`` is called with the folder before the first job starts, and ``signals`` stop the sweep. Raises
    ``UserError`` if the folder has results that were made with other settings.
    """
    folder, plan = sweep.folder, sweep.plan
    _refuse_occupied(folder, sweep.folder_key)
    if folder.is_dir() and not is_trusted(sweep.line.overrides):
        require_contained(folder, shlex.join(["cadam3d", plan.command, *plan.line, "trust=true"]))
    rows = rows_of(folder, plan.jobs)
    _refuse_other_settings(rows, sweep)
    if sweep.is_dry:
        show(f"{_title(sweep, rows)}\n\n{listing(rows)}")
        return Ended(folder, 0, was_dry=True)
    claim(folder, sweep.folder_key, is_chosen=True)
    lock = locked(folder / LOCK, lambda holder: in_use(folder, holder, sweep.folder_key))
    stop = StopOnSignal(signals, (folder / STOP).touch)
    with lock, stop:
        (folder / STOP).unlink(missing_ok=True)
        _refuse_occupied(folder, sweep.folder_key)
        pending = sum(not row.has_result for row in rows)
        write_plan(folder, replace(plan, threads=_threads(sweep.cfg, pending)))
        on_start(folder)
        rows, problem = load(folder), ""
        show(_title(sweep, rows))
        try:
            with reporting(rows):
                problem = _launch(sweep, rows)
        finally:
            code = _report_results(sweep, write_table(folder), problem)
    if stop.received is not None:
        return Ended(folder, 128 + stop.received, was_stopped=True)
    return Ended(folder, code)


def _refuse_occupied(folder: Path, key: str) -> None:
    """Refuse the folder of a run, and one with something that a sweep would overwrite or remove."""
    name = occupant_of_sweep(folder)
    if has_file(folder, OVERRIDES) or holds_run(folder):
        name = "a run"
    if name is not None and not is_sweep(folder):
        raise UserError(f"{key}: {shown(folder)} holds {name}. Try: {_beside(folder, key)}")


def _beside(folder: Path, key: str) -> str:
    """Return the words that choose a new folder beside ``folder`` with the setting ``key``."""
    return setting_word(key, shown(numbered(folder)))


def _refuse_other_settings(rows: Sequence[Row], sweep: Sweep) -> None:
    """Refuse results on disk that were made with other settings, because the table would mislabel them."""
    for row, now in zip(rows, sweep.composed, strict=True):
        config = row.folder / CONFIG
        if not config.is_file() or not (row.has_result or row.has_checkpoint):
            continue
        before = dict(flatten(read_config(config)))
        for name in sorted((before.keys() | now.values.keys()) - {*NOT_OF_A_RUN}):
            if before.get(name) != now.values.get(name):
                expected = f"{before.get(name)!r} as in {shown(row.folder)}"
                example = _beside(sweep.folder, sweep.folder_key)
                raise fail(name, expected=expected, got=now.values.get(name), example=example)


def _title(sweep: Sweep, rows: Sequence[Row]) -> str:
    """Return how many jobs a sweep has, where, and how many of them are done."""
    done = sum(row.has_result for row in rows)
    return f"{sweep.count(len(rows))} in {shown(sweep.folder)}" + (f", {done} with a result" if done else "")


def _threads(cfg: DictConfig, pending: int) -> int | None:
    """Return the OpenMP threads of a job: a share of the cores, unless the user has chosen a number."""
    launcher = cfg.get("launcher") or {}
    if "OMP_NUM_THREADS" in os.environ:
        return None
    if threads := launcher.get("threads"):
        return threads
    at_once = OmegaConf.select(cfg, "hydra.launcher.n_jobs") or launcher.get("n_jobs")
    if at_once is None:
        return None
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    # In joblib, -1 means all cores, -2 all except one, and so on.
    at_once = at_once if at_once >= 0 else cores + 1 + at_once
    return max(1, cores // max(1, min(at_once, pending)))


def _launch(sweep: Sweep, rows: Sequence[Row]) -> str:
    """Run the jobs without a result with Hydra, and return what went wrong with the launcher itself."""
    numbers = ",".join(str(row.number) for row in rows if not row.has_result)
    if not numbers:
        return ""
    words = [*search_path(sweep.parts.grid), *sweep.parts.launcher, f"job={numbers}"]
    words += [f"{SWEEP_FOLDER}={quote(str(sweep.folder))}", "--multirun"]
    try:
        run_hydra("jobs", [*sweep.line.config_flags, *words], process.run)
    except (UserError, HydraException, KeyboardInterrupt):
        raise
    except Exception as error:
        # A launcher may raise anything. The results of the jobs are in their folders.
        reason = (str(error).strip().splitlines() or ["no reason given"])[0]
        return f"the launcher failed. {type(error).__name__}: {reason}"
    return ""


def _report_results(sweep: Sweep, rows: Sequence[Row], problem: str) -> int:
    """Print the table and what is left to do. A long table is cut down to the jobs without a result."""
    left = [row for row in rows if not row.has_result]
    listed = rows if len(rows) <= LONGEST else left[:LONGEST]
    table = f"\n{as_text(listed)}\n" if listed else ""
    show(f"{table}\n{sweep.count(len(rows))}: {shown(sweep.folder / TABLE)}")
    if problem:
        complain(problem)
    if not left:
        return 0
    counts = Counter(row.outcome for row in left)
    which = ", ".join(f"{number} {outcome}" for outcome, number in counts.items())
    place = f"{CONSOLE} in their folders, such as {shown(left[0].folder)}"
    complain(f"{len(left)} of {sweep.count(len(rows))} without a result ({which}); see {place}.")
    return 1
