"""SOG, ksplat and SPZ version 4, written by the optional package gaussforge (Apache-2.0, compiled C++).

cadam3d only writes with gaussforge. It does not read with it, because gaussforge is compiled code that makes
no promise about hostile files.

| format | content | lost |
|---|---|---|
| SOG version 2 | a ZIP of WebP pictures, with code books of 256 scales and colours | a little of everything |
| ksplat, level 0 | float32, with 8-bit colours and opacities | colours outside of [0, 1], SH degree 3 |
| SPZ version 4 | the encodings of version 3 (see ``spz.py``) as zstd streams | positions have 12 bits |

Measured facts about gaussforge 0.6.0, which the code below takes into account. It

* never changes axes, and gives the same bytes for the same Gaussians;
* expects quaternions w, x, y, z, and in SOG they must have length 1, or most rotations are wrong;
* stores positions beyond 2,048 wrongly in SPZ, and scales as infinite in ksplat if their exponential is;
* lets one extreme colour take the precision of all others in the code book of SOG;
* refuses to write SOG and ksplat without a Gaussian;
* writes the SH coefficients of ksplat in another order than Spark, three.js and splat-transform read them,
  which changes degree 2 and higher;
* prints to standard output when it reads, and cannot return a file of SH degree 0 to Python.

ksplat is the format of GaussianSplats3D, which has SH degree 0 to 2 (its README and its issue 259).

Sources: the metadata of gaussforge 0.6.0 on pypi.org, and comparisons of its files with what splat-transform
3.7.0, Spark 2.2.0 and three.js r187 read.
"""

from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.io.atomic import replacing
from cadam3d.io.encoding import in_file_axes, unit_quats

PACKAGE = "gaussforge"
# Numbers beyond these show no difference, but could cost the precision of the others.
LARGEST_LOG = 20.0  # of scales and opacities
LARGEST_SH = 20.0
FARTHEST_SPZ4 = 2047.0  # 24 bits, of which 12 are fractional
KSPLAT_SH_DEGREE = 2
# How a user reads what cadam3d does not read.
CONVERSION = f"pip install {PACKAGE}, which converts it into a ply"


def require_gaussforge(key: str) -> None:
    """Raise ``UserError`` unless gaussforge is installed; ``key`` is the setting that needs it."""
    if find_spec(PACKAGE) is None:
        raise UserError(f"{key}: needs {PACKAGE}, which is not installed. Try: pip install '.[formats]'")


def write_sog(path: Path, gaussians: Gaussians, *, up: str) -> None:
    """Write ``gaussians`` as SOG version 2, atomically, in the axes with up axis ``up``.

    Raises ``UserError`` if there are no Gaussians, if gaussforge is not installed or fails, or if the file
    cannot be written. The other two functions do the same.
    """
    _write(path, gaussians, up=up, kind="sog")


def write_ksplat(path: Path, gaussians: Gaussians, *, up: str) -> None:
    """Write ``gaussians`` as ksplat, with SH degree 2 at most; see :func:`write_sog`."""
    _write(path, gaussians, up=up, kind="ksplat")


def write_spz4(path: Path, gaussians: Gaussians, *, up: str) -> None:
    """Write ``gaussians`` as SPZ version 4, which may be empty; see :func:`write_sog`.

    Raises ``UserError`` also for positions beyond 2,047.
    """
    extent = float(gaussians.means.abs().max()) if len(gaussians) else 0.0
    if extent > FARTHEST_SPZ4:
        problem = f"{path}: expected positions up to {FARTHEST_SPZ4:,.0f}, got {extent:g}"
        raise UserError(f"{problem}. Try: exporter.spz.version=3")
    _write(path, gaussians, up=up, kind="spz")


def _write(path: Path, gaussians: Gaussians, *, up: str, kind: str) -> None:
    if not len(gaussians) and kind != "spz":
        raise UserError(f"{path}: expected a Gaussian, which {kind} requires. Try: 'exporter=[ply]'")
    local = in_file_axes(gaussians, up)
    sh = local.sh.clamp(-LARGEST_SH, LARGEST_SH)
    rest = sh[:, 1:]
    if kind == "ksplat":
        rest = _by_bands(sh[:, 1 : (KSPLAT_SH_DEGREE + 1) ** 2])
    cloud = {
        "numPoints": len(local),
        "positions": _bytes(local.means),
        "scales": _bytes(local.log_scales.clamp(-LARGEST_LOG, LARGEST_LOG)),
        "rotations": unit_quats(local).astype(np.float32).tobytes(),
        "alphas": _bytes(local.opacity_logits.clamp(-LARGEST_LOG, LARGEST_LOG)),
        "colors": _bytes(sh[:, 0]),
        "sh": _bytes(rest),
        "extras": {},
        "meta": {"shDegree": round((rest.shape[1] + 1) ** 0.5) - 1, "sourceFormat": "ply"},
    }
    require_gaussforge(f"exporter.{kind}")
    result = import_module(PACKAGE).GaussForge().write(cloud, kind, spz_version=4)
    if "error" in result:
        raise UserError(f"{path}: gaussforge cannot write it ({result['error']}). Try: 'exporter=[ply]'")
    with replacing(path) as temporary:
        temporary.write_bytes(result["data"])


def _by_bands(rest: Float[Tensor, "n r 3"]) -> Float[Tensor, "n r 3"]:
    """Return coefficients of degree 1 and higher, arranged so that gaussforge writes a correct ksplat file.

    The format has one block for each degree, and in it all of red, then green, then blue. gaussforge writes
    a single block: all of red, then green, then blue.
    """
    bands, first = [], 0
    while first < rest.shape[1]:
        size = 2 * len(bands) + 3
        bands.append(rest[:, first : first + size].mT.flatten(1))
        first += size
    return torch.cat([rest[:, :0, 0], *bands], dim=1).reshape(len(rest), 3, rest.shape[1]).mT


def _bytes(tensor: Tensor) -> bytes:
    return tensor.contiguous().numpy().tobytes()
