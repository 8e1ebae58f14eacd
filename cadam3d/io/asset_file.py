"""Files of Gaussians of any format that this program reads, recognised by what is in them.

| format | recognised by | up axis, if the file does not record it |
|---|---|---|
| PLY and compressed PLY | ``ply`` at the beginning; packed properties | -y |
| SPZ | a gzip stream, or ``NGSP`` at the beginning | +y |
| ``.splat`` | the suffix, because the format has no header | -y |

Only files of this project record their axes, in a comment of a PLY.
"""

import shlex
from pathlib import Path

from cadam3d.core.checks import require_choice
from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.io.compressed_ply import is_compressed, read_compressed_ply
from cadam3d.io.frames import UPS
from cadam3d.io.ply import read_ply
from cadam3d.io.ply_tables import opened, read_header
from cadam3d.io.splat import read_splat
from cadam3d.io.spz import read_spz

PLY, COMPRESSED_PLY, SPLAT, SPZ = "ply", "compressed ply", "splat", "spz"
READERS = {PLY: read_ply, COMPRESSED_PLY: read_compressed_ply, SPLAT: read_splat, SPZ: read_spz}
# Up axes of files that do not record them.
USUAL_UP = {PLY: "-y", COMPRESSED_PLY: "-y", SPLAT: "-y", SPZ: "+y"}
SUFFIXES = (".ply", ".splat", ".spz")
GZIP = b"\x1f\x8b"
# First bytes of formats that hold Gaussians or meshes but have no reader here.
OTHER_FORMATS = {b"glTF": "a glb", b"PK\x03\x04": "a zip archive, such as sog"}
OTHER_SUFFIXES = {".ksplat": "ksplat", ".sog": "sog", ".glb": "glb", ".gltf": "gltf", ".obj": "obj"}


def read_gaussians(path: Path, *, up: str | None = None) -> Gaussians:
    """Read a file of any supported format into world axes, on the CPU, as float32.

    ``up`` is the up axis of a file that does not record it; None means the usual one of its format. Raises
    ``UserError`` if the file cannot be read, is damaged, or has another format.
    """
    if up is not None:
        require_choice("up", up, UPS)
    kind = file_format(path)
    return READERS[kind](path, up=up or USUAL_UP[kind])


def file_format(path: Path) -> str:
    """Return the format of a file, one of ``READERS``. Raises ``UserError`` if it has none of them."""
    with opened(path) as file:
        begin = file.read(4)
    if begin[:3] == b"ply":
        return COMPRESSED_PLY if is_compressed(read_header(path)) else PLY
    if begin[:2] == GZIP or begin == b"NGSP":
        return SPZ
    suffix = path.suffix.lower()
    if found := OTHER_FORMATS.get(begin) or OTHER_SUFFIXES.get(suffix):
        output = shlex.quote(str(path.with_suffix(".ply")))
        raise UserError(
            f"{path}: expected {'|'.join(SUFFIXES)}, got {found}, which this program does not read. "
            f"Try: npx @playcanvas/splat-transform@3.7.0 {shlex.quote(str(path))} {output}"
        )
    if suffix == ".splat":
        return SPLAT
    raise UserError(
        f"{path}: expected {'|'.join(SUFFIXES)}, got a file that begins with {begin!r}. Try: another file"
    )
