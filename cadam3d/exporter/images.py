"""ImagesExporter: one PNG per view, for a paper, a web page or another program."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from cadam3d.core.gaussians import Gaussians
from cadam3d.core.pictures import PictureSettings
from cadam3d.core.render import RenderFn
from cadam3d.exporter.base import Exporter
from cadam3d.io.atomic import replacing_series
from cadam3d.io.image import write_png
from cadam3d.io.run_folder import IMAGES

# The names of the pictures: number, azimuth and elevation.
NAME = re.compile(r"\d{3,}_az\d{3}_el[+-]\d{2}\.png")


@dataclass(frozen=True, kw_only=True)
class ImagesExporter(PictureSettings, Exporter):
    """Write ``images/000_az000_el+20.png`` and so on: numbered, with azimuth and elevation in degrees.

    All pictures with such names in ``images`` are replaced, so that none of an earlier export is left.
    """

    node: ClassVar[str] = "exporter.images"

    views: int  # >= 1, per elevation
    elevations_deg: Sequence[float]  # in [-90, 90]

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_views(self.views, example=8)
        self.require_angles("elevations_deg", self.elevations_deg, limit=90, example=15)

    def export(self, gaussians: Gaussians, render: RenderFn, folder: Path) -> list[Path]:
        """Render and write view by view, so that memory does not grow with the number of views."""
        names: list[str] = []
        target = folder / IMAGES
        with replacing_series(target, lambda name: NAME.fullmatch(name) is not None) as temporary:
            for elevation_deg in self.elevations_deg:
                ring = self.ring(self.views, elevation_deg)
                for view in range(self.views):
                    camera = ring.index(slice(view, view + 1))
                    azimuth = round(float(camera.azimuth_deg[0]) % 360)
                    name = f"{len(names):03d}_az{azimuth:03d}_el{elevation_deg:+03.0f}.png"
                    write_png(temporary / name, render(camera, self.backgrounds(1)).rgb[0].cpu())
                    names.append(name)
        return [target / name for name in names]
