"""JSON that any reader accepts: whole files, written atomically, and logs with one object per line."""

import json
import math
import os
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Annotated, Any, TypeGuard

from annotated_types import Ge, Le

from cadam3d.core.errors import UserError
from cadam3d.io.atomic import replacing
from cadam3d.io.reading import DEEPEST, LARGEST_TEXT, read_bytes

# Limits of numbers in the files of a run. Nothing real comes near them.
MOST = 10**12  # steps, Gaussians, bytes
LARGEST_NUMBER = 1e100  # that charts can draw
# The same limits, for :func:`fits`.
Whole = Annotated[int, Ge(0), Le(MOST)]
Real = Annotated[float, Ge(-LARGEST_NUMBER), Le(LARGEST_NUMBER)]


def append_jsonl(path: Path, line: Mapping[str, Any]) -> None:
    """Append one object as one line and flush it to the operating system, so that it survives ``kill -9``.

    NaN and infinities become null. If a kill has cut the last line of the file, that line is closed first.
    Raises ``UserError`` if the file cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("a+b") as file:
            file.seek(max(file.tell() - 1, 0))
            is_cut = file.read() not in (b"", b"\n")
            # With a single write call, a kill can only cut off the end, which the reader detects.
            file.write(b"\n" * is_cut + to_json(line).encode() + b"\n")
    except OSError as error:
        reason = error.strerror or str(error)
        raise UserError(f"{path}: cannot be written ({reason}). Try: hydra.run.dir=DIR") from error


def read_jsonl(path: Path) -> list[dict[str, Any]]:
    """Return all objects of a log, oldest first; [] if there is no file yet.

    Lines that a kill has cut, and lines that are not plain JSON, are left out without an error, so that the
    others can be used. Raises ``UserError`` if the file cannot be read.
    """
    if not os.path.lexists(path):
        return []
    objects = []
    for line in read_bytes(path, largest=LARGEST_TEXT).split(b"\n"):
        try:
            value = parse_json(line)
        except ValueError:
            continue
        if isinstance(value, dict):
            objects.append(value)
    return objects


def truncate_after(path: Path, step: int) -> None:
    """Remove the lines of steps after ``step`` and damaged lines; do nothing if there is no file.

    A resumed run calls this first because it will write those lines again. A line whose ``step`` is not a
    whole number is damaged.
    """
    if not os.path.lexists(path):
        return
    lines = [(line.get("step", 0), line) for line in read_jsonl(path)]
    kept = [line for at, line in lines if is_whole(at) and at <= step]
    with replacing(path) as temporary:
        temporary.write_text("".join(to_json(line) + "\n" for line in kept), encoding="utf-8")


def write_json(path: Path, value: Mapping[str, Any] | Sequence[Any]) -> None:
    """Write indented JSON atomically. NaN and infinities become null. Raises ``UserError`` on failure."""
    with replacing(path) as temporary:
        temporary.write_text(to_json(value, indent=2) + "\n", encoding="utf-8")


def read_json(path: Path) -> Any:
    """Return the value in a JSON file.

    Raises ``UserError`` if it is missing, or not plain JSON: UTF-8, without NaN and infinities.
    """
    content = read_bytes(path, largest=LARGEST_TEXT)
    try:
        return parse_json(content)
    except ValueError as error:
        reason = " ".join(str(error).split())[:200]
        raise UserError(
            f"{path}: not valid JSON ({reason}). Try: cadam3d train resume=RUN, which writes it again"
        ) from error


def is_whole(value: object) -> TypeGuard[int]:
    """Return whether ``value`` from a JSON file is a count: a whole number from 0 to 10^12."""
    return type(value) is int and 0 <= value <= MOST


def is_number(value: object) -> TypeGuard[float]:
    """Return whether ``value`` from a JSON file is a number that can be drawn: at most 10^100 in size."""
    return type(value) in (int, float) and abs(value) <= LARGEST_NUMBER  # pyright: ignore[reportArgumentType]


def fits(value: object, kind: Any) -> bool:
    """Return whether ``value`` is of a ``kind``, an annotation that pydantic checks without conversions."""
    try:
        adapter_of(kind).validate_python(value, strict=True)
    except ValueError:
        return False
    return True


@cache
def adapter_of(kind: Any) -> Any:
    """Return pydantic's ``TypeAdapter`` of a type, which takes a millisecond to make."""
    from pydantic import TypeAdapter  # takes a tenth of a second to load

    return TypeAdapter(kind)


def to_json(value: Any, indent: int | None = None) -> str:
    """Return standard JSON, without the NaN and Infinity that Python would write."""
    return json.dumps(_standard(value), indent=indent, ensure_ascii=False, allow_nan=False)


def parse_json(content: bytes) -> Any:
    """Return the value of a JSON text. Raises ``ValueError`` for any other text, and for too many levels."""
    try:
        value = json.loads(content.decode("utf-8"))
    except RecursionError as error:
        raise ValueError(f"more than {DEEPEST} levels") from error
    if content.count(b"[") + content.count(b"{") > DEEPEST:
        _require_shallow(value)
    # This raises the same error for NaN, infinities and half of a character pair, which JSON can spell.
    json.dumps(value, ensure_ascii=False, allow_nan=False).encode("utf-8")
    return value


def _require_shallow(value: Any) -> None:
    """Raise ``ValueError`` if containers are deeper than any program writes, because many readers recurse."""
    level = [value]
    for _ in range(DEEPEST + 1):
        nodes = [node for node in level if isinstance(node, (dict, list))]
        level = [each for node in nodes for each in (node.values() if isinstance(node, dict) else node)]
        if not level:
            return
    raise ValueError(f"more than {DEEPEST} levels")


def _standard(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): _standard(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_standard(item) for item in value]
    return str(value) if isinstance(value, Path) else value
