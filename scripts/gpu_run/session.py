"""One call of ``scripts/gpu.py``: looks at the machine, continues the record and runs the requested parts."""

import hashlib
import os
import platform
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any

try:
    import fcntl
except ImportError:
    # Windows has no such locks.
    fcntl = None

from measuring import commit, first_line, processor

from gpu_run.machine import (
    REPOSITORY,
    Device,
    TroubleError,
    find_packages,
    find_tools,
    hash_sources,
)
from gpu_run.markdown import show, verdicts
from gpu_run.pieces import CHECKS, PARTS, Setup, plan
from gpu_run.record import ENDED, FAILED, Record, read_record
from gpu_run.runner import RESULT, Piece, Processes, Runner

# The interpreter of this run has the packages, and the one that is called python may not exist.
AGAIN = f"{shlex.quote(sys.executable)} scripts/gpu.py"
FACTS = (sys.executable, "-m", "gpu_run.on_device", "facts", "--json", RESULT)
# The first import of torch from a slow disk takes long.
FACTS_SECONDS = 60.0
# Finding the wrong stage includes compiling the emulator.
STAGES_SECONDS = 50.0
# Facts that results depend on, beside the files of the project.
STATE = ("device", "driver", "driver_cuda", "torch", "python", "packages")


@contextmanager
def alone(folder: Path) -> Iterator[None]:
    """Keep other runs out of the folder, because each would falsify the times and the record of the other.

    Raises :class:`TroubleError` if another one is there. Its end frees the folder, whatever ends it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "lock").open("w") as lock:
        if fcntl is not None:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise TroubleError(f"another run uses {folder}. Try: ps aux | grep gpu.py") from None
        yield


class Session:
    """One call of the command line, which may continue the results of earlier calls."""

    def __init__(self, folder: Path, device: Device, show_line: Callable[[str], None] | None = None) -> None:
        self._folder, self._device = folder, device
        self._show = show_line or (lambda line: print(line, flush=True))
        self._processes = Processes(folder / "logs", REPOSITORY)
        self._path = folder / "gpu.json"
        paths = [str(REPOSITORY), str(REPOSITORY / "scripts"), os.environ.get("PYTHONPATH", "")]
        # The processes import the project beside this script, and not another one that is installed.
        os.environ["PYTHONPATH"] = os.pathsep.join(path for path in paths if path)

    def run(self, parts: Sequence[str]) -> int:
        """Run the parts in order, and return the exit code."""
        with alone(self._folder):
            return self._run(parts)

    def _run(self, parts: Sequence[str]) -> int:
        machine = self._machine()
        self._show(f"{machine['device']}, torch {machine['torch']}, Python {machine['python']}")
        record = self._continue(machine)
        try:
            for part in parts:
                if part != CHECKS:
                    self._require_checks(record)
                self._show(f"{part}, at most {PARTS[part] / 60:.0f} minutes:")
                if not self.run_part(record, part):
                    self._show("The checks have failed, so nothing is timed.")
                    return 1
        finally:
            self._finish(record)
        is_whole = all(entry.status not in (FAILED, ENDED) for entry in record.pieces.values())
        return 0 if is_whole else 1

    def run_part(self, record: Record, part: str) -> bool:
        """Run one part; if a check fails, find out which stage of the kernels is wrong."""
        pieces = plan(self._setup(record), part)
        runner = Runner(record, self._path, self._processes, self._show)
        if runner.run(part, pieces, PARTS[part]):
            return True
        stages = self._setup(record).own("stages")
        runner.run(CHECKS, [Piece("stages", CHECKS, stages, STAGES_SECONDS)], STAGES_SECONDS)
        return False

    def _setup(self, record: Record) -> Setup:
        found = record.machine
        return Setup(
            self._folder,
            found["tools"],
            found["packages"],
            found["memory_bytes"],
            os.cpu_count() or 1,
            record,
        )

    def _machine(self) -> dict[str, Any]:
        """Return everything about the machine. Raises :class:`TroubleError` if torch cannot use the GPU."""
        packages = find_packages()
        if "torch" not in packages:
            raise TroubleError(
                f"expected torch in {sys.executable}, got none. Try: {sys.executable} -m pip install torch"
            )
        piece = Piece("machine", CHECKS, FACTS, FACTS_SECONDS)
        finished = self._processes.wait(self._processes.start(piece), FACTS_SECONDS)
        says = f"torch does not start: {finished.last_line}"
        if finished.code is None:
            # What is read from a disk once is read faster the next time.
            says = f"torch has not started in {FACTS_SECONDS:.0f} s. Try: {AGAIN}"
        facts = finished.result or {"trouble": says}
        if trouble := facts.pop("trouble", None):
            raise TroubleError(f"{self._device.name}: {trouble}")
        facts |= {
            "driver": first_line("nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"),
            "driver_cuda": self._device.driver_cuda,
            "devices": self._device.count,
            "processor": processor(),
            "python": platform.python_version(),
            "system": platform.platform(),
            "commit": commit(),
            "date": datetime.now().astimezone().isoformat(timespec="seconds"),
            "tools": find_tools(),
            "packages": packages,
        }
        return facts

    def _continue(self, machine: dict[str, Any]) -> Record:
        """Return the record of the folder if it still applies, and otherwise a new one."""
        parts = [hash_sources(), *(str(machine[key]) for key in STATE)]
        state = hashlib.sha256("\0".join(parts).encode()).hexdigest()[:16]
        if not self._path.exists():
            return Record(machine, state)
        record = read_record(self._path)
        if record.state == state:
            return Record(machine, state, record.pieces)
        old = self._path.with_name(f"gpu-{record.machine['date'].replace(':', '')[:17]}.json")
        self._path.replace(old)
        self._show(
            f"The GPU, a package or a file of the project has changed. The old results are in {old.name}."
        )
        return Record(machine, state)

    def _require_checks(self, record: Record) -> None:
        gates = [piece for piece in plan(self._setup(record), CHECKS) if piece.is_gate and not piece.missing]
        open_gates = [piece.name for piece in gates if not record.passed(piece.name)]
        if open_gates:
            raise TroubleError(
                f"expected that the checks have passed, got no pass of: {', '.join(open_gates)}. "
                f"Try: {AGAIN} --part checks"
            )

    def _finish(self, record: Record) -> None:
        record.machine["fastest"] = verdicts(record)
        record.write(self._path)
        text = show(record)
        self._path.with_suffix(".md").write_text(text, encoding="utf-8")
        statuses = [entry.status for entry in record.pieces.values()]
        counts = {status: statuses.count(status) for status in dict.fromkeys(statuses)}
        summary = ", ".join(f"{count} {status}" for status, count in counts.items()) or "nothing has run"
        self._show(f"{summary}. Results: {self._path} and {self._path.with_suffix('.md').name}")
