"""Run pieces one after another: each in a process and with a time limit of its own, and none twice."""

import json
import os
import re
import shlex
import signal
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from gpu_run.record import ENDED, FAILED, PASSED, SKIPPED, Entry, Record

# In a command, the path of the JSON file with its results.
RESULT = "{result}"
# Of a line in the report; the log has the rest.
MOST_LETTERS = 300
# A piece that has less time left than this is not started.
LEAST_SECONDS = 15


@dataclass(frozen=True)
class Finished:
    """The result of a process; ``code`` is ``None`` if the process reached its time limit."""

    code: int | None
    log: str
    result: dict[str, Any] | None = None

    @property
    def last_line(self) -> str:
        """Return the last line of the log that is not empty."""
        lines = [line.strip() for line in self.log.splitlines() if line.strip()]
        return lines[-1] if lines else "no output"


def missing_in(log: str) -> str | None:
    """Return what a machine lacks for a piece that has failed; ``None`` if the log does not say so."""
    if missing := re.findall(r"^E?\s*ModuleNotFoundError: No module named '([^']+)'", log, re.MULTILINE):
        return f"not installed: {', '.join(dict.fromkeys(missing))}"
    if found := re.findall(r"^.*(?:OutOfMemoryError|CUDA out of memory).*$", log, re.MULTILINE):
        return f"not enough memory: {found[-1].strip()}"
    return None


# Returns a status and one line about it.
Judge = Callable[[Finished], tuple[str, str]]


def by_result(finished: Finished) -> tuple[str, str]:
    """Judge a script of this package by its exit code, with the line that its result contains."""
    if finished.result is None or "says" not in finished.result:
        return FAILED, f"exit code {finished.code}: {finished.last_line}"
    says = str(finished.result["says"])
    if finished.result.get("skipped"):
        return SKIPPED, says
    return (PASSED if finished.code == 0 else FAILED), says


@dataclass(frozen=True)
class Piece:
    """A part of a run that has its own process, time limit and entry in the record."""

    name: str
    part: str
    command: tuple[str, ...]
    seconds: float  # the time limit
    is_gate: bool = False  # whether times need it to pass
    missing: str | None = None  # why it cannot run here
    environment: Mapping[str, str] = field(default_factory=dict)
    judge: Judge = by_result
    # It starts with its part and may take as long as the part does.
    in_background: bool = False


@dataclass(frozen=True)
class Job:
    """A started process."""

    piece: Piece
    process: subprocess.Popen[bytes]
    log: Path
    result: Path
    began: float


class Processes:
    """Starts pieces as processes, and ends them."""

    def __init__(self, folder: Path, where: Path) -> None:
        self._folder, self._where = folder, where

    def start(self, piece: Piece) -> Job:
        """Start a piece in a group of its own, so that its children can be ended too."""
        self._folder.mkdir(parents=True, exist_ok=True)
        stem = piece.name.replace(" ", "_")
        log, result = self._folder / f"{stem}.log", self._folder / f"{stem}.json"
        result.unlink(missing_ok=True)
        command = [word.replace(RESULT, str(result)) for word in piece.command]
        with log.open("wb") as sink:
            process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=sink,
                stderr=subprocess.STDOUT,
                cwd=self._where,
                env={**os.environ, **piece.environment},
                start_new_session=True,
            )
        if piece.in_background and hasattr(os, "setpriority"):
            # It must not slow down the others so much that they meet their time limits. It may have ended.
            with suppress(OSError):
                os.setpriority(os.PRIO_PROCESS, process.pid, 19)
        return Job(piece, process, log, result, time.monotonic())

    def wait(self, job: Job, seconds: float) -> Finished:
        """Return the result of the process, and end the process after ``seconds``."""
        try:
            code = job.process.wait(timeout=max(seconds, 0.0))
        except subprocess.TimeoutExpired:
            code = None
        finally:
            # A process that has ended may have left children behind.
            end(job.process)
        result = None
        with suppress(OSError, ValueError):
            result = json.loads(job.result.read_text(encoding="utf-8"))
        return Finished(code, job.log.read_text(encoding="utf-8", errors="replace"), result)


def end(process: subprocess.Popen[bytes]) -> None:
    """End a process with all its children."""
    if hasattr(os, "killpg"):
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
    elif process.poll() is None:
        process.kill()
    process.wait()


class Runner:
    """Runs the pieces of a part that have not passed yet, within the time of the part."""

    def __init__(
        self, record: Record, path: Path, processes: Processes, show: Callable[[str], None] = print
    ) -> None:
        self._record, self._path, self._processes, self._show = record, path, processes, show

    def run(self, part: str, pieces: Sequence[Piece], seconds: float) -> bool:
        """Run the pieces of ``part``; return whether the run may go on, because no gate has failed."""
        deadline = time.monotonic() + seconds
        waiting = [piece for piece in pieces if piece.part == part]
        jobs = [
            self._processes.start(piece)
            for piece in waiting
            if piece.in_background and not self._is_done(piece)
        ]
        try:
            for piece in waiting:
                if piece.in_background or self._is_done(piece):
                    continue
                left = deadline - time.monotonic()
                if left < LEAST_SECONDS:
                    self._show(f"  {piece.name}: not started, because the time of this part is over")
                    continue
                self._collect(self._processes.start(piece), min(left, piece.seconds))
                if self._failed(piece):
                    return False
            for job in jobs:
                self._collect(job, min(deadline, job.began + job.piece.seconds) - time.monotonic())
        finally:
            for job in jobs:
                end(job.process)
        return not any(self._failed(piece) for piece in waiting)

    def _is_done(self, piece: Piece) -> bool:
        if piece.missing is not None:
            self._keep(piece, SKIPPED, piece.missing, 0.0)
            return True
        if self._record.passed(piece.name):
            self._show(f"  {piece.name}: kept, {self._record.pieces[piece.name].says}")
            return True
        return False

    def _failed(self, piece: Piece) -> bool:
        entry = self._record.pieces.get(piece.name)
        return piece.is_gate and entry is not None and entry.status in (FAILED, ENDED)

    def _collect(self, job: Job, seconds: float) -> None:
        finished = self._processes.wait(job, seconds)
        took = time.monotonic() - job.began
        if finished.code is None:
            status, says = ENDED, f"still running after {took:.0f} s; its last line: {finished.last_line}"
        else:
            status, says = job.piece.judge(finished)
            if status == FAILED and not job.piece.is_gate and (reason := missing_in(finished.log)):
                status, says = SKIPPED, reason
        self._keep(job.piece, status, says, took, finished.result)

    def _keep(
        self, piece: Piece, status: str, says: str, seconds: float, result: dict[str, Any] | None = None
    ) -> None:
        says = says if len(says) <= MOST_LETTERS else f"{says[:MOST_LETTERS]}..."
        self._show(f"  {piece.name}: {status}, {says}" + (f" ({seconds:.0f} s)" if seconds else ""))
        # A piece that runs again moves to the end, so the order is that of the run.
        self._record.pieces.pop(piece.name, None)
        self._record.pieces[piece.name] = Entry(
            part=piece.part,
            status=status,
            says=says,
            seconds=round(seconds, 1),
            date=datetime.now().astimezone().isoformat(timespec="seconds"),
            is_gate=piece.is_gate,
            command=shlex.join(piece.command),
            result=result,
        )
        self._record.write(self._path)
