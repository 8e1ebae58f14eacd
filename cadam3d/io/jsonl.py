"""JSON that any reader accepts: whole files, written atomically, and logs with one object per line."""

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cadam3d.core.errors import UserError
from cadam3d.io.atomic import replacing


def append_jsonl(path: Path, line: Mapping[str, Any]) -> None:
    """Append one object as one line and flush it to the operating system, so that it survives ``kill -9``.

    NaN and infinities become null. If a kill has cut the last line of the file, that line is closed first.
    Raises ``UserError`` if the file cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("a+b") as file:
            is_cut = file.tell() > 0 and _last_byte(file) != b"\n"
            # With a single write call, a kill can only cut off the end, which the reader detects.
            file.write(b"\n" * is_cut + to_json(line).encode() + b"\n")
            file.flush()
    except OSError as error:
        reason = error.strerror or str(error)
        raise UserError(f"{path}: cannot be written ({reason}). Try: hydra.run.dir=DIR") from error


def read_jsonl(path: Path) -> list[dict[str, Any]]:
    """Return all objects of a log, oldest first; [] if there is no file yet.

    Lines that a kill has cut are left out without an error, so that the others can be used.
    """
    if not path.is_file():
        return []
    objects = []
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        try:
            value = json.loads(line)
        except json.JSONDecodeError:
            continue
        if isinstance(value, dict):
            objects.append(value)
    return objects


def truncate_after(path: Path, step: int) -> None:
    """Remove the lines of steps after ``step`` and lines that were cut; do nothing if there is no file.

    A resumed run calls this first because it will write those lines again.
    """
    if not path.is_file():
        return
    kept = [line for line in read_jsonl(path) if line.get("step", 0) <= step]
    with replacing(path) as temporary:
        temporary.write_text("".join(to_json(line) + "\n" for line in kept), encoding="utf-8")


def write_json(path: Path, value: Mapping[str, Any] | Sequence[Any]) -> None:
    """Write indented JSON atomically. NaN and infinities become null. Raises ``UserError`` on failure."""
    with replacing(path) as temporary:
        temporary.write_text(to_json(value, indent=2) + "\n", encoding="utf-8")


def read_json(path: Path) -> Any:
    """Return the value in a JSON file. Raises ``UserError`` if it is missing or not JSON."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        reason = error.strerror or str(error)
        raise UserError(
            f"{path}: cannot be read ({reason}). Try: run=RUN with the folder of a run"
        ) from error
    except ValueError as error:
        raise UserError(
            f"{path}: not valid JSON ({error}). Try: resume=RUN, which writes it again"
        ) from error


def to_json(value: Any, indent: int | None = None) -> str:
    """Return standard JSON, without the NaN and Infinity that Python would write."""
    return json.dumps(_standard(value), indent=indent, ensure_ascii=False, allow_nan=False)


def _standard(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): _standard(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_standard(item) for item in value]
    return str(value) if isinstance(value, Path) else value


def _last_byte(file) -> bytes:
    file.seek(-1, 2)
    return file.read(1)
