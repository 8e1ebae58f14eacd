"""SogExporter: the asset as SOG, PlayCanvas's compressed format for the web."""

from dataclasses import dataclass
from typing import ClassVar

from cadam3d.exporter.base import AssetExporter
from cadam3d.io.gaussforge import write_sog


@dataclass(frozen=True, kw_only=True)
class SogExporter(AssetExporter):
    """Write ``asset.sog`` with the optional package gaussforge (``io/gaussforge.py``)."""

    files: ClassVar = ("asset.sog",)
    writer: ClassVar = write_sog
    gaussforge: ClassVar = "exporter.sog"
    loss: ClassVar = "rounds positions to 16 bits, and the rest to code books of 256 values"
