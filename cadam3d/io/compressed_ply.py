"""Compressed PLY of SuperSplat: a quarter of the size of a PLY at SH degree 0, by rounding.

The Gaussians are in the order of a Morton curve through their positions, so that 256 consecutive ones, a
chunk, are close to each other. A chunk has bounds, and each of its Gaussians has four 32-bit integers. Fields
are listed from the highest bits to the lowest.

| element | property | content |
|---|---|---|
| ``chunk`` | ``min_x`` ... ``max_z`` | bounds of the positions, float32 |
| | ``min_scale_x`` ... ``max_scale_z`` | bounds of the natural logarithms of scales, float32, in [-20, 20] |
| | ``min_r`` ... ``max_b`` | bounds of the colours ``0.5 + C0 f_dc``, float32; [0, 1] if they are absent |
| ``vertex`` | ``packed_position`` | x, y, z in 11, 10 and 11 bits, 0 at the lower bound |
| | ``packed_rotation`` | index of the largest component of the unit quaternion (2 bits), and the other \
three in the order w, x, y, z (10 bits each, from -1/sqrt(2) to 1/sqrt(2)); the largest is positive |
| | ``packed_scale`` | logarithms of scales in 11, 10 and 11 bits |
| | ``packed_color`` | red, green, blue within the bounds and the opacity in [0, 1], 8 bits each |
| ``sh`` | ``f_rest_0`` ... | optional: higher SH coefficients, channel-major as in a PLY. A byte b means \
``8 ((b + 0.5) / 256 - 0.5)``, except that 0 means -4 and 255 means 4 |

The axes are a PLY's, -y up. A comment line records them for this program.

Lost are the order of the rows, the lengths of quaternions, SH coefficients outside of [-4, 4] and scales
outside of [2e-9, 5e8]. Rounding costs half a step: of a position 1/4094 of the extent of its chunk (1/2046
for y), of a quaternion's component 0.0007, of a colour 1/510 of the range in its chunk, of an opacity 1/510,
and 1/64 of a higher SH coefficient.

Sources: blog.playcanvas.com, "Compressing Gaussian Splats"; the header shown in pull request 82 of
github.com/sparkjsdev/spark (both layouts); and measurements. splat-transform 3.7.0 reads from a file written
here the same numbers as this module, to the bit, and the other way round.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch

from cadam3d.core.checks import require_choice
from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.sh import SH_C0
from cadam3d.io.atomic import replacing
from cadam3d.io.encoding import (
    LARGEST_OF_SMALLEST,
    as_tensor,
    byte_logits,
    in_file_axes,
    opacities,
    to_bytes,
    unit_quats,
)
from cadam3d.io.frames import UPS
from cadam3d.io.gathering import gathered
from cadam3d.io.ply import REST_SIZES, VERTEX, rest_size
from cadam3d.io.ply_tables import PlyHeader, columns, header_text, read_header, read_tables
from cadam3d.io.reading import unusable

CHUNK_ROWS = 256
POSITION_BOUNDS = ["min_x", "min_y", "min_z", "max_x", "max_y", "max_z"]
SCALE_BOUNDS = [f"{end}_scale_{axis}" for end in ("min", "max") for axis in "xyz"]
# Files of SuperSplat 1 do not have them.
COLOR_BOUNDS = ["min_r", "min_g", "min_b", "max_r", "max_g", "max_b"]
PACKED = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]
VECTOR_BITS = (11, 10, 11)
COLOR_BITS = (8, 8, 8, 8)
ROTATION_BITS = (10, 10, 10)
LARGEST_LOG_SCALE = 20.0
SH_RANGE = 8.0  # of coefficients, symmetric about 0
MORTON_BITS = 21  # per axis, so that three axes fit into 63 bits


def write_compressed_ply(path: Path, gaussians: Gaussians, *, up: str) -> None:
    """Write ``gaussians`` atomically, in the axes with up axis ``up`` (see ``frames.py``).

    The same Gaussians give the same bytes. Raises ``UserError`` if the file cannot be written, or if a number
    is NaN or infinite.
    """
    local = in_file_axes(gaussians, up)
    _require_finite(path, local)
    local = local.index(torch.from_numpy(morton_order(local.means.numpy())))
    starts = range(0, len(local), CHUNK_ROWS)
    positions = local.means.numpy()
    scales = np.clip(local.log_scales.numpy(), -LARGEST_LOG_SCALE, LARGEST_LOG_SCALE)
    colors = np.float32(0.5) + np.float32(SH_C0) * local.sh[:, 0].numpy()

    bounds = np.zeros((len(starts), 18), dtype="<f4")
    words = np.zeros((len(local), len(PACKED)), dtype="<u4")
    words[:, 1] = _packed_rotations(unit_quats(local))
    alphas = to_bytes(255 * opacities(local))
    for chunk, start in enumerate(starts):
        rows = slice(start, start + CHUNK_ROWS)
        shares = []
        for block, values in enumerate((positions, scales, colors)):
            low, high = values[rows].min(axis=0), values[rows].max(axis=0)
            bounds[chunk, 6 * block : 6 * block + 6] = [*low, *high]
            shares.append(_shares(values[rows], low, high))
        words[rows, 0] = _packed(shares[0], VECTOR_BITS)
        words[rows, 2] = _packed(shares[1], VECTOR_BITS)
        words[rows, 3] = _packed(shares[2], (8, 8, 8)) << 8 | alphas[rows]

    size = REST_SIZES[local.sh_degree]
    rest = local.sh[:, 1:].numpy().transpose(0, 2, 1).reshape(len(local), size)
    elements = {
        "chunk": (
            len(starts),
            [f"float {name}" for name in (*POSITION_BOUNDS, *SCALE_BOUNDS, *COLOR_BOUNDS)],
        ),
        VERTEX: (len(local), [f"uint {name}" for name in PACKED]),
    }
    if size:
        elements["sh"] = (len(local), [f"uchar f_rest_{i}" for i in range(size)])
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(header_text(up, elements))
        for block in (bounds, words, _sh_bytes(rest)):
            file.write(block.tobytes())


def read_compressed_ply(path: Path, *, up: str = "-y") -> Gaussians:
    """Read Gaussians into world axes, on the CPU, as float32.

    ``up`` is the up axis of files that do not record it; files of this project do. Raises ``UserError`` if
    ``path`` is not such a file, or has numbers that are not finite.
    """
    require_choice("up", up, UPS)
    header = read_header(path)
    size = rest_size(header, "sh")
    rest_names = [f"f_rest_{i}" for i in range(size)]
    chunk = header.element("chunk")
    has_colors = chunk is not None and set(COLOR_BOUNDS) <= set(chunk.names)
    limits = [*POSITION_BOUNDS, *SCALE_BOUNDS, *(COLOR_BOUNDS if has_colors else [])]
    wanted = {"chunk": limits, VERTEX: PACKED} | ({"sh": rest_names} if size else {})
    tables = read_tables(header, wanted)
    vertices, count = tables[VERTEX], len(tables[VERTEX])
    _require_layout(path, tables, rest_names)
    chunks = columns(tables["chunk"], limits)
    if not has_colors:
        chunks = np.pad(chunks, ((0, 0), (0, 6)))
        chunks[:, 15:] = 1

    # Bounds may be infinite, or differ by more than a float32 can hold; both are refused later.
    @np.errstate(over="ignore", invalid="ignore")
    def local(rows: slice) -> Gaussians:
        some = vertices[rows]
        # In float64, the difference of two bounds cannot overflow.
        bounds = chunks[np.arange(count)[rows] // CHUNK_ROWS].astype(np.float64)

        def within(name: str, block: int) -> np.ndarray:
            shares = _unpacked(some[name], VECTOR_BITS if block < 2 else COLOR_BITS)[:, :3]
            low, high = bounds[:, 6 * block : 6 * block + 3], bounds[:, 6 * block + 3 : 6 * block + 6]
            return low + shares * (high - low)

        sh = np.zeros((len(some), 1 + size // 3, 3))
        sh[:, 0] = (within("packed_color", 2) - 0.5) / SH_C0
        if rest_names:
            stored = np.stack([tables["sh"][rows][name] for name in rest_names], axis=1)
            sh[:, 1:] = _sh_values(stored).reshape(len(some), 3, size // 3).transpose(0, 2, 1)
        return Gaussians(
            means=as_tensor(within("packed_position", 0)),
            log_scales=as_tensor(within("packed_scale", 1)),
            quats=as_tensor(_unpacked_rotations(some["packed_rotation"])),
            opacity_logits=as_tensor(byte_logits((some["packed_color"] & 255).astype(np.uint8))),
            sh=as_tensor(sh),
        )

    return gathered(path, count, REST_SIZES.index(size), header.up or up, local)


def is_compressed(header: PlyHeader) -> bool:
    """Return whether a PLY file has the packed properties of a compressed PLY."""
    vertex = header.element(VERTEX)
    return vertex is not None and "packed_position" in vertex.names


def _require_layout(path: Path, tables: Mapping[str, np.ndarray], rest_names: Sequence[str]) -> None:
    """Raise ``UserError`` unless the tables have the types and numbers of rows of a compressed PLY."""
    vertices = tables[VERTEX]
    kinds = {vertices.dtype[name].str[1:] for name in PACKED}
    rest_kinds = {tables["sh"].dtype[name].str[1:] for name in rest_names}
    is_whole = len(tables["chunk"]) == -(-len(vertices) // CHUNK_ROWS)
    if rest_names:
        is_whole &= len(tables["sh"]) == len(vertices)
    if kinds != {"u4"} or not rest_kinds <= {"u1"} or not is_whole:
        problem = "its elements have other types or numbers of rows than the format"
        raise unusable(path, f"not a compressed ply: {problem}")


def _require_finite(path: Path, gaussians: Gaussians) -> None:
    if not all(bool(tensor.isfinite().all()) for tensor in gaussians.tensors().values()):
        raise UserError(f"{path}: expected finite numbers, got NaN or infinity. Try: 'exporter=[ply]'")


def morton_order(positions: np.ndarray) -> np.ndarray:
    """Return the indices [n] of positions [n 3] along a Morton curve, which keeps neighbours together."""
    if len(positions) == 0:
        return np.zeros(0, dtype=np.int64)
    exact = positions.astype(np.float64)
    low, high = exact.min(axis=0), exact.max(axis=0)
    cells = np.floor(_shares(exact, low, high) * (2**MORTON_BITS - 1)).astype(np.uint64)
    code = np.zeros(len(positions), dtype=np.uint64)
    for bit in range(MORTON_BITS):
        for axis in range(3):
            code |= (cells[:, axis] >> np.uint64(bit) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return np.argsort(code, kind="stable")


def _shares(values: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return where ``values`` are between ``low`` (0) and ``high`` (1), as float64; 0 if both are equal."""
    span = high.astype(np.float64) - low.astype(np.float64)
    return (values.astype(np.float64) - low) / np.where(span > 0, span, 1)


def _packed(shares: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    """Return numbers in [0, 1] as one integer for each row; the first column gets the highest bits."""
    words = np.zeros(len(shares), dtype=np.uint32)
    for column, size in enumerate(bits):
        top = (1 << size) - 1
        words = words << size | np.clip(np.rint(shares[:, column] * top), 0, top).astype(np.uint32)
    return words


def _unpacked(words: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    """Return the numbers in [0, 1] of integers; the inverse of :func:`_packed`."""
    columns = []
    for size in reversed(bits):
        columns.append((words & ((1 << size) - 1)) / ((1 << size) - 1))
        words = words >> size
    return np.stack(columns[::-1], axis=1)


def _packed_rotations(quats: np.ndarray) -> np.ndarray:
    """Return unit quaternions wxyz [n 4] as integers."""
    rows = np.arange(len(quats))
    largest = np.abs(quats).argmax(axis=1)
    # Both signs are the same rotation.
    quats = quats * np.where(quats[rows, largest] < 0, -1, 1)[:, None]
    others = quats[np.arange(4) != largest[:, None]].reshape(len(quats), 3)
    shares = others / (2 * LARGEST_OF_SMALLEST) + 0.5
    return largest.astype(np.uint32) << 30 | _packed(shares, ROTATION_BITS)


def _unpacked_rotations(words: np.ndarray) -> np.ndarray:
    """Return the quaternions wxyz [n 4] of integers."""
    others = (_unpacked(words, ROTATION_BITS) - 0.5) * (2 * LARGEST_OF_SMALLEST)
    missing = np.sqrt(np.maximum(1 - (others**2).sum(axis=1), 0))
    quats = np.empty((len(words), 4))
    is_largest = np.arange(4) == (words >> 30)[:, None]
    quats[~is_largest] = others.reshape(-1)
    quats[is_largest] = missing
    return quats


def _sh_bytes(rest: np.ndarray) -> np.ndarray:
    return np.clip(np.floor((rest.astype(np.float64) / SH_RANGE + 0.5) * 256), 0, 255).astype(np.uint8)


def _sh_values(stored: np.ndarray) -> np.ndarray:
    shares = np.where(stored == 255, 1.0, np.where(stored == 0, 0.0, (stored + 0.5) / 256))
    return SH_RANGE * (shares - 0.5)
