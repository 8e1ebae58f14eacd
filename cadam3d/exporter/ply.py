"""PlyExporter: the asset itself, in the format that splat viewers and engines read."""

from dataclasses import dataclass
from pathlib import Path

from cadam3d.core.checks import require_choice
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.render import RenderFn
from cadam3d.core.sh import MAX_DEGREE
from cadam3d.exporter.base import Exporter
from cadam3d.io.frames import UPS
from cadam3d.io.ply import write_ply
from cadam3d.io.run_folder import ASSET


@dataclass(frozen=True, kw_only=True)
class PlyExporter(Exporter):
    """Write ``asset.ply`` in the de-facto 3DGS layout; ``io/ply.py`` lists what reads back bit for bit."""

    up: str  # one of UPS
    pad_sh: int  # 0 to 3

    def __post_init__(self) -> None:
        require_choice("exporter.ply.up", self.up, UPS)
        require_choice("exporter.ply.pad_sh", self.pad_sh, range(MAX_DEGREE + 1))

    def export(self, gaussians: Gaussians, render: RenderFn, folder: Path) -> list[Path]:
        """Write the file without rendering anything."""
        path = folder / ASSET
        write_ply(path, gaussians, up=self.up, pad_sh=self.pad_sh)
        return [path]
