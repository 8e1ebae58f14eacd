"""PreviewExporter: one picture that shows the object from all sides."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import torch

from cadam3d.core.checks import require_choice
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.pictures import PictureSettings
from cadam3d.core.render import RenderFn
from cadam3d.exporter.base import Exporter
from cadam3d.io.image import contact_sheet, write_png
from cadam3d.io.run_folder import PREVIEW


@dataclass(frozen=True, kw_only=True)
class PreviewExporter(PictureSettings, Exporter):
    """Write ``preview.png``: a row of azimuths for each elevation, starting at the front."""

    node: ClassVar[str] = "exporter.preview"

    views: int  # >= 1, per elevation
    elevations_deg: Sequence[float]  # in [-90, 90]
    labels: bool

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_angles("elevations_deg", self.elevations_deg, limit=90, example=15)
        # All pictures are kept for the sheet, 12 bytes for each pixel.
        kept = 12 * float(self.size) ** 2 * len(self.elevations_deg)
        self.require_views(self.views, example=8, bytes_each=kept)
        require_choice("exporter.preview.labels", self.labels, (True, False))

    def export(self, gaussians: Gaussians, render: RenderFn, folder: Path) -> list[Path]:
        """Render row by row and write the sheet."""
        rows, labels = [], []
        for elevation_deg in self.elevations_deg:
            cameras = self.ring(self.views, elevation_deg)
            rows.append(render(cameras, self.backgrounds(self.views)).rgb.cpu())
            labels += [f"{azimuth % 360:.0f}, {elevation_deg:g}" for azimuth in cameras.azimuth_deg.tolist()]
        path = folder / PREVIEW
        images = torch.cat(rows).clamp(0, 1)
        write_png(path, contact_sheet(images, columns=self.views, labels=labels if self.labels else []))
        return [path]
