"""Files of Gaussians of any format that this program reads, recognised by what is in them.

A PLY begins with ``ply``, and a compressed PLY has packed properties. SPZ is a gzip stream or begins with
``NGSP``. A ``.splat`` has no header, so its suffix decides. The usual up axis of a format is the default of
its reader.

Only files of this project record their axes, in a comment of a PLY.
"""

from pathlib import Path

from cadam3d.core.checks import require_choice
from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.io.compressed_ply import is_compressed, read_compressed_ply
from cadam3d.io.frames import UPS
from cadam3d.io.gaussforge import CONVERSION
from cadam3d.io.ply import read_ply
from cadam3d.io.ply_tables import read_header
from cadam3d.io.reading import opened, unusable
from cadam3d.io.splat import read_splat
from cadam3d.io.spz import GZIP_MAGIC, MAGIC, read_spz

PLY, COMPRESSED_PLY, SPLAT, SPZ = "ply", "compressed ply", "splat", "spz"
READERS = {PLY: read_ply, COMPRESSED_PLY: read_compressed_ply, SPLAT: read_splat, SPZ: read_spz}
SUFFIXES = (".ply", ".splat", ".spz")
GLB = b"glTF"
# Formats that the package gaussforge converts into a PLY.
CONVERTIBLE = (".sog", ".ksplat")


def read_gaussians(path: Path, *, up: str | None = None) -> Gaussians:
    """Read a file of any supported format into world axes, on the CPU, as float32.

    ``up`` is the up axis of a file that does not record it; None means the usual one of its format. Raises
    ``UserError`` if the file cannot be read, is damaged, or has another format.
    """
    if up is not None:
        require_choice("up", up, UPS)
    read = READERS[file_format(path)]
    return read(path) if up is None else read(path, up=up)


def file_format(path: Path) -> str:
    """Return the format of a file, one of ``READERS``. Raises ``UserError`` if it has none of them."""
    with opened(path) as file:
        begin = file.read(4)
    if begin[:3] == b"ply":
        return COMPRESSED_PLY if is_compressed(read_header(path)) else PLY
    if begin.startswith((GZIP_MAGIC, MAGIC)):
        return SPZ
    suffix = path.suffix.lower()
    if suffix in CONVERTIBLE:
        raise UserError(f"{path}: expected {'|'.join(SUFFIXES)}, got {suffix}. Try: {CONVERSION}")
    if begin == GLB:
        raise unusable(path, f"expected {'|'.join(SUFFIXES)}, got glb")
    if suffix == ".splat":
        return SPLAT
    raise unusable(path, f"not a ply file, nor another one of {'|'.join(SUFFIXES)}: it begins with {begin!r}")
