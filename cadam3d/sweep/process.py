"""Process: run one job of a sweep in a separate process, so that a crash of the job ends nothing else.

This module waits for the process, passes on the request to stop, and records how it ended. The process runs
``cadam3d train`` through ``cadam3d.job``, which ends it together with the sweep.
"""

import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from cadam3d.core.console import say
from cadam3d.core.outcome import Outcome
from cadam3d.core.signals import ENDING
from cadam3d.io.jsonl import write_json
from cadam3d.io.lock import INHERITED, describe_holder, take, unlock
from cadam3d.io.records import read_summary
from cadam3d.io.run_folder import CONSOLE, ENDED, LOCK, RUN_FOLDER, STOP, SUMMARY
from cadam3d.settings.compose import quote
from cadam3d.sweep.folder import Plan, Row, is_complete, read_plan, rows_of
from cadam3d.sweep.table import write_table

# The folder from which this program imports cadam3d.
PACKAGE_ROOT = Path(__file__).parents[2]
POLL_SECONDS = 0.2
IS_WINDOWS = sys.platform == "win32"
# Exit codes of a process that was asked to stop.
STOPPED = (*(128 + number for number in ENDING), *(-number for number in ENDING))
# Slurm sends one of these signals to a launcher shortly before it ends it. Windows does not have them.
ANNOUNCING = tuple(getattr(signal, name) for name in ("SIGUSR1", "SIGUSR2") if hasattr(signal, name))
KILL = getattr(signal, "SIGKILL", signal.SIGTERM)
# The text with which the reason of a failure begins in the console.
MESSAGE, TRACEBACK = "cadam3d: ", "Traceback (most recent call last)"
# Bytes at the end of the console that are searched for it.
TAIL = 20_000


def run(cfg: DictConfig) -> None:
    """Run job number ``cfg.job`` of a sweep and bring the table up to date.

    A launcher calls this for each job, on this machine or on another one. It raises nothing if a job fails or
    is killed, because the table records that and the sweep continues.
    """
    sweep = Path(HydraConfig.get().sweep.dir)
    run_job(sweep, cfg.job)
    write_table(sweep)


def run_job(sweep: Path, number: int) -> None:
    """Run job ``number`` of the sweep to its end, from its checkpoint if it has one.

    Do nothing if the sweep is being stopped or the job has a result. If another process runs the same job,
    such as one that a killed sweep has left behind, wait until that process has ended.
    """
    plan, stop = read_plan(sweep), sweep / STOP
    _end_with_sweep()
    if stop.exists():
        return
    folder = sweep / plan.jobs[number].name
    folder.mkdir(parents=True, exist_ok=True)
    with _locked(folder, stop) as lock:
        # The row is read under the lock, because the previous holder of the lock may have changed it.
        row = rows_of(sweep, plan.jobs)[number]
        if lock is None or stop.exists() or row.has_result:
            return
        started = time.monotonic()
        # Files of an earlier attempt would be mistaken for new ones.
        if not row.has_checkpoint:
            _empty(folder)
        for name in (SUMMARY, ENDED):
            (folder / name).unlink(missing_ok=True)
        code = _wait(plan, row, stop, lock)
        # A run that was refused may have removed its folder.
        folder.mkdir(exist_ok=True)
        _record_outcome(folder, code)
        write_json(folder / ENDED, {"exit_code": code, "seconds": round(time.monotonic() - started, 2)})


@contextmanager
def _locked(folder: Path, stop: Path) -> Iterator[int | None]:
    """Wait until no other process runs the job, and lock its folder; yield None if a stop comes first.

    The process of the job inherits the lock, so the lock lasts as long as that process, even if this one is
    killed. (Windows does not pass on locks.)
    """
    path, is_waiting = folder / LOCK, False
    with _signals() as signals:
        while (file := take(path)) is None and not signals and not stop.exists():
            if not is_waiting:
                say(f"{folder.name}: waiting for {describe_holder(path)}")
                is_waiting = True
            time.sleep(POLL_SECONDS)
    if file is None:
        yield None
        return
    with file:
        try:
            yield None if signals else file.fileno()
        finally:
            # Closing the file would not release the lock if the job has left a process behind.
            unlock(file.fileno())


def _empty(folder: Path) -> None:
    """Remove everything except the lock file, which other processes may have open and wait for."""
    for path in folder.iterdir():
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        elif path.name != LOCK:
            path.unlink()


def _wait(plan: Plan, row: Row, stop: Path, lock: int) -> int:
    """Start the process, wait for it and return its exit code; minus the signal if one ended it."""
    # A run does not keep the settings that belong to this machine, so a job that resumes gets them all again.
    words = [f"resume={quote(str(row.folder))}"] if row.has_checkpoint else []
    # With -P, modules are not imported from the current folder, where a file may be called yaml.py.
    command = [sys.executable, "-P", "-m", "cadam3d.job", str(os.getpid()), "train", *words]
    command += [*row.overrides, *plan.flags, f"{RUN_FOLDER}={quote(str(row.folder))}"]
    environment = dict(os.environ)
    # Hydra's main function sets this in the process of the sweep. A job prints a mistake of the user without
    # a traceback.
    environment.pop("HYDRA_FULL_ERROR", None)
    environment[INHERITED] = str(lock)
    if Path(plan.cwd) == PACKAGE_ROOT:
        # A checkout that is not installed is found in the current folder only.
        environment["PYTHONPATH"] = os.pathsep.join(filter(None, [plan.cwd, environment.get("PYTHONPATH")]))
    if plan.threads is not None:
        environment["OMP_NUM_THREADS"] = str(plan.threads)
    with (row.folder / CONSOLE).open("ab") as console, _signals() as signals:
        process = subprocess.Popen(
            command,
            cwd=plan.cwd,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=console,
            stderr=subprocess.STDOUT,
            # Otherwise Ctrl-C would reach the job twice, and the second signal stops it at once.
            start_new_session=True,
            pass_fds=() if IS_WINDOWS else (lock,),
        )
        is_asked = False
        try:
            while True:
                with suppress(subprocess.TimeoutExpired):
                    return process.wait(POLL_SECONDS)
                if not is_asked and (signals or stop.exists()):
                    # On Windows, it ends without saving and later continues from its checkpoint.
                    process.terminate() if IS_WINDOWS else process.send_signal(signal.SIGINT)
                    is_asked = True
        finally:
            # This has an effect only if an exception has ended the loop.
            process.kill()
            process.wait()


@contextmanager
def _signals() -> Iterator[list[int]]:
    """Yield a list to which signals are added as they arrive, unless this process already handles them.

    The process of the sweep itself handles signals in ``start.py``. In a worker of a launcher, SIGTERM and
    SIGHUP are collected here for the running job. Ctrl-C is ignored from now on, even between two jobs,
    because the process of the sweep handles it. The signal with which Slurm announces the end of a job's time
    is raised again once the job has saved, because the launcher then queues the job again.
    """
    received: list[int] = []
    unhandled = (signal.default_int_handler, signal.SIG_IGN, signal.SIG_DFL)
    is_handled = signal.getsignal(signal.SIGINT) not in unhandled
    if is_handled or threading.current_thread() is not threading.main_thread():
        yield received
        return
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    announcing = [number for number in ANNOUNCING if callable(signal.getsignal(number))]
    previous = {
        number: signal.signal(number, lambda number, _frame: received.append(number))
        for number in (*ENDING[1:], *announcing)
        if signal.getsignal(number) != signal.SIG_IGN  # as under nohup
    }
    try:
        yield received
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
    for number in set(received).intersection(announcing):
        signal.raise_signal(number)


def _record_outcome(folder: Path, code: int) -> None:
    """Write into ``summary.json`` how the process ended, unless training has written a complete summary."""
    summary = read_summary(folder)
    if is_complete(summary):
        return
    if code in STOPPED:
        outcome, message = Outcome.INTERRUPTED, "stopped"
    elif code < 0:
        outcome = Outcome.KILLED
        message = "by SIGKILL (out of memory?)" if code == -KILL else f"by signal {-code}"
    else:
        outcome, message = Outcome.FAILED, _failure_reason(folder / CONSOLE) or f"exit code {code}"
    write_json(folder / SUMMARY, {**summary, "outcome": str(outcome), "message": message})


def _failure_reason(console: Path) -> str:
    """Return why a process failed: its error message, or the last line of its traceback or its output."""
    with console.open("rb") as file:
        file.seek(max(0, console.stat().st_size - TAIL))
        lines = file.read().decode(errors="replace").split("\n")
    # A progress bar draws over itself, so only what follows the last carriage return of a line counts.
    printed = [text for line in lines if (text := line.rpartition("\r")[2].strip())]
    starts = [number for number, line in enumerate(printed) if line.startswith((MESSAGE, TRACEBACK))]
    if starts and printed[starts[-1]].startswith(MESSAGE):
        return " ".join(printed[starts[-1] :]).removeprefix(MESSAGE)
    return printed[-1] if printed else ""


def _end_with_sweep() -> None:
    """End this process when the sweep ends, if it is a worker that the sweep itself has started (joblib).

    Otherwise it would continue with its remaining jobs. The workers of Slurm and Ray are not started by the
    sweep and may continue after it has ended.
    """
    sweep = multiprocessing.parent_process()
    if sweep is None or sweep.pid is None or IS_WINDOWS:
        return
    end_with(os.getppid())
    try:
        os.kill(sweep.pid, 0)
    except ProcessLookupError:
        # The sweep has ended already, so the parent process will not change any more.
        os.kill(os.getpid(), KILL)


@cache  # starts one thread only
def end_with(parent: int) -> None:
    """End this process as soon as its parent process ends, so that it does not disturb a rerun of the sweep.

    This does nothing on Windows, where a process cannot detect the end of its parent.
    """

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1)
        os.kill(os.getpid(), KILL)

    if not IS_WINDOWS:
        threading.Thread(target=watch, daemon=True).start()
