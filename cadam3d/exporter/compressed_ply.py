"""CompressedPlyExporter: the asset as a compressed PLY of SuperSplat."""

from dataclasses import dataclass
from typing import ClassVar

from cadam3d.exporter.base import AssetExporter
from cadam3d.io.compressed_ply import write_compressed_ply


@dataclass(frozen=True, kw_only=True)
class CompressedPlyExporter(AssetExporter):
    """Write ``asset.compressed.ply``; ``io/compressed_ply.py`` describes the layout and what is lost."""

    files: ClassVar = ("asset.compressed.ply",)
    writer: ClassVar = write_compressed_ply
    loss: ClassVar = "rounds positions, scales and rotations to 10 or 11 bits, colours and opacities to 8"
    sh_loss: ClassVar = "view-dependent colours to 8"
