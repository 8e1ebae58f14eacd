"""``.splat`` files of antimatter15's viewer: records of 32 bytes without a header.

| bytes | content |
|---|---|
| 0 to 11 | position x, y, z, float32 |
| 12 to 23 | standard deviations along the three axes, float32, linear |
| 24 to 27 | red, green, blue and opacity, one byte each, 255 for 1 |
| 28 to 31 | quaternion w, x, y, z, one byte each, ``round(128 q) + 128`` |

All numbers are little endian. The largest and most opaque Gaussians come first (product of the three scales
and the opacity), so that viewers that stream a file show them first. The format has no axes; its viewers show
the numbers of a 3DGS PLY, whose up axis is -y.

Lost are spherical harmonics beyond degree 0, colours outside of [0, 1] and the order of the rows. Rounding
costs up to 1/510 of a colour or an opacity and 1/256 of each component of a quaternion (1/128 of one near 1).
Positions and scales keep their float32 precision; scales are at least 1.2e-38 and at most 3.4e38.

Sources: the README and the converter of github.com/antimatter15/splat, and xeokit's guide to the format
(xeokit.github.io/sdk, "3D Gaussian Splatting (.splat) Loader / Exporter").
"""

from pathlib import Path

import numpy as np

from cadam3d.core.gaussians import Gaussians
from cadam3d.core.sh import SH_C0
from cadam3d.io.atomic import replacing
from cadam3d.io.encoding import (
    as_tensor,
    byte_logits,
    in_file_axes,
    linear_scales,
    opacities,
    scale_logarithms,
    to_bytes,
    unit_quats,
)
from cadam3d.io.frames import file_to_world
from cadam3d.io.reading import opened, unusable

RECORD = np.dtype(
    [("position", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 3), ("opacity", "u1"), ("quat", "u1", 4)]
)


def write_splat(path: Path, gaussians: Gaussians, *, up: str) -> None:
    """Write ``gaussians`` atomically, in the axes with up axis ``up`` (see ``frames.py``).

    Only degree 0 of the spherical harmonics is written. Raises ``UserError`` if the file cannot be written.
    """
    local = in_file_axes(gaussians, up)
    records = np.zeros(len(local), dtype=RECORD)
    records["position"] = local.means.numpy()
    records["scale"] = linear_scales(local)
    records["color"] = to_bytes(255 * (0.5 + SH_C0 * local.sh[:, 0].double().numpy()))
    records["opacity"] = to_bytes(255 * opacities(local))
    records["quat"] = to_bytes(128 * unit_quats(local) + 128)
    # Logarithms are sorted, because the product of three scales may leave the range of floats.
    sizes = local.log_scales.double().sum(dim=1) + local.opacity_logits.double().sigmoid().log()
    order = (-sizes).argsort(stable=True).numpy()
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(records[order].tobytes())


def read_splat(path: Path, *, up: str = "-y") -> Gaussians:
    """Read Gaussians of SH degree 0 into world axes, on the CPU, as float32.

    ``up`` is the up axis of the file. Raises ``UserError`` if the size of the file is not a multiple of 32
    bytes, or if a position or a scale is not a possible one.
    """
    with opened(path) as file:
        content = file.read()
    if len(content) % RECORD.itemsize:
        raise unusable(path, f"expected records of {RECORD.itemsize} bytes, got {len(content)} bytes")
    records = np.frombuffer(content, dtype=RECORD)
    possible = np.isfinite(records["position"]) & np.isfinite(records["scale"]) & (records["scale"] >= 0)
    if bad := int((~possible.all(axis=1)).sum()):
        problem = f"not a .splat file: {bad} of {len(records)} records have no possible position or scale"
        raise unusable(path, problem)
    local = Gaussians(
        means=as_tensor(records["position"]),
        log_scales=as_tensor(scale_logarithms(records["scale"])),
        quats=as_tensor((records["quat"].astype(np.float32) - 128) / 128),
        opacity_logits=as_tensor(byte_logits(records["opacity"])),
        sh=as_tensor((records["color"][:, None].astype(np.float64) / 255 - 0.5) / SH_C0),
    )
    return file_to_world(local, up)
