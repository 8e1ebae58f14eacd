"""PreviewExporter: one picture that shows the object from all around."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from cadam3d.core.cameras import turntable
from cadam3d.core.checks import require_choice, require_whole
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.render import RenderFn
from cadam3d.core.viewing import require_elevations, require_viewing
from cadam3d.exporter.base import Exporter
from cadam3d.io.image import contact_sheet, write_png

FILE_NAME = "preview.png"


@dataclass(frozen=True, kw_only=True)
class PreviewExporter(Exporter):
    """Writes ``preview.png``: a row of azimuths for each elevation, starting at the front."""

    views: int  # azimuths per elevation
    elevations_deg: Sequence[float]  # one row each
    distance: float  # of the camera from the origin, world units
    fov_y_deg: float
    size: int  # pixels, height and width of each picture
    background: Sequence[float]  # RGB in [0, 1]
    labels: bool  # write azimuth and elevation into the corner of each picture

    def __post_init__(self) -> None:
        require_whole("exporter.preview.views", self.views, low=1, example=8)
        require_elevations("exporter.preview", self.elevations_deg)
        require_viewing(
            "exporter.preview",
            distance=self.distance,
            fov_y_deg=self.fov_y_deg,
            size=self.size,
            background=self.background,
        )
        require_choice("exporter.preview.labels", self.labels, (True, False))

    def export(self, gaussians: Gaussians, render: RenderFn, folder: Path) -> list[Path]:
        """Render row by row and write the sheet."""
        rows, labels = [], []
        for elevation_deg in self.elevations_deg:
            cameras = turntable(
                self.views,
                elevation_deg=elevation_deg,
                distance=self.distance,
                fov_y_deg=self.fov_y_deg,
                size=self.size,
            )
            rows.append(render(cameras, torch.tensor([list(self.background)] * self.views)).rgb.cpu())
            labels += [f"{azimuth % 360:.0f}, {elevation_deg:g}" for azimuth in cameras.azimuth_deg.tolist()]
        path = folder / FILE_NAME
        images = torch.cat(rows).clamp(0, 1)
        write_png(path, contact_sheet(images, columns=self.views, labels=labels if self.labels else []))
        return [path]
