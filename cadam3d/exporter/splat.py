"""SplatExporter: the asset as a .splat file, for simple viewers on the web."""

from dataclasses import dataclass
from typing import ClassVar

from cadam3d.exporter.base import AssetExporter
from cadam3d.io.splat import write_splat


@dataclass(frozen=True, kw_only=True)
class SplatExporter(AssetExporter):
    """Write ``asset.splat``, 32 bytes per Gaussian, without view-dependent colours (``io/splat.py``)."""

    files: ClassVar = ("asset.splat",)
    writer: ClassVar = write_splat
    max_degree: ClassVar = 0
    loss: ClassVar = "rounds colours, opacities and rotations to 8 bits"
