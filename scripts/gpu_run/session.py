"""Run the pieces of a part one after another, keep what has passed, and write the record and its tables.

The record is one JSON file: the machine, a hash of all that the results depend on, and the outcome of every
piece in the order in which they ran.
"""

import hashlib
import json
import os
import platform
import re
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from measuring import commit, first_line, processor, table

from gpu_run.machine import REPOSITORY, Device, TroubleError, find_packages, find_tools, hash_sources
from gpu_run.pieces import PARTS, RESULT, Piece, most_processes, own, plan

PASSED, FAILED, SKIPPED = "passed", "FAILED", "skipped"
# The first import of torch from a slow disk takes long.
FACTS = Piece("machine", own("facts"), 60.0)
# Finding the wrong stage includes compiling the emulator.
STAGES = Piece("stages", own("stages"), 50.0)
# A piece that has less time left than this is not started.
LEAST_SECONDS = 15.0
# A line of a log which says that the machine lacks something.
LACKS = re.compile(r".*(?:No module named|OutOfMemoryError|out of memory|not supported|unable to).*")
MOST_LETTERS = 300  # of a line in the report; the log has the rest


def run(folder: Path, device: Device, parts: list[str]) -> int:
    """Run the parts in order and return the exit code. What has passed in the folder before is kept."""
    folder.mkdir(parents=True, exist_ok=True)
    # The processes import the project beside this script, and not another one that is installed.
    os.environ["PYTHONPATH"] = os.pathsep.join((str(REPOSITORY), str(REPOSITORY / "scripts")))
    record = begin(folder, device)
    print(f"{device.name}, {record['machine']['torch']}: {folder}", flush=True)
    for part in parts:
        print(f"{part}, at most {PARTS[part] / 60:.0f} minutes:", flush=True)
        pieces = plan_of(part, folder, device, record)
        if part != "checks":
            require_checks(plan_of("checks", folder, device, record), record)
        if not run_part(part, pieces, folder, record):
            print("A check has failed, so nothing else runs.")
            run_piece(part, STAGES, STAGES.seconds, folder, record)
            return 1
    return int(any(entry["status"] == FAILED for entry in record["pieces"].values()))


def plan_of(part: str, folder: Path, device: Device, record: dict[str, Any]) -> list[Piece]:
    """Return the pieces of a part on the machine of the record."""
    found = record["machine"]["packages"] | record["machine"]["tools"]
    return plan(part, folder, found, most_processes(device, os.cpu_count() or 1))


def begin(folder: Path, device: Device) -> dict[str, Any]:
    """Return the record of the folder if it still applies, and otherwise a new one.

    Raises :class:`TroubleError` if torch cannot use the GPU.
    """
    status, says, facts = run_process(FACTS, FACTS.seconds, folder)
    if status != PASSED:
        raise TroubleError(f"{device.name}: {says}")
    driver = first_line("nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader")
    machine = {**(facts or {}), "packages": find_packages(), "driver": driver}
    machine |= {"device": device.name, "driver_cuda": device.driver_cuda, "python": platform.python_version()}
    state = hashlib.sha256(f"{hash_sources()}{sorted(machine.items())}".encode()).hexdigest()[:16]
    machine |= {"processor": processor(), "commit": commit(), "tools": find_tools()}
    path = folder / "gpu.json"
    pieces = {}
    if path.is_file():
        old = json.loads(path.read_text(encoding="utf-8"))
        if old["state"] == state:
            pieces = old["pieces"]
        else:
            path.replace(path.with_name(f"gpu-{old['state']}.json"))
            print("The GPU, a package or a file of the project has changed. Everything is measured again.")
    return {"machine": machine, "state": state, "pieces": pieces}


def require_checks(checks: list[Piece], record: dict[str, Any]) -> None:
    """Raise :class:`TroubleError` unless all gates have passed or cannot run here."""
    missing = [
        piece.name
        for piece in checks
        if piece.is_gate and record["pieces"].get(piece.name, {}).get("status") not in (PASSED, SKIPPED)
    ]
    if missing:
        raise TroubleError(f"expected that the checks have passed, got no pass of {', '.join(missing)}")


def run_part(part: str, pieces: list[Piece], folder: Path, record: dict[str, Any]) -> bool:
    """Run the pieces that have not passed; return ``False`` as soon as a gate fails."""
    deadline = time.monotonic() + PARTS[part]
    for piece in pieces:
        left = deadline - time.monotonic()
        if record["pieces"].get(piece.name, {}).get("status") == PASSED:
            print(f"  {piece.name}: kept")
        elif left < LEAST_SECONDS:
            print(f"  {piece.name}: not started, because the time of this part is over")
        elif run_piece(part, piece, left, folder, record) == FAILED and piece.is_gate:
            return False
    return True


def run_piece(part: str, piece: Piece, left: float, folder: Path, record: dict[str, Any]) -> str:
    """Run a piece within the time that is left, write its outcome to the record, and return its status."""
    machine, started = record["machine"], time.monotonic()
    missing = [name for name in piece.needs if name not in machine["packages"] | machine["tools"]]
    if missing:
        status, says, result = SKIPPED, f"not installed: {', '.join(missing)}", None
    elif piece.after and record["pieces"].get(piece.after, {}).get("status") != PASSED:
        status, says, result = SKIPPED, f"needs a pass of {piece.after}", None
    else:
        status, says, result = run_process(piece, min(left, piece.seconds), folder)
    print(f"  {piece.name}: {status}, {says}", flush=True)
    # A piece that runs again moves to the end, so the order is that of the run.
    record["pieces"].pop(piece.name, None)
    seconds = round(time.monotonic() - started, 1)
    record["pieces"][piece.name] = {"part": part, "status": status, "says": says, "seconds": seconds}
    record["pieces"][piece.name]["result"] = result
    unfinished = folder / "gpu.part"
    unfinished.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    unfinished.replace(folder / "gpu.json")
    (folder / "gpu.md").write_text(markdown(record), encoding="utf-8")
    return status


def run_process(piece: Piece, seconds: float, folder: Path) -> tuple[str, str, dict[str, Any] | None]:
    """Return the status of a piece, one line about it and its results. It is ended after ``seconds``."""
    logs = folder / "logs"
    logs.mkdir(exist_ok=True)
    log, path = (logs / f"{piece.name.replace(' ', '_')}{suffix}" for suffix in (".log", ".json"))
    path.unlink(missing_ok=True)
    with log.open("wb") as sink:
        process = subprocess.Popen(
            [word.replace(RESULT, str(path)) for word in piece.command],
            stdin=subprocess.DEVNULL,
            stdout=sink,
            stderr=subprocess.STDOUT,
            cwd=REPOSITORY,
            env={**os.environ, **piece.environment},
            start_new_session=True,
        )
        try:
            code = process.wait(seconds)
        except subprocess.TimeoutExpired:
            code = None
        finally:
            # The children of the process are in its group.
            with suppress(ProcessLookupError, PermissionError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
    result = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else None
    return (*judge(piece, code, log.read_text(encoding="utf-8", errors="replace"), result), result)


def judge(piece: Piece, code: int | None, log: str, result: dict[str, Any] | None) -> tuple[str, str]:
    """Return the status of a piece that has ended, and one line about it; the code is ``None`` if it hung."""
    lines = [line.strip(" =") for line in log.splitlines() if line.strip(" =")] or ["no output"]
    if code is None:
        status = SKIPPED if piece.may_be_slow else FAILED
        return status, f"ended by its time limit; its last line: {lines[-1][:MOST_LETTERS]}"
    found = [line for line in lines if piece.expects and re.search(piece.expects, line)]
    says = (result or {}).get("says") or (found or lines)[-1]
    if code == 0 and (found or not piece.expects):
        return PASSED, says[:MOST_LETTERS]
    if not piece.is_gate and (lacking := LACKS.search(log)):
        return SKIPPED, lacking[0].strip()[:MOST_LETTERS]
    return FAILED, f"exit code {code}: {says[:MOST_LETTERS]}"


def markdown(record: dict[str, Any]) -> str:
    """Return the record as Markdown: the machine, the outcomes, and a table for each list of results."""
    machine = [{"machine": name, "": cell(value)} for name, value in record["machine"].items()]
    pieces = record["pieces"]
    outcomes = [
        {"piece": name, "status": entry["status"], "says": entry["says"].replace("|", "/")}
        for name, entry in pieces.items()
    ]
    texts = [table(machine), table(outcomes)]
    for name, entry in pieces.items():
        for rows in filter(is_table, (entry["result"] or {}).values()):
            shown = [{key: cell(value) for key, value in row.items()} for row in rows]
            texts.append(f"{name}\n\n{table(shown)}")
    fastest = [{key: cell(value) for key, value in row.items()} for row in fastest_backends(record)]
    texts += [f"Fastest backends\n\n{table(fastest)}"] if fastest else []
    return "\n\n".join([*texts, "Measured with `python scripts/gpu.py`; times are medians in ms.\n"])


def is_table(value: object) -> bool:
    """Return whether a result is a list of rows."""
    return isinstance(value, list) and bool(value) and all(isinstance(row, dict) for row in value)


def cell(value: object) -> str:
    """Return a value of the record for a cell of a table."""
    if isinstance(value, dict):
        return ", ".join(f"{name} {cell(each)}" for name, each in value.items())
    if isinstance(value, list):
        return " ".join(map(cell, value))
    return f"{value:.4g}" if isinstance(value, float) else "" if value is None else str(value)


def fastest_backends(record: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield the fastest backend of each timed scene, and whether it is the choice of ``rasterizer=auto``."""
    results = {name: entry["result"] or {} for name, entry in record["pieces"].items()}
    auto = results.get("choice of auto", {}).get("backend")
    scenes: dict[tuple[int, ...], list[dict[str, Any]]] = {}
    for row in (row for result in results.values() for row in result.get("rows", [])):
        if row["step_ms"] is not None:
            scenes.setdefault(tuple(row[key] for key in ("count", "size", "views", "degree")), []).append(row)
    for (count, size, views, degree), rows in scenes.items():
        first = min(rows, key=lambda row: row["step_ms"])["backend"]
        scene = {"count": count, "size": size, "views": views, "degree": degree}
        yield {**scene, "fastest": first, "choice of auto": auto, "is_auto_fastest": first == auto}
