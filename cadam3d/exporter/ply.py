"""PlyExporter: the asset itself, as splat viewers and engines read it."""

from dataclasses import dataclass
from pathlib import Path

from cadam3d.core.checks import require_choice
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.render import RenderFn
from cadam3d.core.sh import MAX_DEGREE
from cadam3d.exporter.base import Exporter
from cadam3d.io.frames import UPS
from cadam3d.io.ply import write_ply

FILE_NAME = "asset.ply"


@dataclass(frozen=True, kw_only=True)
class PlyExporter(Exporter):
    """Writes ``asset.ply`` in the de-facto 3DGS layout; ``io/ply.py`` says what reads back bit for bit."""

    up: str  # -y, +y or +z
    pad_sh: int  # least SH degree of the file, 0 to 3

    def __post_init__(self) -> None:
        require_choice("exporter.ply.up", self.up, UPS)
        require_choice("exporter.ply.pad_sh", self.pad_sh, range(MAX_DEGREE + 1))

    def export(self, gaussians: Gaussians, render: RenderFn, folder: Path) -> list[Path]:
        """Write the file; nothing is rendered."""
        path = folder / FILE_NAME
        write_ply(path, gaussians, up=self.up, pad_sh=self.pad_sh)
        return [path]
