"""PLY files in the de-facto layout of 3D Gaussian Splatting, which every splat viewer opens.

The format is ``binary_little_endian 1.0`` with float32 properties ``x y z nx ny nz f_dc_0..2
f_rest_0..(3r-1) opacity scale_0..2 rot_0..3``. The numbers are raw: logits of opacity, natural logarithms of
scales, and quaternions wxyz of any length. There are ``r = (degree + 1)^2 - 1`` rest coefficients per
channel, stored channel-major (all of red, then green, then blue). Normals are zeros.

A comment line records the axes, so that files of this project are read back into world axes automatically.
Reading a file that was written here gives the same bits. The only exceptions are SH bands 2 and 3 in axes
other than ``+z`` (see ``frames.py``), which are rounded to float32 once when writing and once when reading.

A file with NaN or infinity is refused. Every finite number is accepted, however large: the quaternion (0, 0,
0, 0) means no rotation (``Gaussians.rotations``), and every rasterizer gives finite images of such Gaussians
(``tests/rasterizer/test_reference.py``). A file that is longer or shorter than its header claims is refused,
and reading never allocates more than a few times its size.
"""

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch

from cadam3d import __version__
from cadam3d.core.checks import require_choice
from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.sh import MAX_DEGREE
from cadam3d.io.atomic import replacing
from cadam3d.io.frames import UPS, file_to_world, world_to_file
from cadam3d.io.reading import open_regular

FORMAT = "binary_little_endian 1.0"
# The columns of each tensor that is stored without a change of layout.
COLUMNS = {
    "means": ["x", "y", "z"],
    "opacity_logits": ["opacity"],
    "log_scales": ["scale_0", "scale_1", "scale_2"],
    "quats": ["rot_0", "rot_1", "rot_2", "rot_3"],
}
# No reader uses the normals, but readers with a fixed record size expect them.
NORMALS = ["nx", "ny", "nz"]
SH0 = ["f_dc_0", "f_dc_1", "f_dc_2"]
# Properties that Gaussians have and plain points do not have.
GAUSSIANS_ONLY = {"f_dc_0", "scale_0", "rot_0", "packed_position"}
REST_SIZES = [3 * ((degree + 1) ** 2 - 1) for degree in range(MAX_DEGREE + 1)]
MAX_HEADER_BYTES = 1 << 16
MAX_DIGITS = 15  # of a number of rows
NUMPY_TYPES = {
    **dict.fromkeys(["char", "int8"], "<i1"),
    **dict.fromkeys(["uchar", "uint8"], "<u1"),
    **dict.fromkeys(["short", "int16"], "<i2"),
    **dict.fromkeys(["ushort", "uint16"], "<u2"),
    **dict.fromkeys(["int", "int32"], "<i4"),
    **dict.fromkeys(["uint", "uint32"], "<u4"),
    **dict.fromkeys(["float", "float32"], "<f4"),
    **dict.fromkeys(["double", "float64"], "<f8"),
}


def write_ply(path: Path, gaussians: Gaussians, *, up: str, pad_sh: int) -> None:
    """Write ``gaussians`` as float32, atomically, in the axes with up axis ``up`` (see ``frames.py``).

    ``pad_sh`` is the smallest SH degree of the file (0 to 3). Missing coefficients are written as zeros,
    which changes no colour but satisfies importers that require degree 3. Raises ``UserError`` if the file
    cannot be written.
    """
    require_choice("pad_sh", pad_sh, range(MAX_DEGREE + 1))
    local = world_to_file(gaussians.detach().to("cpu").to(torch.float32), up)
    arrays = {name: tensor.numpy() for name, tensor in local.tensors().items()}
    rest_size = REST_SIZES[max(pad_sh, local.sh_degree)]
    rest = np.zeros((len(local), 3, rest_size // 3), dtype=np.float32)
    rest[:, :, : local.sh.shape[1] - 1] = arrays["sh"][:, 1:].transpose(0, 2, 1)

    columns = [
        arrays["means"],
        np.zeros((len(local), len(NORMALS)), dtype=np.float32),
        arrays["sh"][:, 0],
        rest.reshape(len(local), rest_size),
        arrays["opacity_logits"][:, None],
        arrays["log_scales"],
        arrays["quats"],
    ]
    body = np.concatenate(columns, axis=1).astype("<f4", copy=False)
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(_header(len(local), rest_size, up).encode("ascii"))
        file.write(body.tobytes())


def read_ply(path: Path, *, up: str = "-y") -> Gaussians:
    """Read Gaussians into world axes, on the CPU, as float32.

    Properties are found by name, so their order, additional ones and missing normals do not matter. ``up`` is
    the up axis of files that do not record it; files of this project do. Raises ``UserError`` if ``path`` is
    not such a file, or has numbers that are not finite.
    """
    require_choice("up", up, UPS)
    try:
        with open_regular(path) as file:
            header = _parse_header(path, file)
            rows = _read_rows(path, file, header)
    # A name with a null byte is a ValueError.
    except (OSError, ValueError, MemoryError) as error:
        reason = getattr(error, "strerror", None) or error or "too large"
        raise UserError(f"{path}: cannot be read ({reason}). Try: another file") from error

    def columns(names: Sequence[str]) -> np.ndarray:
        # A double may be too large for a float; the infinity is refused below.
        with np.errstate(over="ignore"):
            found = [rows[name].astype(np.float32, copy=False) for name in names]
        return np.stack(found, axis=1) if found else np.zeros((len(rows), 0), dtype=np.float32)

    rest = columns([f"f_rest_{i}" for i in range(header.rest_size)])
    rest = rest.reshape(len(rows), 3, header.rest_size // 3)
    sh = np.concatenate([columns(SH0)[:, None], rest.transpose(0, 2, 1)], axis=1)
    local = Gaussians(
        means=torch.from_numpy(columns(COLUMNS["means"])),
        log_scales=torch.from_numpy(columns(COLUMNS["log_scales"])),
        quats=torch.from_numpy(columns(COLUMNS["quats"])),
        opacity_logits=torch.from_numpy(columns(COLUMNS["opacity_logits"])[:, 0].copy()),
        sh=torch.from_numpy(np.ascontiguousarray(sh)),
    )
    gaussians = file_to_world(local, header.up or up)
    _require_finite(path, gaussians)
    return gaussians


def holds_gaussians(path: Path) -> bool:
    """Return whether a PLY file has properties of Gaussians, complete or not, rather than of plain points.

    Raises ``UserError`` if ``path`` is not a PLY file.
    """
    try:
        with open_regular(path) as file:
            words = [line for line in _header_lines(path, file) if line[0] == "property"]
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise UserError(f"{path}: cannot be read ({reason}). Try: another file") from error
    return not GAUSSIANS_ONLY.isdisjoint(line[-1] for line in words)


def _names(rest_size: int) -> list[str]:
    rest = [f"f_rest_{i}" for i in range(rest_size)]
    last = [*COLUMNS["opacity_logits"], *COLUMNS["log_scales"], *COLUMNS["quats"]]
    return [*COLUMNS["means"], *NORMALS, *SH0, *rest, *last]


def _header(num_gaussians: int, rest_size: int, up: str) -> str:
    lines = [
        "ply",
        f"format {FORMAT}",
        f"comment cadam3d {__version__}",
        f"comment cadam3d up={up}",
        f"element vertex {num_gaussians}",
        *(f"property float {name}" for name in _names(rest_size)),
        "end_header",
    ]
    return "\n".join(lines) + "\n"


# Name, number of rows, and the name and numpy type of each property.
_Element = tuple[str, int, list[tuple[str, str]]]


@dataclass(frozen=True)
class _Header:
    """The header of a file."""

    skip_bytes: int  # size of the elements before the vertices
    count: int
    has_more: bool  # whether other elements follow the vertices
    record: np.dtype  # one vertex
    rest_size: int
    up: str | None  # up axis; None unless cadam3d wrote the file


def _parse_header(path: Path, file: BinaryIO) -> _Header:
    ups: set[str] = set()
    has_format = False
    elements: list[_Element] = []
    for words in _header_lines(path, file):
        match words:
            case ["format", *version] if not has_format:
                _require_format(path, " ".join(version))
                has_format = True
            case ["comment", "cadam3d", claim] if claim.startswith("up="):
                ups.add(_require_up(path, claim.removeprefix("up=")))
            case ["element", name, count] if has_format and count.isdecimal() and len(count) <= MAX_DIGITS:
                elements.append((name, int(count), []))
            case ["property", kind, name] if elements and kind in NUMPY_TYPES:
                elements[-1][2].append((name, NUMPY_TYPES[kind]))
            case ["property", "list", *_] if elements and any(e[0] == "vertex" for e in elements[:-1]):
                pass  # faces after the vertices are never read
            case ["comment" | "obj_info", *_]:
                pass
            case _:
                line = " ".join(words)[:80]
                raise _unusable(path, f"not a Gaussian ply: cannot read header line {line!r}")
    if len(ups) > 1:
        raise _unusable(path, f"the header has two up axes, {' and '.join(sorted(ups))}")
    return _located(path, elements, ups.pop() if ups else None)


def _located(path: Path, elements: Sequence[_Element], up: str | None) -> _Header:
    """Return where the vertices are among the elements of a file."""
    names = [name for name, *_ in elements]
    if len(set(names)) < len(names):
        raise _unusable(path, "not a Gaussian ply: an element appears twice")
    skip_bytes = 0
    for position, (name, count, properties) in enumerate(elements, start=1):
        if name == "vertex":
            has_more = position < len(elements)
            record, rest_size = _vertex(path, properties)
            return _Header(skip_bytes, count, has_more, record, rest_size, up)
        skip_bytes += count * sum(np.dtype(kind).itemsize for _, kind in properties)
    raise _unusable(path, "not a Gaussian ply: it has no vertices")


def _require_format(path: Path, version: str) -> None:
    convert = (
        f"from plyfile import PlyData; ply = PlyData.read('{path}'); "
        "ply.text = False; ply.byte_order = '<'; ply.write('binary.ply')"
    )
    if version != FORMAT:
        raise UserError(
            f"{path}: expected format {FORMAT}, got {version}. "
            f'Try: pip install plyfile && python -c "{convert}"'
        )


def _require_up(path: Path, up: str) -> str:
    if up not in UPS:
        raise _unusable(path, f"expected up={'|'.join(UPS)} in the header, got up={up}")
    return up


def _header_lines(path: Path, file: BinaryIO) -> Iterator[list[str]]:
    """Yield the words of each line between ``ply`` and ``end_header``."""
    line = file.readline(MAX_HEADER_BYTES)
    if line.strip() != b"ply":
        raise _unusable(path, f"not a ply file: it begins with {line[:16]!r}")
    while file.tell() < MAX_HEADER_BYTES:
        line = file.readline(MAX_HEADER_BYTES)
        if not line.endswith(b"\n"):
            break
        words = line.decode("ascii", errors="replace").split()
        if words == ["end_header"]:
            return
        if words:
            yield words
    raise _unusable(path, "truncated: the header has no end")


def _vertex(path: Path, properties: list[tuple[str, str]]) -> tuple[np.dtype, int]:
    """Return the record of one vertex, and the number of its rest coefficients."""
    names = [name for name, _ in properties]
    wanted = [*COLUMNS["means"], *SH0, *_names(0)[-8:]]
    missing = [name for name in wanted if name not in names]
    if missing:
        compressed = " (a compressed ply: decompress it first)" if "packed_position" in names else ""
        raise _unusable(path, f"not a Gaussian ply: properties missing: {', '.join(missing)}{compressed}")
    if len(set(names)) < len(names):
        raise _unusable(path, "not a Gaussian ply: a property appears twice")
    rest_size = sum(re.fullmatch(r"f_rest_\d+", name) is not None for name in names)
    if rest_size not in REST_SIZES or any(f"f_rest_{i}" not in names for i in range(rest_size)):
        sizes = ", ".join(map(str, REST_SIZES))
        raise _unusable(
            path,
            f"not a Gaussian ply: expected f_rest_0.. for SH degree 0 to {MAX_DEGREE} ({sizes} of them), "
            f"got {rest_size}",
        )
    return np.dtype(properties), rest_size


def _unusable(path: Path, problem: str) -> UserError:
    return UserError(f"{path}: {problem}. Try: another file")


def _read_rows(path: Path, file: BinaryIO, header: _Header) -> np.ndarray:
    start = file.tell() + header.skip_bytes
    available = file.seek(0, 2) - start
    length = header.count * header.record.itemsize
    if available < length:
        whole = max(available, 0) // header.record.itemsize
        problem = f"truncated: the header promises {header.count} Gaussians, the file holds {whole}"
        raise _unusable(path, problem)
    if available > length and not header.has_more:
        problem = f"the header promises {header.count} Gaussians, but {available - length} more bytes follow"
        raise _unusable(path, problem)
    file.seek(start)
    return np.frombuffer(file.read(length), dtype=header.record)


def _require_finite(path: Path, gaussians: Gaussians) -> None:
    finite = [
        tensor.isfinite().reshape(len(tensor), math.prod(tensor.shape[1:])).all(dim=1)
        for tensor in gaussians.tensors().values()
    ]
    is_finite = torch.stack(finite).all(dim=0)
    if bad := int((~is_finite).sum()):
        problem = f"expected finite numbers, got NaN or infinity in {bad} of {len(gaussians)} Gaussians"
        raise _unusable(path, problem)
