"""Files of Gaussians of any format that this program reads, recognised by what is in them.

A PLY begins with ``ply``, and a compressed PLY has packed properties. A glb begins with ``glTF``. SPZ is a
gzip stream, or begins with ``NGSP`` (version 4). SOG is a ZIP. A ``.splat`` and a ``.ksplat`` have no header
of their own, so the suffix decides.

glTF defines its axes, and a PLY of this project records them in a comment. Any other file is taken for -y up,
as 3DGS has it, because most programs write the numbers of a PLY into every format. A message says so.
"""

import logging
from collections.abc import Callable
from functools import partial
from pathlib import Path

from cadam3d.core.checks import require_choice
from cadam3d.core.console import say
from cadam3d.core.gaussians import Gaussians
from cadam3d.io.compressed_ply import is_compressed, read_compressed_ply
from cadam3d.io.frames import UPS
from cadam3d.io.gaussforge import read_forged
from cadam3d.io.glb import read_glb
from cadam3d.io.ply import read_ply
from cadam3d.io.ply_tables import read_header
from cadam3d.io.reading import opened, unusable
from cadam3d.io.splat import read_splat
from cadam3d.io.spz import GZIP_MAGIC, MAGIC, read_spz

PLY, COMPRESSED_PLY, SPLAT, SPZ, SPZ4 = "ply", "compressed ply", "splat", "spz", "spz 4"
GLB, SOG, KSPLAT = "glb", "sog", "ksplat"
READERS: dict[str, Callable[..., Gaussians]] = {
    PLY: read_ply,
    COMPRESSED_PLY: read_compressed_ply,
    SPLAT: read_splat,
    SPZ: read_spz,
    SPZ4: partial(read_forged, kind="spz"),
    GLB: read_glb,
    SOG: partial(read_forged, kind="sog"),
    KSPLAT: partial(read_forged, kind="ksplat"),
}
# Formats by the first bytes of a file, and by the suffix of a file without any of these.
MAGICS = {GZIP_MAGIC: SPZ, MAGIC: SPZ4, b"glTF": GLB, b"PK\3\4": SOG}
WITHOUT_MAGIC = {".splat": SPLAT, ".ksplat": KSPLAT}
SUFFIXES = (".ply", ".compressed.ply", ".splat", ".spz", ".glb", ".sog", ".ksplat")
USUAL_UP = "-y"


def read_gaussians(path: Path, *, up: str | None = None, key: str = "ply_up") -> Gaussians:
    """Read a file of any supported format into world axes, on the CPU, as float32.

    ``up`` is the up axis of a file that does not record it, and ``key`` the setting that gives it. With None,
    such a file is taken for ``USUAL_UP``, which a message says. Raises ``UserError`` if the file cannot be
    read, is damaged, or has another format.
    """
    if up is not None:
        require_choice("up", up, UPS)
    kind = file_format(path)
    if up is not None:
        return READERS[kind](path, up=up)
    gaussians = READERS[kind](path)
    if kind != GLB and not (kind in (PLY, COMPRESSED_PLY) and read_header(path).up):
        say_assumed(path, USUAL_UP, key)
    return gaussians


def say_assumed(path: Path, up: str, key: str) -> None:
    """Tell the user which up axis a file is taken for that records none, and how to give another one."""
    other = "+y" if up == "-y" else "-y"
    assumed = f"{path.name} does not record its axes, so it is read as {up} up"
    say(f"Note: {assumed}. If it is upside down: {key}={other}", logging.WARNING)


def file_format(path: Path) -> str:
    """Return the format of a file, one of ``READERS``. Raises ``UserError`` if it has none of them."""
    with opened(path) as file:
        begin = file.read(4)
    if begin[:3] == b"ply":
        return COMPRESSED_PLY if is_compressed(read_header(path)) else PLY
    found = [kind for magic, kind in MAGICS.items() if begin.startswith(magic)]
    found += [kind for suffix, kind in WITHOUT_MAGIC.items() if path.suffix.lower() == suffix]
    if not found:
        expected = "|".join(SUFFIXES)
        raise unusable(path, f"not a ply file, nor another one of {expected}: it begins with {begin!r}")
    return found[0]
