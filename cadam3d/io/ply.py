"""PLY files in the de-facto layout of 3D Gaussian Splatting, which every splat viewer opens.

The format is ``binary_little_endian 1.0`` with float32 properties ``x y z nx ny nz f_dc_0..2
f_rest_0..(3r-1) opacity scale_0..2 rot_0..3``. The numbers are raw: logits of opacity, natural logarithms of
scales, and quaternions wxyz of any length. There are ``r = (degree + 1)^2 - 1`` rest coefficients per
channel, stored channel-major (all of red, then green, then blue). Normals are zeros.

Files of other programs are read in all three encodings of PLY (little-endian, big-endian, text), with their
properties in any order and of any numeric type, without normals, and with other properties and elements.

A comment line records the axes, so that files of this project are read back into world axes automatically.
Reading a file that was written here gives the same bits. The only exceptions are SH bands 2 and 3 in axes
other than ``+z`` (see ``frames.py``), which are rounded to float32 once when writing and once when reading.

A file with NaN or infinity is refused, except for an infinite ``opacity`` of another program, which means 0
or 1. Every finite number is accepted, however large: the quaternion (0, 0, 0, 0) means no rotation
(``Gaussians.rotations``), and every rasterizer gives finite images of such Gaussians
(``tests/rasterizer/test_reference.py``). A file that is longer or shorter than its header claims is refused,
and reading never allocates more than a few times its size.
"""

import re
from pathlib import Path

import numpy as np

from cadam3d.core.checks import require_choice
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.sh import MAX_DEGREE
from cadam3d.io.atomic import replacing
from cadam3d.io.encoding import as_tensor, in_file_axes
from cadam3d.io.gathering import gathered
from cadam3d.io.ply_tables import PlyHeader, columns, header_text, read_header, read_tables
from cadam3d.io.reading import unusable

VERTEX = "vertex"
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
REQUIRED = [*COLUMNS["means"], *SH0, *COLUMNS["opacity_logits"], *COLUMNS["log_scales"], *COLUMNS["quats"]]
# Properties that Gaussians have and plain points do not have.
GAUSSIANS_ONLY = {"f_dc_0", "scale_0", "rot_0", "packed_position"}
REST_SIZES = [3 * ((degree + 1) ** 2 - 1) for degree in range(MAX_DEGREE + 1)]
COLORS = ["red", "green", "blue"]  # of plain points
INFINITE_LOGIT = 20.0  # its opacity is 1 in float32


def write_ply(path: Path, gaussians: Gaussians, *, up: str, pad_sh: int) -> None:
    """Write ``gaussians`` as float32, atomically, in the axes with up axis ``up`` (see ``frames.py``).

    ``pad_sh`` is the smallest SH degree of the file (0 to 3). Missing coefficients are written as zeros,
    which changes no colour but satisfies importers that require degree 3. Raises ``UserError`` if the file
    cannot be written.
    """
    require_choice("pad_sh", pad_sh, range(MAX_DEGREE + 1))
    local = in_file_axes(gaussians, up)
    arrays = {name: tensor.numpy() for name, tensor in local.tensors().items()}
    rest_size = REST_SIZES[max(pad_sh, local.sh_degree)]
    rest = np.zeros((len(local), 3, rest_size // 3), dtype=np.float32)
    rest[:, :, : local.sh.shape[1] - 1] = arrays["sh"][:, 1:].transpose(0, 2, 1)

    blocks = [
        arrays["means"],
        np.zeros((len(local), len(NORMALS)), dtype=np.float32),
        arrays["sh"][:, 0],
        rest.reshape(len(local), rest_size),
        arrays["opacity_logits"][:, None],
        arrays["log_scales"],
        arrays["quats"],
    ]
    names = [*COLUMNS["means"], *NORMALS, *SH0, *(f"f_rest_{i}" for i in range(rest_size))]
    names += [*COLUMNS["opacity_logits"], *COLUMNS["log_scales"], *COLUMNS["quats"]]
    body = np.concatenate(blocks, axis=1).astype("<f4", copy=False)
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(header_text(up, {VERTEX: (len(local), [f"float {name}" for name in names])}))
        file.write(body.tobytes())


def read_ply(path: Path, *, up: str = "-y") -> Gaussians:
    """Read Gaussians into world axes, on the CPU, as float32.

    Properties are found by name, so their order, additional ones and missing normals do not matter. ``up`` is
    the up axis of files that do not record it; files of this project do. Raises ``UserError`` if ``path`` is
    not such a file, or has numbers that are not finite.
    """
    header = read_header(path)
    size = rest_size(header, VERTEX)
    rest = [f"f_rest_{i}" for i in range(size)]
    table = read_tables(header, {VERTEX: [*REQUIRED, *rest]})[VERTEX]

    def local(rows: slice) -> Gaussians:
        some = table[rows]
        higher = columns(some, rest).reshape(len(some), 3, size // 3).transpose(0, 2, 1)
        opacities = columns(some, COLUMNS["opacity_logits"])[:, 0]
        # splat-transform 3.7.0 writes infinity when it unpacks the opacities 0 and 255 of a compressed PLY.
        if not header.up:
            limit = np.copysign(np.float32(INFINITE_LOGIT), opacities)
            opacities = np.where(np.isinf(opacities), limit, opacities)
        return Gaussians(
            means=as_tensor(columns(some, COLUMNS["means"])),
            log_scales=as_tensor(columns(some, COLUMNS["log_scales"])),
            quats=as_tensor(columns(some, COLUMNS["quats"])),
            opacity_logits=as_tensor(opacities),
            sh=as_tensor(np.concatenate([columns(some, SH0)[:, None], higher], axis=1)),
        )

    return gathered(path, len(table), header.up or up, local)


def holds_gaussians(path: Path) -> bool:
    """Return whether a PLY file has properties of Gaussians, complete or not, rather than of plain points.

    Raises ``UserError`` if ``path`` is not a PLY file.
    """
    elements = read_header(path).elements
    return any(not GAUSSIANS_ONLY.isdisjoint(element.names) for element in elements)


def read_points(header: PlyHeader) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the positions of the vertices, float32 [n 3], and their RGB in [0, 1] if the file has colours.

    Colours are ``red green blue`` in 0 to 255, 0 to 65535 (ushort) or 0 to 1 (float), and are rounded to 8
    bits. Raises ``UserError`` if the file has no vertices with positions, or is damaged.
    """
    vertex = header.element(VERTEX)
    colors = COLORS if vertex and set(COLORS) <= set(vertex.names) else []
    table = read_tables(header, {VERTEX: [*COLUMNS["means"], *colors]})[VERTEX]
    points = columns(table, COLUMNS["means"])
    if not colors:
        return points, None
    rgb = np.stack([_color_bytes(table[name]) for name in colors], axis=1)
    return points, (rgb / 255.0).astype(np.float32)


def _color_bytes(values: np.ndarray) -> np.ndarray:
    largest = {"u2": 65535, "f4": 1, "f8": 1}.get(values.dtype.str[1:], 255)
    with np.errstate(over="ignore", invalid="ignore"):
        scaled = np.rint(values * (255 / largest))
    return np.nan_to_num(np.clip(scaled, 0, 255)).astype(np.uint8)


def rest_size(header: PlyHeader, name: str) -> int:
    """Return how many properties of the element ``name`` are rest coefficients.

    Raises ``UserError`` if their number fits no SH degree.
    """
    element = header.element(name)
    size = sum(re.fullmatch(r"f_rest_[0-9]+", each) is not None for each in element.names) if element else 0
    if size not in REST_SIZES:
        sizes = ", ".join(map(str, REST_SIZES))
        raise unusable(header.path, f"expected {sizes} properties f_rest_0 and so on, got {size}")
    return size
