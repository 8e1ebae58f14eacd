"""Sphere: cameras from everywhere, above and below alike."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from cadam3d.camera.base import CameraSampler
from cadam3d.camera.orbit import require_lens, uniform
from cadam3d.core.cameras import Cameras, orbit
from cadam3d.core.checks import require_whole


@dataclass(frozen=True, kw_only=True)
class Sphere(CameraSampler):
    """Upright cameras that look at the origin from independent, uniformly random directions.

    For objects that must look right from below too; most text-to-3D recipes stay above (see :class:`Orbit`).
    """

    size: int  # pixels; images are square
    distance: Sequence[float]  # [low, high], world units from the origin; the object fits in the unit ball
    fov_y_deg: Sequence[float]  # [low, high], vertical field of view

    def __post_init__(self) -> None:
        require_whole("camera.size", self.size, low=1, example=128)
        require_lens(self.distance, self.fov_y_deg)

    def sample(self, step: int, views: int, generator: torch.Generator) -> Cameras:
        """Equal areas are equally likely: azimuth and height (sine of elevation) are uniform."""
        return orbit(
            azimuth_deg=uniform((-180.0, 180.0), views, generator),
            elevation_deg=torch.rad2deg(uniform((-1.0, 1.0), views, generator).asin()),
            distance=uniform(self.distance, views, generator),
            fov_y_deg=uniform(self.fov_y_deg, views, generator),
            height=self.size,
            width=self.size,
        )
