"""PLY container: the header of a PLY file, and the numbers of its elements in any of its three encodings.

A PLY file has a header in ASCII, which declares elements ("vertex", "face"). An element has a number of rows
and a list of properties, each with a name and a numeric type. The rows follow the header as text, one row on
each line, or as little-endian or big-endian binary records (G. Turk, "The PLY Polygon File Format", 1994).

Nothing is allocated because of a count in a header: the rows must be in the file first.
"""

import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import BinaryIO

import numpy as np

from cadam3d import __version__
from cadam3d.core.errors import UserError
from cadam3d.io.frames import UPS
from cadam3d.io.reading import opened, unusable

ASCII = "ascii 1.0"
LITTLE = "binary_little_endian 1.0"
BIG = "binary_big_endian 1.0"
ENCODINGS = (ASCII, LITTLE, BIG)
MAX_HEADER_BYTES = 1 << 16
MAX_DIGITS = 15  # of a number of rows
# Numpy types without their byte order.
NUMPY_TYPES = {
    **dict.fromkeys(["char", "int8"], "i1"),
    **dict.fromkeys(["uchar", "uint8"], "u1"),
    **dict.fromkeys(["short", "int16"], "i2"),
    **dict.fromkeys(["ushort", "uint16"], "u2"),
    **dict.fromkeys(["int", "int32"], "i4"),
    **dict.fromkeys(["uint", "uint32"], "u4"),
    **dict.fromkeys(["float", "float32"], "f4"),
    **dict.fromkeys(["double", "float64"], "f8"),
}
# Stands for a list in place of a numpy type.
LIST = "list"


@dataclass(frozen=True)
class Element:
    """One kind of row of a PLY file."""

    name: str
    count: int  # rows that the header promises
    properties: tuple[tuple[str, str], ...]  # name, and numpy type without byte order or LIST

    @property
    def names(self) -> list[str]:
        """Return the names of the properties, in their order in the file."""
        return [name for name, _ in self.properties]

    @property
    def row_bytes(self) -> int:
        """Return the size of one binary row. The properties must not be lists."""
        return sum(np.dtype(kind).itemsize for _, kind in self.properties)


@dataclass(frozen=True)
class PlyHeader:
    """The header of a PLY file."""

    path: Path
    encoding: str  # one of ENCODINGS
    elements: tuple[Element, ...]
    up: str | None  # up axis that cadam3d has recorded; None in files of other programs
    size: int  # bytes

    def element(self, name: str) -> Element | None:
        """Return the element called ``name``, or None."""
        return next((element for element in self.elements if element.name == name), None)


def header_text(up: str | None, elements: Mapping[str, tuple[int, Sequence[str]]]) -> bytes:
    """Return the header of a little-endian file of this project.

    ``elements`` are the numbers of rows and the types and names of properties, such as ``float x``, by the
    name of the element. ``up`` is the up axis to record, if any.
    """
    lines = ["ply", f"format {LITTLE}", f"comment cadam3d {__version__}"]
    lines += [] if up is None else [f"comment cadam3d up={up}"]
    for name, (count, properties) in elements.items():
        lines += [f"element {name} {count}", *(f"property {each}" for each in properties)]
    return "\n".join([*lines, "end_header\n"]).encode("ascii")


def read_header(path: Path) -> PlyHeader:
    """Return the header of a PLY file. Raises ``UserError`` if ``path`` is not one."""
    with opened(path) as file:
        return _parse_header(path, file)


def read_tables(header: PlyHeader, wanted: Mapping[str, Sequence[str]]) -> dict[str, np.ndarray]:
    """Return the ``wanted`` properties of elements as structured arrays, in the types that the file declares.

    Each element in ``wanted`` must be in the file. Raises ``UserError`` if the file has fewer rows than its
    header promises, has something after them that the header does not mention, or has text that is no number.
    """
    _require_readable(header, wanted)
    tables: dict[str, np.ndarray] = {}
    with opened(header.path) as file:
        file.seek(header.size)
        for element in header.elements:
            if tables.keys() == wanted.keys():
                return tables
            names = wanted.get(element.name)
            if header.encoding == ASCII:
                table = _read_text(header.path, file, element, names)
            else:
                table = _read_records(header, file, element, names)
            if table is not None:
                tables[element.name] = table
        _require_end(header, file)
    return tables


def _parse_header(path: Path, file: BinaryIO) -> PlyHeader:
    encoding: str | None = None
    ups: set[str] = set()
    elements: list[tuple[str, int, list[tuple[str, str]]]] = []
    for words in _header_lines(path, file):
        match words:
            case ["format", *version] if encoding is None:
                encoding = _require_one_of(path, ENCODINGS, "format", " ".join(version))
            case ["comment", "cadam3d", claim] if claim.startswith("up="):
                ups.add(_require_one_of(path, UPS, "up", claim.removeprefix("up=")))
            case ["element", name, count] if encoding and count.isdecimal() and len(count) <= MAX_DIGITS:
                elements.append((name, int(count), []))
            case ["property", *kind, name] if elements and (found := _kind(kind)):
                elements[-1][2].append((name, found))
            case ["comment" | "obj_info", *_]:
                pass
            case _:
                line = " ".join(words)[:80]
                raise unusable(path, f"not a readable ply file: cannot read header line {line!r}")
    if len(ups) > 1:
        raise unusable(path, f"the header has two up axes, {' and '.join(sorted(ups))}")
    names = [name for name, *_ in elements]
    if encoding is None or len(set(names)) < len(names):
        problem = "an element appears twice" if encoding else "its header has no format"
        raise unusable(path, f"not a readable ply file: {problem}")
    return PlyHeader(
        path=path,
        encoding=encoding,
        elements=tuple(Element(name, count, tuple(properties)) for name, count, properties in elements),
        up=ups.pop() if ups else None,
        size=file.tell(),
    )


def _kind(words: Sequence[str]) -> str | None:
    """Return the numpy type that the words before the name of a property declare, or LIST, or None."""
    if words[:1] == ["list"]:
        # The types of the length and of the items follow.
        return LIST if len(words) == 3 else None
    return NUMPY_TYPES.get(words[0]) if len(words) == 1 else None


def _header_lines(path: Path, file: BinaryIO) -> Iterator[list[str]]:
    """Yield the words of each line between ``ply`` and ``end_header``."""
    line = file.readline(MAX_HEADER_BYTES)
    if line.strip() != b"ply":
        raise unusable(path, f"not a ply file: it begins with {line[:16]!r}")
    while file.tell() < MAX_HEADER_BYTES:
        line = file.readline(MAX_HEADER_BYTES)
        if not line.endswith(b"\n"):
            break
        words = line.decode("ascii", errors="replace").split()
        if words == ["end_header"]:
            return
        if words:
            yield words
    raise unusable(path, "truncated: the header has no end")


def _require_one_of(path: Path, names: Sequence[str], what: str, got: str) -> str:
    """Return ``got``, the value of ``what`` in a header, if it is one of ``names``."""
    if got not in names:
        raise unusable(path, f"expected {what} {' | '.join(names)} in the header, got {got[:40]}")
    return got


def _require_readable(header: PlyHeader, wanted: Mapping[str, Sequence[str]]) -> None:
    """Check that every element up to the last of ``wanted`` has rows of a fixed size."""
    missing = set(wanted)
    for element in header.elements:
        if not missing:
            return
        missing.discard(element.name)
        names = element.names
        if LIST in (kind for _, kind in element.properties):
            raise unusable(header.path, f"expected numbers in element {element.name[:40]}, got a list")
        if element.name in wanted and len(set(names)) < len(names):
            raise unusable(header.path, f"a property of element {element.name} appears twice")


def _read_records(
    header: PlyHeader, file: BinaryIO, element: Element, names: Sequence[str] | None
) -> np.ndarray | None:
    """Return the rows of a binary element and move to its end; None if nothing of it is wanted."""
    length = element.count * element.row_bytes
    start = file.tell()
    available = max(file.seek(0, 2) - start, 0)
    if available < length:
        raise _truncated(header.path, element, available // element.row_bytes)
    if names is None:
        file.seek(start + length)
        return None
    file.seek(start)
    order = ">" if header.encoding == BIG else "<"
    record = np.dtype([(name, order + kind) for name, kind in element.properties])
    return np.frombuffer(file.read(length), dtype=record)


def _read_text(
    path: Path, file: BinaryIO, element: Element, names: Sequence[str] | None
) -> np.ndarray | None:
    """Return the rows of an element in text and move to its end; None if nothing of it is wanted."""
    # An element without properties has empty lines, which are skipped everywhere.
    count = element.count if element.properties else 0
    lines = islice(_lines(file), count)
    if names is None:
        if (found := sum(1 for _ in lines)) < count:
            raise _truncated(path, element, found)
        return None
    numbers = _parsed(path, lines, element, count)
    kinds = dict(element.properties)
    table = np.empty(count, dtype=[(name, kinds[name]) for name in names])
    for name in names:
        table[name] = _typed(path, numbers[:, element.names.index(name)], name, kinds[name])
    return table


def _lines(file: BinaryIO) -> Iterator[bytes]:
    """Yield the lines that are not empty."""
    return (line for line in file if line.strip())


def _parsed(path: Path, lines: Iterable[bytes], element: Element, count: int) -> np.ndarray:
    """Return the numbers of ``count`` lines as a matrix of float64, one row for each line."""
    width = len(element.properties)
    if count == 0:
        return np.empty((0, width))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # about a file without any row
            numbers = np.loadtxt(lines, dtype=np.float64, comments=None, ndmin=2, encoding="latin-1")
    except ValueError as error:
        # The rest is advice to programmers.
        raise unusable(path, f"element {element.name}: {str(error).split(';')[0][:120]}") from error
    if len(numbers) < count:
        raise _truncated(path, element, len(numbers))
    if numbers.shape[1] != width:
        expected = f"expected {width} numbers in each row of element {element.name}"
        raise unusable(path, f"{expected}, got {numbers.shape[1]}")
    return numbers


def _typed(path: Path, numbers: np.ndarray, name: str, kind: str) -> np.ndarray:
    """Return a column in its declared type. A float64 that is too large for float32 becomes infinite."""
    if kind[0] in "iu":
        limits = np.iinfo(kind)
        # A comparison with NaN is false.
        is_valid = (numbers >= limits.min) & (numbers <= limits.max) & (numbers == np.floor(numbers))
        if not is_valid.all():
            problem = f"expected {limits.min} to {limits.max} in property {name}"
            raise unusable(path, f"{problem}, got {numbers[~is_valid][0]:g}")
    with np.errstate(over="ignore", invalid="ignore"):
        return numbers.astype(kind)


def _require_end(header: PlyHeader, file: BinaryIO) -> None:
    last = header.elements[-1]
    what = _rows(last)
    if header.encoding == ASCII:
        if next(_lines(file), None) is not None:
            raise unusable(header.path, f"the header promises {last.count} {what}, but more lines follow")
        return
    start = file.tell()
    if extra := file.seek(0, 2) - start:
        raise unusable(header.path, f"the header promises {last.count} {what}, but {extra} more bytes follow")


def _truncated(path: Path, element: Element, found: int) -> UserError:
    return unusable(
        path, f"truncated: the header promises {element.count} {_rows(element)}, the file holds {found}"
    )


def _rows(element: Element) -> str:
    return "Gaussians" if element.name == "vertex" else f"rows of element {element.name[:40]}"
