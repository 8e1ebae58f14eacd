"""CompressedPlyExporter: the asset as a compressed PLY of SuperSplat."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from cadam3d.core.gaussians import Gaussians
from cadam3d.exporter.base import AssetExporter
from cadam3d.io.compressed_ply import write_compressed_ply
from cadam3d.io.run_folder import ASSET_COMPRESSED_PLY


@dataclass(frozen=True, kw_only=True)
class CompressedPlyExporter(AssetExporter):
    """Write ``asset.compressed.ply``; ``io/compressed_ply.py`` describes the layout and what is lost."""

    node: ClassVar[str] = "exporter.compressed_ply"
    file_name: ClassVar[str] = ASSET_COMPRESSED_PLY

    def write(self, path: Path, gaussians: Gaussians) -> None:
        """Write the file atomically.

        Raises ``UserError`` if it cannot be written, or if a number is NaN or infinite.
        """
        write_compressed_ply(path, gaussians, up=self.up)
