"""Sphere: cameras from all directions, above and below alike."""

from dataclasses import dataclass

import torch

from cadam3d.camera.base import CameraSampler
from cadam3d.camera.ranges import DistanceRange, FovRange, Size, image_size, uniform
from cadam3d.core.cameras import Cameras, orbit


@dataclass(frozen=True, kw_only=True)
class Sphere(CameraSampler):
    """Upright cameras that look at the origin from independent, uniformly random directions.

    Use it for objects that must look right from below too; most text-to-3D recipes stay above the horizon
    (see :class:`~cadam3d.camera.orbit.Orbit`).
    """

    size: Size  # pixels
    distance: DistanceRange  # [low, high], world units
    fov_y_deg: FovRange  # [low, high]

    def sample(self, step: int, views: int, generator: torch.Generator) -> Cameras:
        """Draw directions such that equal areas are equally likely.

        Azimuth and height (the sine of the elevation) are uniform.
        """
        size = image_size(self.size, step)
        return orbit(
            azimuth_deg=uniform((-180.0, 180.0), views, generator),
            elevation_deg=torch.rad2deg(uniform((-1.0, 1.0), views, generator).asin()),
            distance=uniform(self.distance, views, generator),
            fov_y_deg=uniform(self.fov_y_deg, views, generator),
            height=size,
            width=size,
        )
