"""KsplatExporter: the asset as a .ksplat file of GaussianSplats3D."""

from dataclasses import dataclass
from typing import ClassVar

from cadam3d.exporter.base import AssetExporter
from cadam3d.io.gaussforge import KSPLAT_SH_DEGREE, write_ksplat


@dataclass(frozen=True, kw_only=True)
class KsplatExporter(AssetExporter):
    """Write ``asset.ksplat`` with the optional package gaussforge (``io/gaussforge.py``)."""

    files: ClassVar = ("asset.ksplat",)
    writer: ClassVar = write_ksplat
    gaussforge: ClassVar = "exporter.ksplat"
    max_degree: ClassVar = KSPLAT_SH_DEGREE
    loss: ClassVar = "rounds colours and opacities to 8 bits"
