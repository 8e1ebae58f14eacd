"""SOG, ksplat and SPZ version 4, written by the optional package gaussforge (Apache-2.0, compiled C++).

cadam3d only writes with gaussforge. It does not read with it, because a hostile file would then reach
compiled code that makes no promise about such files.

| format | content | lost |
|---|---|---|
| SOG version 2 | a ZIP of WebP pictures, with code books of 256 scales and colours | see the tests |
| ksplat, level 0 | float32, with 8-bit colours and opacities | colours outside of [0, 1] |
| SPZ version 4 | the encodings of version 3 (see ``spz.py``) as zstd streams | positions have 12 bits |

Measured facts about gaussforge 0.6.0, which the code below takes into account: it never changes axes; it
expects quaternions w, x, y, z, and in SOG they must have length 1; the coefficients of a Gaussian are stored
together, red, green and blue of the first one first; positions beyond 2,048 wrap around in SPZ; scales whose
exponential is infinite stay infinite in ksplat; one extreme colour takes all precision from the code book of
SOG; SOG and ksplat need at least one Gaussian. The same Gaussians give the same bytes. Reading prints to
standard output, and reading a file of SH degree 0 into Python fails.

Sources: the metadata of gaussforge 0.6.0 on pypi.org, and measurements (``tests/io/test_gaussforge.py``).
"""

from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from torch import Tensor

from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.io.atomic import replacing
from cadam3d.io.encoding import float32_cpu, unit_quats
from cadam3d.io.frames import world_to_file

PACKAGE = "gaussforge"
# Numbers beyond these show no difference, but could cost the precision of the others.
LARGEST_LOG = 20.0  # of scales and opacities
LARGEST_SH = 20.0
FARTHEST_SPZ4 = 2047.0  # 24 bits, of which 12 are fractional


def require_gaussforge(key: str) -> None:
    """Raise ``UserError`` unless gaussforge is installed; ``key`` is the setting that needs it."""
    if find_spec(PACKAGE) is None:
        raise UserError(
            f"{key}: needs {PACKAGE}, which is not installed. Try: pip install 'cadam3d[formats]'"
        )


def write_sog(path: Path, gaussians: Gaussians, *, up: str) -> None:
    """Write ``gaussians`` as SOG version 2, atomically, in the axes with up axis ``up``.

    Raises ``UserError`` if there are none, if gaussforge is not installed or fails, or if the file cannot be
    written. So do the other two functions.
    """
    _write(path, gaussians, up=up, kind="sog")


def write_ksplat(path: Path, gaussians: Gaussians, *, up: str) -> None:
    """Write ``gaussians`` as ksplat; see :func:`write_sog`."""
    _write(path, gaussians, up=up, kind="ksplat")


def write_spz4(path: Path, gaussians: Gaussians, *, up: str) -> None:
    """Write ``gaussians`` as SPZ version 4; see :func:`write_sog`.

    Raises ``UserError`` also for positions beyond 2,047.
    """
    extent = float(gaussians.means.abs().max()) if len(gaussians) else 0.0
    if extent > FARTHEST_SPZ4:
        raise UserError(
            f"{path}: expected positions up to {FARTHEST_SPZ4:,.0f}, which is the range of SPZ version 4, "
            f"got {extent:g}. Try: exporter.spz.version=3"
        )
    _write(path, gaussians, up=up, kind="spz")


def _write(path: Path, gaussians: Gaussians, *, up: str, kind: str) -> None:
    require_gaussforge(f"exporter.{kind}")
    if not len(gaussians) and kind != "spz":
        raise UserError(f"{path}: expected at least one Gaussian, which {kind} requires. Try: exporter=[ply]")
    local = world_to_file(float32_cpu(gaussians), up)
    cloud = {
        "numPoints": len(local),
        "positions": _bytes(local.means),
        "scales": _bytes(local.log_scales.clamp(-LARGEST_LOG, LARGEST_LOG)),
        "rotations": unit_quats(local).astype(np.float32).tobytes(),
        "alphas": _bytes(local.opacity_logits.clamp(-LARGEST_LOG, LARGEST_LOG)),
        "colors": _bytes(local.sh[:, 0].clamp(-LARGEST_SH, LARGEST_SH)),
        "sh": _bytes(local.sh[:, 1:].clamp(-LARGEST_SH, LARGEST_SH)),
        "extras": {},
        "meta": {"shDegree": local.sh_degree, "sourceFormat": "ply"},
    }
    result = import_module(PACKAGE).GaussForge().write(cloud, kind, spz_version=4)
    if "error" in result:
        reason = str(result["error"])
        raise UserError(f"{path}: gaussforge cannot write it ({reason}). Try: exporter=[ply]")
    with replacing(path) as temporary:
        temporary.write_bytes(result["data"])


def _bytes(tensor: Tensor) -> bytes:
    return tensor.contiguous().numpy().tobytes()
