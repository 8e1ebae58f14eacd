"""SpzExporter: the asset as an SPZ file of Niantic, compressed and widely read."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

from cadam3d.core.checks import one_of, require_extra
from cadam3d.core.gaussians import Gaussians
from cadam3d.exporter.base import AssetExporter
from cadam3d.io.gaussforge import EXTRA, write_spz4
from cadam3d.io.spz import write_spz


@dataclass(frozen=True, kw_only=True)
class SpzExporter(AssetExporter):
    """Write ``asset.spz``: version 3 (``io/spz.py``), or version 4 with gaussforge (``io/gaussforge.py``)."""

    files: ClassVar = ("asset.spz",)
    loss: ClassVar = "rounds positions to 24 bits, rotations to 10, colours, opacities and scales to 8"
    sh_loss: ClassVar = "view-dependent colours to 4 or 5"

    version: Annotated[int, one_of((3, 4))]

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.version == 4:
            require_extra("exporter.spz.version", *EXTRA)

    def write(self, path: Path, gaussians: Gaussians) -> None:
        """Write the file atomically. Raises ``UserError`` if it cannot be written."""
        write = write_spz4 if self.version == 4 else write_spz
        write(path, gaussians, up=self.up)
