"""One job of a sweep as a process of its own, so that whatever ends it ends nothing else.

This side waits for it, passes on the wish to stop, and writes down how it ended. What runs in the process is
``cadam3d train``, started through this module's last lines, which make it end with the sweep.
"""

import fcntl
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import IO

from cadam3d.core.outcome import Outcome
from cadam3d.io.cache import TRACES
from cadam3d.io.jsonl import write_json
from cadam3d.settings.compose import quote
from cadam3d.sweep.folder import (
    CONSOLE,
    ENDED,
    LOCK,
    STOP,
    SUMMARY,
    TRACED,
    Plan,
    Row,
    is_complete,
    read_plan,
    read_summary,
    rows_of,
)

POLL_SECONDS = 0.2
STOPPED = (128 + signal.SIGINT, 128 + signal.SIGTERM, -signal.SIGINT, -signal.SIGTERM)  # exit codes: asked to
ANNOUNCING = (signal.SIGUSR1, signal.SIGUSR2)  # that a launcher is about to end the job
MESSAGE, TRACEBACK = "cadam3d: ", "Traceback (most recent call last)"  # how a reason begins
TAIL = 20_000  # bytes of the console in which the reason of a failure is looked for


def run_job(sweep: Path, number: int) -> None:
    """Run job ``number`` of the sweep to its end, from its checkpoint if it has one.

    Nothing happens if the sweep is being stopped or the job has a result. If another process is at work on
    the job, such as one that a killed sweep has left behind, this waits until that has ended.
    """
    plan, stop = read_plan(sweep), sweep / STOP
    _end_with_sweep()
    if stop.exists():
        return
    folder = sweep / plan.jobs[number].folder
    folder.mkdir(parents=True, exist_ok=True)
    with _locked(folder, stop) as lock:
        row = rows_of(sweep, plan.jobs)[number]  # not before: who held the lock may have brought it further
        if lock is None or stop.exists() or row.has_result:
            return
        started = time.monotonic()
        if not row.has_checkpoint:  # half-made files of an earlier attempt would be taken for this one's
            _empty(folder)
        for name in (SUMMARY, ENDED):
            (folder / name).unlink(missing_ok=True)
        code = _wait(plan, row, stop, lock)
        folder.mkdir(exist_ok=True)  # a run that was refused may have tidied up after itself
        _note_outcome(folder, code)
        write_json(folder / ENDED, {"exit_code": code, "seconds": round(time.monotonic() - started, 2)})


@contextmanager
def _locked(folder: Path, stop: Path) -> Iterator[int | None]:
    """Keep all others off a job, once they have left it; None if this one is to stop before that.

    The process of the job inherits the lock, which so lasts as long as that one, even if this one is killed.
    """
    with (folder / LOCK).open("w") as file:
        with _signals() as signals:
            while not (is_ours := _try_lock(file)) and not signals and not stop.exists():
                time.sleep(POLL_SECONDS)
        try:
            yield file.fileno() if is_ours and not signals else None
        finally:
            if is_ours:  # closing is not enough if the job has left somebody behind who inherited it too
                with suppress(OSError):
                    fcntl.flock(file, fcntl.LOCK_UN)


def _try_lock(file: IO[str]) -> bool:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a file system without locks
        pass
    return True


def _empty(folder: Path) -> None:
    """Remove all but the lock, which would be no lock if others met another file by its name."""
    for path in folder.iterdir():
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        elif path.name != LOCK:
            path.unlink()


def _wait(plan: Plan, row: Row, stop: Path, lock: int) -> int:
    """Start the process, wait for it and return its exit code; minus the signal if one killed it."""
    words = [f"resume={quote(str(row.folder))}"] if row.has_checkpoint else row.overrides
    command = [sys.executable, "-m", __name__, str(os.getpid()), "train", *words]
    command += [*plan.flags, f"hydra.run.dir={quote(str(row.folder))}"]
    environment = dict(os.environ)
    environment.pop(
        "HYDRA_FULL_ERROR", None
    )  # set while Hydra is at work here: a mistake is one message there
    environment.setdefault(TRACES, str(stop.with_name(TRACED)))
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
            start_new_session=True,  # Ctrl-C reaches it through us only: twice would mean at once
            pass_fds=(lock,),
        )
        is_told = False
        try:
            while True:
                with suppress(subprocess.TimeoutExpired):
                    return process.wait(POLL_SECONDS)
                if not is_told and (signals or stop.exists()):
                    process.send_signal(signal.SIGINT)
                    is_told = True
        finally:
            process.kill()  # only an exception leaves it running
            process.wait()


@contextmanager
def _signals() -> Iterator[list[int]]:
    """The signals that came meanwhile, if nobody in this process has taken charge of them.

    In the process of the sweep its own handler is in charge. A worker of a launcher leaves Ctrl-C to that
    one, for good, since it may come between two jobs; a SIGTERM is for the job that runs. The signal by which
    Slurm announces that time is up is the launcher's, to queue the job again: once the job has saved.
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


def _note_outcome(folder: Path, code: int) -> None:
    """Leave in ``summary.json`` how the process ended, unless training itself has told all."""
    summary = read_summary(folder)
    if is_complete(summary):
        return
    if code in STOPPED:
        outcome, message = Outcome.INTERRUPTED, "stopped"
    elif code < 0:
        outcome = Outcome.KILLED
        message = f"by {_signal_name(-code)}" + " (out of memory?)" * (code == -signal.SIGKILL)
    else:
        outcome, message = Outcome.FAILED, _last_words(folder / CONSOLE) or f"exit code {code}"
    write_json(folder / SUMMARY, {**summary, "outcome": str(outcome), "message": message})


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


def _last_words(console: Path) -> str:
    """Why a process failed, in its own words: its message, or the last line of its traceback."""
    with console.open("rb") as file:
        file.seek(max(0, console.stat().st_size - TAIL))
        lines = file.read().decode(errors="replace").split("\n")
    said = [line.rpartition("\r")[2].strip() for line in lines]  # a progress bar draws over itself
    said = [line for line in said if line]
    starts = [number for number, line in enumerate(said) if line.startswith((MESSAGE, TRACEBACK))]
    if starts and said[starts[-1]].startswith(MESSAGE):
        return " ".join(said[starts[-1] :]).removeprefix(MESSAGE)
    return said[-1] if said else ""


def _end_with_sweep() -> None:
    """In a worker that the sweep itself has made, as joblib does: end at once when the sweep is gone.

    Otherwise it would go on with the jobs it has been given. Workers on Slurm and Ray are not made by the
    sweep, and may outlive it.
    """
    sweep = multiprocessing.parent_process()
    if sweep is None or sweep.pid is None:
        return
    _end_with(os.getppid())
    try:
        os.kill(sweep.pid, 0)
    except ProcessLookupError:  # before the first job, so that nobody will see it go
        os.kill(os.getpid(), signal.SIGKILL)


@cache  # one thread, however many jobs come
def _end_with(parent: int) -> None:
    """End this process at once when ``parent`` is gone: the sweep, run again, must find nobody at work."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1)
        os.kill(os.getpid(), signal.SIGKILL)

    threading.Thread(target=watch, daemon=True).start()


def main(words: Sequence[str]) -> None:
    """``cadam3d`` with ``words[1:]``, for as long as process ``words[0]`` lives."""
    for number in ANNOUNCING:  # Slurm tells all processes; the job hears of it through its launcher
        signal.signal(number, signal.SIG_IGN)
    from cadam3d import cli

    _end_with(int(words[0]))
    sys.argv = ["cadam3d", *words[1:]]
    cli.main()


if __name__ == "__main__":
    main(sys.argv[1:])
