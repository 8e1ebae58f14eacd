"""GlbExporter: the asset as binary glTF, for three.js, Babylon.js, Cesium and PlayCanvas."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from cadam3d.core.gaussians import Gaussians
from cadam3d.exporter.base import AssetExporter
from cadam3d.io.glb import write_glb


@dataclass(frozen=True, kw_only=True)
class GlbExporter(AssetExporter):
    """Write ``asset.glb`` with the extension ``KHR_gaussian_splatting`` (``io/glb.py``)."""

    node: ClassVar = "exporter.glb"
    files: ClassVar = ("asset.glb",)
    hint: ClassVar = "needs a program that knows KHR_gaussian_splatting; for triangles type 'exporter=[mesh]'"

    def write(self, path: Path, gaussians: Gaussians) -> None:
        """Write the file atomically. Raises ``UserError`` if it cannot be written."""
        write_glb(path, gaussians, up=self.up)
