"""SplatExporter: the asset as a .splat file, for simple viewers on the web."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from cadam3d.core.gaussians import Gaussians
from cadam3d.exporter.base import AssetExporter
from cadam3d.io.run_folder import ASSET_SPLAT
from cadam3d.io.splat import write_splat


@dataclass(frozen=True, kw_only=True)
class SplatExporter(AssetExporter):
    """Write ``asset.splat``, 32 bytes per Gaussian, without view-dependent colours (``io/splat.py``)."""

    node: ClassVar[str] = "exporter.splat"
    file_name: ClassVar[str] = ASSET_SPLAT

    def write(self, path: Path, gaussians: Gaussians) -> None:
        """Write the file atomically. Raises ``UserError`` if it cannot be written."""
        write_splat(path, gaussians, up=self.up)

    def omission(self, gaussians: Gaussians) -> str | None:
        """Return a note if the colours depend on the view."""
        if gaussians.sh_degree == 0:
            return None
        return f"{self.file_name} has SH degree 0, so it loses degree 1 to {gaussians.sh_degree}"
