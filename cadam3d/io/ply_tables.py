"""PLY container: the header of a PLY file, and the numbers of its elements in any of its three encodings.

A PLY file has a header in ASCII, which declares elements ("vertex", "face"). An element has a number of rows
and a list of properties, each with a name and a numeric type. The rows follow the header as text, one row on
each line, or as little-endian or big-endian binary records (G. Turk, "The PLY Polygon File Format", 1994).

Nothing is allocated because of a count in a header: the rows must be in the file first.
"""

import os
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import BinaryIO

import numpy as np

from cadam3d import __version__
from cadam3d.io.frames import UPS
from cadam3d.io.reading import opened, unusable

ASCII = "ascii 1.0"
LITTLE = "binary_little_endian 1.0"
BIG = "binary_big_endian 1.0"
ENCODINGS = (ASCII, LITTLE, BIG)
MAX_HEADER_BYTES = 1 << 16
MAX_DIGITS = 15  # of a number of rows
END = re.compile(rb"^end_header\s*?\n", re.MULTILINE)
# Numpy types without their byte order.
NUMPY_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float": "f4", "double": "f8", "float32": "f4", "float64": "f8",
}  # fmt: skip


@dataclass(frozen=True)
class Element:
    """One kind of row of a PLY file."""

    name: str
    count: int  # rows that the header promises
    properties: tuple[tuple[str, str | None], ...]  # name, and numpy type without byte order; None for a list

    @property
    def names(self) -> list[str]:
        """Return the names of the properties, in their order in the file."""
        return [name for name, _ in self.properties]


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
        head = file.read(MAX_HEADER_BYTES)
    end = END.search(head)
    if not head.startswith(b"ply") or end is None:
        raise unusable(path, "not a ply file: its header has no begin or no end")
    encoding, up = "", None
    elements: dict[str, tuple[int, list[tuple[str, str | None]]]] = {}
    for line in head[: end.start()].decode("ascii", errors="replace").split("\n")[1:]:
        match line.split():
            case ["format", *version] if not encoding and " ".join(version) in ENCODINGS:
                encoding = " ".join(version)
            case ["comment", "cadam3d", claim] if claim.startswith("up="):
                up = claim.removeprefix("up=")
            case ["element", name, count] if name not in elements and count.isdecimal():
                elements[name] = (int(count[:MAX_DIGITS]), [])
            case ["property", *kind, name] if elements:
                elements[list(elements)[-1]][1].append((name, NUMPY_TYPES.get(" ".join(kind))))
            case [] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise unusable(path, f"not a readable ply file: its header has the line {line[:80]!r}")
    if not encoding or up not in (None, *UPS):
        raise unusable(path, f"not a readable ply file: its header has the format {encoding!r} and up={up}")
    found = tuple(Element(name, count, tuple(kinds)) for name, (count, kinds) in elements.items())
    return PlyHeader(path=path, encoding=encoding, elements=found, up=up, size=end.end())


def read_tables(header: PlyHeader, wanted: Mapping[str, Sequence[str]]) -> dict[str, np.ndarray]:
    """Return the elements with the ``wanted`` properties as structured arrays, in the types of the file.

    The elements before them are returned too. Raises ``UserError`` if a property is missing, if the file has
    fewer rows than its header promises or something after them that the header does not mention, and for
    lists and text in place of numbers.
    """
    path = header.path
    for name, properties in wanted.items():
        element = header.element(name)
        missing = set(properties) - set(element.names if element else ())
        if missing or element is None:
            raise unusable(path, f"its element {name} has no properties {', '.join(sorted(missing))}")
    tables: dict[str, np.ndarray] = {}
    with opened(path) as file:
        file.seek(header.size)
        for element in header.elements:
            if wanted.keys() <= tables.keys():
                return tables
            if element.properties:
                tables[element.name] = _read_rows(header, file, element)
        if file.read().strip() if header.encoding == ASCII else file.read(1):
            raise unusable(path, "the file is longer than its header promises")
    return tables


def columns(table: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """Return properties as columns of float32 [n names]."""
    # A double may be too large for a float, and a NaN may warn; both are refused later.
    with np.errstate(over="ignore", invalid="ignore"):
        found = [table[name].astype(np.float32, copy=False) for name in names]
    return np.stack(found, axis=1) if found else np.zeros((len(table), 0), dtype=np.float32)


def _read_rows(header: PlyHeader, file: BinaryIO, element: Element) -> np.ndarray:
    """Return the rows of an element, and move to its end."""
    order = ">" if header.encoding == BIG else "<"
    # A property that appears twice is a ValueError too.
    try:
        record = np.dtype([(name, order + kind) for name, kind in element.properties if kind])
        if len(record.names or ()) < len(element.properties):
            raise ValueError("expected numbers, got a list")
        if header.encoding == ASCII:
            lines = islice((line for line in file if line.strip()), element.count)
            with warnings.catch_warnings():
                warnings.simplefilter(
                    "ignore"
                )  # about a file without any row, and numbers that are too large
                rows = np.loadtxt(lines, dtype=record, comments=None, ndmin=1, encoding="latin-1")
        else:
            # A header may promise any number of rows, and reading them would allocate as much.
            length = min(element.count * record.itemsize, os.fstat(file.fileno()).st_size)
            content = file.read(length)
            rows = np.frombuffer(content, record, count=len(content) // record.itemsize)
    except ValueError as error:
        raise unusable(header.path, f"element {element.name[:40]}: {str(error)[:120]}") from error
    if len(rows) < element.count:
        what = f"{element.count} rows of element {element.name[:40]}"
        raise unusable(header.path, f"truncated: the header promises {what}, the file holds {len(rows)}")
    return rows
