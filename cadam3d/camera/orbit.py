"""Orbit: cameras around the object within chosen ranges, spread evenly in azimuth over a step's views."""

from dataclasses import dataclass

import torch

from cadam3d.camera.base import CameraSampler
from cadam3d.camera.ranges import (
    AzimuthRange,
    DistanceRange,
    ElevationRange,
    FovRange,
    Law,
    Size,
    elevations,
    image_size,
    uniform,
)
from cadam3d.core.cameras import Cameras, orbit


@dataclass(frozen=True, kw_only=True)
class Orbit(CameraSampler):
    """Upright cameras that look at the origin; every range is ``[low, high]``.

    The azimuth range is divided into as many equal strata as there are views, with one view in each, so that
    a step never shows the object from one side only.
    """

    size: Size  # pixels
    azimuth_deg: AzimuthRange
    elevation_deg: ElevationRange
    elevation_law: Law
    distance: DistanceRange  # world units
    fov_y_deg: FovRange

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
