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

from pathlib import Path

import numpy as np
import torch

from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.sh import SH_C0
from cadam3d.io.atomic import replacing
from cadam3d.io.encoding import (
    LARGEST_OF_SMALLEST,
    as_tensor,
    byte_logits,
    in_file_axes,
    is_finite,
    opacities,
    smallest_three,
    unit_quats,
    with_largest,
)
from cadam3d.io.gathering import gathered
from cadam3d.io.ply import REST_SIZES, VERTEX, rest_size
from cadam3d.io.ply_tables import PlyHeader, columns, header_text, read_header, read_tables
from cadam3d.io.reading import unusable

CHUNK_ROWS = 256
# The bounds of positions, scales and colours. Files of SuperSplat 1 do not have those of colours.
BOUNDS = [
    f"{end}_{kind}{axis}"
    for kind, axes in (("", "xyz"), ("scale_", "xyz"), ("", "rgb"))
    for end in ("min", "max")
    for axis in axes
]
COLOR_BOUNDS = BOUNDS[12:]
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
    if not is_finite(local):
        raise UserError(f"{path}: expected finite numbers, got NaN or infinity. Try: 'exporter=[ply]'")
    local = local.index(torch.from_numpy(morton_order(local.means.numpy())))
    scales = np.clip(local.log_scales.numpy(), -LARGEST_LOG_SCALE, LARGEST_LOG_SCALE)
    colors = np.float32(0.5) + np.float32(SH_C0) * local.sh[:, 0].numpy()
    values = np.concatenate([local.means.numpy(), scales, colors], axis=1)

    starts = np.arange(0, len(local), CHUNK_ROWS)
    low, high = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
    bounds = np.stack([low.reshape(-1, 3, 3), high.reshape(-1, 3, 3)], axis=2)
    chunk = np.arange(len(local)) // CHUNK_ROWS
    shares = _shares(values, low[chunk], high[chunk])
    alphas = opacities(local)[:, None]
    largest, others = smallest_three(unit_quats(local))
    turns = _packed(others / (2 * LARGEST_OF_SMALLEST) + 0.5, ROTATION_BITS)
    words = [
        _packed(shares[:, :3], VECTOR_BITS),
        largest.astype(np.uint32) << 30 | turns,
        _packed(shares[:, 3:6], VECTOR_BITS),
        _packed(np.concatenate([shares[:, 6:], alphas], axis=1), COLOR_BITS),
    ]

    size = REST_SIZES[local.sh_degree]
    rest = local.sh[:, 1:].double().numpy().transpose(0, 2, 1)
    rest_bytes = np.clip(np.floor((rest / SH_RANGE + 0.5) * 256), 0, 255).astype(np.uint8)
    elements = {
        "chunk": (len(starts), [f"float {name}" for name in BOUNDS]),
        VERTEX: (len(local), [f"uint {name}" for name in PACKED]),
    }
    if size:
        elements["sh"] = (len(local), [f"uchar f_rest_{i}" for i in range(size)])
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(header_text(up, elements))
        for block in (bounds.astype("<f4"), np.stack(words, axis=1).astype("<u4"), rest_bytes):
            file.write(block.tobytes())


def read_compressed_ply(path: Path, *, up: str = "-y") -> Gaussians:
    """Read Gaussians into world axes, on the CPU, as float32.

    ``up`` is the up axis of files that do not record it; files of this project do. Raises ``UserError`` if
    ``path`` is not such a file, or has numbers that are not finite.
    """
    header = read_header(path)
    size = rest_size(header, "sh")
    rest_names = [f"f_rest_{i}" for i in range(size)]
    chunk = header.element("chunk")
    has_colors = chunk is not None and set(COLOR_BOUNDS) <= set(chunk.names)
    limits = BOUNDS if has_colors else BOUNDS[:12]
    wanted = {"chunk": limits, VERTEX: PACKED} | ({"sh": rest_names} if size else {})
    tables = read_tables(header, wanted)
    vertices, count = tables[VERTEX], len(tables[VERTEX])
    rest = tables["sh"] if size else vertices
    kinds = {vertices.dtype[name].str[1:] for name in PACKED}
    rest_kinds = {rest.dtype[name].str[1:] for name in rest_names}
    lengths = (len(tables["chunk"]), len(rest))
    if kinds != {"u4"} or not rest_kinds <= {"u1"} or lengths != (-(-count // CHUNK_ROWS), count):
        raise unusable(path, "not a compressed ply: its elements have other types or numbers of rows")
    # In float64, the difference of two bounds cannot overflow.
    bounds = columns(tables["chunk"], limits).astype(np.float64)
    if not has_colors:
        bounds = np.concatenate(
            [bounds, np.repeat([[0.0, 1.0]], 3, axis=1).repeat(len(bounds), axis=0)], axis=1
        )
    low, high = bounds.reshape(-1, 3, 2, 3).transpose(2, 0, 1, 3).reshape(2, -1, 9)

    # Bounds may be infinite, or differ by more than a float32 can hold; both are refused later.
    @np.errstate(over="ignore", invalid="ignore")
    def local(rows: slice) -> Gaussians:
        position, rotation, scale, color = (vertices[rows][name] for name in PACKED)
        channels = _unpacked(color, COLOR_BITS)[:, :3]
        shares = [_unpacked(position, VECTOR_BITS), _unpacked(scale, VECTOR_BITS), channels]
        chunk = np.arange(count)[rows] // CHUNK_ROWS
        values = low[chunk] + np.concatenate(shares, axis=1) * (high[chunk] - low[chunk])
        others = (_unpacked(rotation, ROTATION_BITS) - 0.5) * (2 * LARGEST_OF_SMALLEST)
        sh = np.zeros((len(color), 1 + size // 3, 3))
        sh[:, 0] = (values[:, 6:] - 0.5) / SH_C0
        if size:
            stored = np.stack([rest[rows][name] for name in rest_names], axis=1)
            shares = np.where(stored == 255, 1.0, np.where(stored == 0, 0.0, (stored + 0.5) / 256))
            sh[:, 1:] = (SH_RANGE * (shares - 0.5)).reshape(len(color), 3, size // 3).transpose(0, 2, 1)
        return Gaussians(
            means=as_tensor(values[:, :3]),
            log_scales=as_tensor(values[:, 3:6]),
            quats=as_tensor(with_largest(others, rotation >> 30)),
            opacity_logits=as_tensor(byte_logits((color & 255).astype(np.uint8))),
            sh=as_tensor(sh),
        )

    return gathered(path, count, header.up or up, local)


def is_compressed(header: PlyHeader) -> bool:
    """Return whether a PLY file has the packed properties of a compressed PLY."""
    vertex = header.element(VERTEX)
    return vertex is not None and "packed_position" in vertex.names


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
