"""KsplatExporter: the asset as a .ksplat file of GaussianSplats3D."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from cadam3d.core.gaussians import Gaussians
from cadam3d.exporter.base import AssetExporter
from cadam3d.io.gaussforge import KSPLAT_SH_DEGREE, require_gaussforge, write_ksplat


@dataclass(frozen=True, kw_only=True)
class KsplatExporter(AssetExporter):
    """Write ``asset.ksplat`` with the optional package gaussforge (``io/gaussforge.py``)."""

    node: ClassVar = "exporter.ksplat"
    files: ClassVar = ("asset.ksplat",)
    max_degree: ClassVar = KSPLAT_SH_DEGREE
    loss: ClassVar = "rounds colours and opacities to 8 bits"

    def __post_init__(self) -> None:
        super().__post_init__()
        require_gaussforge(self.node)

    def write(self, path: Path, gaussians: Gaussians) -> None:
        """Write the file atomically. Raises ``UserError`` if it cannot be written."""
        write_ksplat(path, gaussians, up=self.up)
