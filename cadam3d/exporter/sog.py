"""SogExporter: the asset as SOG, PlayCanvas's compressed format for the web."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from cadam3d.core.gaussians import Gaussians
from cadam3d.exporter.base import AssetExporter
from cadam3d.io.gaussforge import require_gaussforge, write_sog


@dataclass(frozen=True, kw_only=True)
class SogExporter(AssetExporter):
    """Write ``asset.sog`` with the optional package gaussforge (``io/gaussforge.py``)."""

    node: ClassVar = "exporter.sog"
    files: ClassVar = ("asset.sog",)
    loss: ClassVar = "rounds positions to 16 bits, and the rest to code books of 256 values"

    def __post_init__(self) -> None:
        super().__post_init__()
        require_gaussforge(self.node)

    def write(self, path: Path, gaussians: Gaussians) -> None:
        """Write the file atomically. Raises ``UserError`` if it cannot be written."""
        write_sog(path, gaussians, up=self.up)
