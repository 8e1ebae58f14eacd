"""GlbExporter: the asset as binary glTF, for three.js, Babylon.js, Cesium and PlayCanvas."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

from cadam3d.core.checks import one_of
from cadam3d.core.gaussians import Gaussians
from cadam3d.exporter.base import AssetExporter
from cadam3d.io.glb import COLORS, write_glb


@dataclass(frozen=True, kw_only=True)
class GlbExporter(AssetExporter):
    """Write ``asset.glb`` with the extension ``KHR_gaussian_splatting`` (``io/glb.py``)."""

    files: ClassVar = ("asset.glb",)
    hint: ClassVar = "needs a program that knows KHR_gaussian_splatting; for triangles type 'exporter=[mesh]'"

    colors: Annotated[str, one_of(COLORS)]

    def write(self, path: Path, gaussians: Gaussians) -> None:
        """Write the file atomically. Raises ``UserError`` if it cannot be written."""
        write_glb(path, gaussians, up=self.up, colors=self.colors)

    def losses(self, sh_degree: int) -> str:
        """Return what linear colours change; a file with the colours of the display loses nothing."""
        return "" if self.colors == "display" else "has linear colours, so soft edges look thinner"
