"""SOG, ksplat and SPZ version 4, through the optional package gaussforge (Apache-2.0, compiled C++).

gaussforge makes no promise about hostile files, and cannot be interrupted. It therefore works in a process of
its own, with limits of memory and time if it reads. A file is converted into a PLY, which this program reads.

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
* reads these coefficients in the same order as it writes them;
* prints to standard output when it reads, and cannot return a file of SH degree 0 to Python.

ksplat is the format of GaussianSplats3D, which has SH degree 0 to 2 (its README and its issue 259).

Sources: the metadata of gaussforge 0.6.0 on pypi.org, and comparisons of its files with what splat-transform
3.7.0, Spark 2.2.0 and three.js r187 read.
"""

import marshal
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.checks import require_extra
from cadam3d.core.console import working
from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.io.atomic import replacing
from cadam3d.io.encoding import in_file_axes, unit_quats
from cadam3d.io.frames import file_to_world
from cadam3d.io.ply import read_ply
from cadam3d.io.reading import opened, unusable

EXTRA = ("formats", "gaussforge")  # of this package, and what it installs
# Numbers beyond these show no difference, but could cost the precision of the others.
LARGEST_LOG = 20.0  # of scales and opacities
LARGEST_SH = 20.0
FARTHEST_SPZ4 = 2047.0  # 24 bits, of which 12 are fractional
KSPLAT_SH_DEGREE = 2
# Limits of a process that reads: bytes for each byte of the file, bytes in addition, and seconds of work.
MOST_EXPANSION, SPARE_BYTES, MOST_SECONDS = 256, 1 << 30, 600
# Calls a method of gaussforge. Standard output carries nothing but the answer.
PROGRAM = """
import marshal, os, sys
answer = os.fdopen(os.dup(1), "wb")
os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
limits, name, arguments, options = marshal.load(sys.stdin.buffer)
if limits and os.name == "posix":
    import resource
    for kind, limit in zip((resource.RLIMIT_AS, resource.RLIMIT_CPU), limits):
        try:
            resource.setrlimit(kind, (limit, limit))
        except (ValueError, OSError):  # not every system has both
            pass
import gaussforge
result = getattr(gaussforge.GaussForge(), name)(*arguments, **options)
if "error" in result:
    sys.exit(str(result["error"]))
answer.write(result["data"])
"""


def write_sog(path: Path, gaussians: Gaussians, *, up: str) -> None:
    """Write ``gaussians`` as SOG version 2, atomically, in the axes with up axis ``up``.

    Raises ``UserError`` if there are no Gaussians, if gaussforge is not installed or fails, or if the file
    cannot be written. The other two writers do the same.
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
        rest = _reordered(sh[:, 1 : (KSPLAT_SH_DEGREE + 1) ** 2], is_read=False)
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
    require_extra(f"exporter.{kind}", *EXTRA)
    content, problem = _forged(path.name, None, "write", (cloud, kind), {"spz_version": 4})
    if problem:
        raise UserError(f"{path}: gaussforge cannot write it ({problem}). Try: 'exporter=[ply]'")
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def read_forged(path: Path, kind: str, *, up: str = "-y") -> Gaussians:
    """Read a file of the format ``kind`` (sog, ksplat or spz) into world axes, on the CPU, as float32.

    ``up`` is the up axis of the file. Raises ``UserError`` if gaussforge is not installed, or if it cannot
    read the file.
    """
    require_extra(str(path), *EXTRA)
    with opened(path) as file:
        content = file.read()
    limits = (MOST_EXPANSION * len(content) + SPARE_BYTES, MOST_SECONDS)
    ply, problem = _forged(path.name, limits, "convert", (content, kind, "ply"), {})
    if problem:
        raise unusable(path, f"gaussforge cannot read it ({problem})")
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder, "copy.ply")
        copy.write_bytes(ply)
        try:
            local = read_ply(copy, up="+z")
        except UserError as error:
            raise UserError(str(error).replace(str(copy), str(path))) from error
    if kind == "ksplat":
        local = replace(
            local, sh=torch.cat([local.sh[:, :1], _reordered(local.sh[:, 1:], is_read=True)], dim=1)
        )
    return file_to_world(local, up)


def _forged(
    label: str, limits: tuple[int, int] | None, name: str, arguments: tuple[Any, ...], options: dict[str, Any]
) -> tuple[bytes, str]:
    """Return the data that a method of gaussforge returns, and what went wrong; "" if nothing did.

    The work is done in a process, which ends if this one is interrupted. ``label`` is shown meanwhile.
    """
    # With -P, no file in the current folder is imported. A session of its own gets no Ctrl-C.
    process = subprocess.Popen(
        [sys.executable, "-P", "-c", PROGRAM],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )
    request: bytes | None = marshal.dumps((limits, name, arguments, options))
    with process, working(label) as refresh:
        try:
            while True:
                try:
                    content, errors = process.communicate(request, timeout=0.5)
                    break
                except subprocess.TimeoutExpired:
                    request = None
                    refresh()
        except BaseException:
            process.kill()
            raise
    if process.returncode == 0:
        return content, ""
    lines = errors.decode(errors="replace").split("\n")
    reason = next((line for line in reversed(lines) if line.strip()), "")
    plain = "".join(each for each in reason if each.isprintable())[:200]
    return b"", plain or f"it ended with {process.returncode}"


def _reordered(rest: Float[Tensor, "n r 3"], *, is_read: bool) -> Float[Tensor, "n r 3"]:
    """Return coefficients of degree 1 and higher, arranged so that gaussforge writes a correct ksplat file.

    The format has one block for each degree, and in it all of red, then green, then blue. gaussforge writes
    a single block: all of red, then green, then blue. With ``is_read``, this is undone.
    """
    count = rest.shape[1]
    bands = [range(degree**2 - 1, (degree + 1) ** 2 - 1) for degree in range(1, round((count + 1) ** 0.5))]
    order = torch.tensor(
        [channel * count + k for band in bands for channel in range(3) for k in band], dtype=torch.int64
    )
    flat = rest.mT.flatten(1)[:, order.argsort() if is_read else order]
    return flat.reshape(len(rest), 3, count).mT


def _bytes(tensor: Tensor) -> bytes:
    return tensor.contiguous().numpy().tobytes()
