"""Orbit: cameras around the object within chosen ranges, spread evenly in azimuth over a step's views."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from cadam3d.camera.base import CameraSampler
from cadam3d.camera.ranges import (
    elevations,
    image_size,
    require_elevations,
    require_interval,
    require_lens,
    require_size,
    uniform,
)
from cadam3d.core.cameras import Cameras, orbit
from cadam3d.core.schedule import Schedule


@dataclass(frozen=True, kw_only=True)
class Orbit(CameraSampler):
    """Upright cameras that look at the origin; every range is ``[low, high]``.

    The azimuth range is divided into as many equal strata as there are views, with one view in each, so that
    a step never shows the object from one side only.
    """

    size: int | Schedule  # pixels
    azimuth_deg: Sequence[float]
    elevation_deg: Sequence[float]
    elevation_law: str  # one of ELEVATION_LAWS
    distance: Sequence[float]  # world units
    fov_y_deg: Sequence[float]

    def __post_init__(self) -> None:
        require_size(self.size)
        require_interval("camera.azimuth_deg", self.azimuth_deg, low=-360, high=360)
        require_elevations(self.elevation_law, self.elevation_deg)
        require_lens(self.distance, self.fov_y_deg)

    def sample(self, step: int, views: int, generator: torch.Generator) -> Cameras:
        """Draw one camera per stratum of azimuth, and everything else independently for each camera.

        Only the image size may depend on ``step``.
        """
        low, high = self.azimuth_deg
        strata = torch.arange(views) + torch.rand(views, generator=generator)
        size = image_size(self.size, step)
        return orbit(
            azimuth_deg=low + (high - low) * strata / views,
            elevation_deg=elevations(self.elevation_law, self.elevation_deg, views, generator),
            distance=uniform(self.distance, views, generator),
            fov_y_deg=uniform(self.fov_y_deg, views, generator),
            height=size,
            width=size,
        )
