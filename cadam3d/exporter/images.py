"""ImagesExporter: one PNG per view, for a paper, a web page or another program."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from cadam3d.core.cameras import turntable
from cadam3d.core.checks import require_whole
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.render import RenderFn
from cadam3d.core.viewing import require_elevations, require_viewing
from cadam3d.exporter.base import Exporter
from cadam3d.io.image import write_png

FOLDER_NAME = "images"


@dataclass(frozen=True, kw_only=True)
class ImagesExporter(Exporter):
    """Writes ``images/000_az000_el+20.png`` and so on: numbered, azimuth and elevation in degrees."""

    views: int  # azimuths per elevation, evenly spaced from the front on
    elevations_deg: Sequence[float]  # one ring of views each
    distance: float  # of the camera from the origin, world units
    fov_y_deg: float
    size: int  # pixels, height and width of each picture
    background: Sequence[float]  # RGB in [0, 1]

    def __post_init__(self) -> None:
        require_whole("exporter.images.views", self.views, low=1, example=8)
        require_elevations("exporter.images", self.elevations_deg)
        require_viewing(
            "exporter.images",
            distance=self.distance,
            fov_y_deg=self.fov_y_deg,
            size=self.size,
            background=self.background,
        )

    def export(self, gaussians: Gaussians, render: RenderFn, folder: Path) -> list[Path]:
        """Render and write view by view, so that memory does not grow with their number."""
        paths = []
        for elevation_deg in self.elevations_deg:
            ring = turntable(
                self.views,
                elevation_deg=elevation_deg,
                distance=self.distance,
                fov_y_deg=self.fov_y_deg,
                size=self.size,
            )
            for view in range(self.views):
                camera = ring.index(slice(view, view + 1))
                azimuth = round(float(camera.azimuth_deg[0]) % 360)
                path = folder / FOLDER_NAME / f"{len(paths):03d}_az{azimuth:03d}_el{elevation_deg:+03.0f}.png"
                write_png(path, render(camera, torch.tensor([list(self.background)])).rgb[0].cpu())
                paths.append(path)
        return paths
