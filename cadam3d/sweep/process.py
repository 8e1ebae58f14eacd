"""Process: run one job of a sweep in a process of its own, so that whatever ends it ends nothing else.

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

from cadam3d.core.outcome import Outcome
from cadam3d.io.cache import TRACES
from cadam3d.io.jsonl import write_json
from cadam3d.io.lock import try_lock, unlock
from cadam3d.io.run_folder import CONSOLE, ENDED, LOCK, SHARED, STOP, SUMMARY, read_summary
from cadam3d.settings.compose import quote
from cadam3d.settings.line import RUN_FOLDER
from cadam3d.sweep.folder import Plan, Row, is_complete, read_plan, rows_of

POLL_SECONDS = 0.2
IS_WINDOWS = sys.platform == "win32"
STOPPED = (
    128 + signal.SIGINT,
    128 + signal.SIGTERM,
    -signal.SIGINT,
    -signal.SIGTERM,
)  # exit codes on request
# By one of these signals a launcher learns that it is about to be ended. Windows does not have them.
ANNOUNCING = tuple(getattr(signal, name) for name in ("SIGUSR1", "SIGUSR2") if hasattr(signal, name))
KILL = getattr(signal, "SIGKILL", signal.SIGTERM)
MESSAGE, TRACEBACK = "cadam3d: ", "Traceback (most recent call last)"  # how a reason begins
TAIL = 20_000  # bytes at the end of the console in which the reason of a failure is looked for


def run_job(sweep: Path, number: int) -> None:
    """Run job ``number`` of the sweep to its end, from its checkpoint if it has one.

    Do nothing if the sweep is being stopped or the job has a result. If another process works on the job,
    such as one that a killed sweep has left behind, wait until that has ended.
    """
    plan, stop = read_plan(sweep), sweep / STOP
    _end_with_sweep()
    if stop.exists():
        return
    folder = sweep / plan.jobs[number].folder
    folder.mkdir(parents=True, exist_ok=True)
    with _locked(folder, stop) as lock:
        row = rows_of(sweep, plan.jobs)[number]  # only now: the last holder of the lock may have changed it
        if lock is None or stop.exists() or row.has_result:
            return
        started = time.monotonic()
        if not row.has_checkpoint:  # files of an earlier attempt would be mistaken for new ones
            _empty(folder)
        for name in (SUMMARY, ENDED):
            (folder / name).unlink(missing_ok=True)
        code = _wait(plan, row, stop, lock)
        folder.mkdir(exist_ok=True)  # a run that was refused may have tidied up after itself
        _record_outcome(folder, code)
        write_json(folder / ENDED, {"exit_code": code, "seconds": round(time.monotonic() - started, 2)})


@contextmanager
def _locked(folder: Path, stop: Path) -> Iterator[int | None]:
    """Wait until no other process works on a job, and lock it; yield None if this process is to stop first.

    The process of the job inherits the lock, so the lock lasts as long as that process, even if this one is
    killed. (Windows does not pass on locks.)
    """
    with (folder / LOCK).open("w") as file:
        with _signals() as signals:
            while not (is_ours := try_lock(file)) and not signals and not stop.exists():
                time.sleep(POLL_SECONDS)
        try:
            yield file.fileno() if is_ours and not signals else None
        finally:
            if is_ours:  # to close the file is not enough if the job has left a process behind
                unlock(file)


def _empty(folder: Path) -> None:
    """Remove all but the lock: a process that waits for it must meet the same file under that name."""
    for path in folder.iterdir():
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        elif path.name != LOCK:
            path.unlink()


def _wait(plan: Plan, row: Row, stop: Path, lock: int) -> int:
    """Start the process, wait for it and return its exit code; minus the signal if one killed it."""
    words = [f"resume={quote(str(row.folder))}"] if row.has_checkpoint else row.overrides
    command = [sys.executable, "-m", "cadam3d.job", str(os.getpid()), "train", *words]
    command += [*plan.flags, f"{RUN_FOLDER}={quote(str(row.folder))}"]
    environment = dict(os.environ)
    # Set here while Hydra is at work. In the job, a mistake of the user is to be a single message.
    environment.pop("HYDRA_FULL_ERROR", None)
    environment.setdefault(TRACES, str(stop.with_name(SHARED)))
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
            start_new_session=True,  # else Ctrl-C would reach it twice, which means to stop at once
            pass_fds=() if IS_WINDOWS else (lock,),
        )
        is_asked = False
        try:
            while True:
                with suppress(subprocess.TimeoutExpired):
                    return process.wait(POLL_SECONDS)
                if not is_asked and (signals or stop.exists()):
                    _ask_to_stop(process)
                    is_asked = True
        finally:
            process.kill()  # only an exception leaves it running
            process.wait()


def _ask_to_stop(process: subprocess.Popen) -> None:
    """Let a job save and end. Windows cannot send it that signal: there the last checkpoint has to do."""
    if IS_WINDOWS:
        process.terminate()
    else:
        process.send_signal(signal.SIGINT)


@contextmanager
def _signals() -> Iterator[list[int]]:
    """Yield a list of the signals that arrive meanwhile, unless this process already handles them.

    The process of a sweep handles them itself. A worker of a launcher ignores Ctrl-C from now on, because it
    may come between two jobs; a SIGTERM is meant for the running job. The signal with which Slurm announces
    the end of a job's time is for the launcher, which queues the job again: it gets it once the job has
    saved.
    """
    received: list[int] = []
    is_ours = signal.getsignal(signal.SIGINT) in (signal.default_int_handler, signal.SIG_IGN, signal.SIG_DFL)
    if not is_ours or threading.current_thread() is not threading.main_thread():
        yield received
        return
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    announcing = [number for number in ANNOUNCING if callable(signal.getsignal(number))]
    previous = {
        number: signal.signal(number, lambda number, _frame: received.append(number))
        for number in (signal.SIGTERM, *announcing)
    }
    try:
        yield received
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
    for number in set(received).intersection(announcing):
        signal.raise_signal(number)


def _record_outcome(folder: Path, code: int) -> None:
    """Write into ``summary.json`` how the process ended, unless training itself has written all of it."""
    summary = read_summary(folder)
    if is_complete(summary):
        return
    if code in STOPPED:
        outcome, message = Outcome.INTERRUPTED, "stopped"
    elif code < 0:
        outcome = Outcome.KILLED
        message = f"by {_signal_name(-code)}" + " (out of memory?)" * (code == -KILL)
    else:
        outcome, message = Outcome.FAILED, _last_words(folder / CONSOLE) or f"exit code {code}"
    write_json(folder / SUMMARY, {**summary, "outcome": str(outcome), "message": message})


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


def _last_words(console: Path) -> str:
    """Return why a process failed, in its own words: its message, or the last line of its traceback."""
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

    Otherwise it would go on with the jobs it has been given. The sweep does not start the workers on Slurm
    and Ray, and they may outlive it.
    """
    sweep = multiprocessing.parent_process()
    if sweep is None or sweep.pid is None or IS_WINDOWS:
        return
    end_with(os.getppid())
    try:
        os.kill(sweep.pid, 0)
    except ProcessLookupError:  # the sweep has ended already, which the watch cannot notice
        os.kill(os.getpid(), KILL)


@cache  # one thread, however many jobs follow
def end_with(parent: int) -> None:
    """End this process as soon as its parent process ends, so that a rerun of the sweep is alone at work.

    Windows does not tell a process that its parent has ended, so this does nothing there.
    """

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1)
        os.kill(os.getpid(), KILL)

    if not IS_WINDOWS:
        threading.Thread(target=watch, daemon=True).start()
