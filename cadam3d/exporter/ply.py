"""PlyExporter: the asset itself, in the format that splat viewers and engines read."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

from cadam3d.core.checks import one_of
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.sh import MAX_DEGREE
from cadam3d.exporter.base import AssetExporter, Contents, gaussians_in
from cadam3d.io.ply import write_ply
from cadam3d.io.run_folder import ASSET


@dataclass(frozen=True, kw_only=True)
class PlyExporter(AssetExporter):
    """Write ``asset.ply`` in the de-facto 3DGS layout; ``io/ply.py`` lists what reads back bit for bit."""

    files: ClassVar = (ASSET,)

    pad_sh: Annotated[int, one_of(range(MAX_DEGREE + 1))]

    def write(self, path: Path, gaussians: Gaussians) -> None:
        """Write the file atomically. Raises ``UserError`` if it cannot be written."""
        write_ply(path, gaussians, up=self.up, pad_sh=self.pad_sh)

    def contents(self, path: Path, gaussians: Gaussians) -> Contents:
        """Return the number of Gaussians, their SH degree with the padding, and the axes of the file."""
        degree = max(gaussians.sh_degree, self.pad_sh)
        return gaussians_in(self.size(len(gaussians)), up=self.up, sh_degree=degree)
