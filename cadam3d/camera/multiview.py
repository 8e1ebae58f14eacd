"""Multiview: groups of four views at right angles, for priors that denoise four views together (MVDream)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Annotated

import torch

from cadam3d.camera.base import CameraSampler
from cadam3d.camera.ranges import (
    ElevationRange,
    FovRange,
    Law,
    Size,
    elevations,
    image_size,
    require_interval,
    uniform,
)
from cadam3d.core.cameras import Cameras, orbit
from cadam3d.core.checks import require

# Multi-view networks were trained on groups of this size.
GROUP = 4  # views
# Cameras stay at least this far from the origin, outside the unit ball, which the object may fill.
OUTSIDE = 1.0  # world units


@dataclass(frozen=True, kw_only=True)
class Multiview(CameraSampler):
    """Upright cameras that look at the origin, in groups of four; every range is ``[low, high]``.

    The views of a group share elevation, distance and field of view. Their azimuths are 90 degrees apart,
    starting at a random angle in the first quarter. Consecutive views form a group: 0 to 3, 4 to 7, etc.
    """

    size: Size  # pixels
    elevation_deg: ElevationRange
    elevation_law: Law
    # World units.
    relative_distance: Annotated[Sequence[float], partial(require_interval, low=0, high=100)]
    fov_y_deg: FovRange

    def __post_init__(self) -> None:
        super().__post_init__()
        least = OUTSIDE * math.tan(math.radians(self.fov_y_deg[1]) / 2)
        expected = f"at least {least:.3g} at {self.fov_y_deg[1]:g} degrees, outside the unit ball"
        self.expect(self.relative_distance[0] >= least, "relative_distance", expected)

    def check_views(self, views: int) -> None:
        """Raise ``UserError`` unless ``views`` is a multiple of four."""
        require(
            views % GROUP == 0,
            "views",
            expected=f"a multiple of {GROUP}, since camera=multiview draws groups of {GROUP} views",
            got=views,
            example=f"views={GROUP}",
        )

    def sample(self, step: int, views: int, generator: torch.Generator) -> Cameras:
        """Draw ``views`` / 4 groups. Raises ``UserError`` if that is not a whole number."""
        self.check_views(views)
        groups = views // GROUP
        starts = torch.rand(groups, 1, generator=generator)
        turns = (starts + torch.arange(GROUP)) / GROUP  # [groups 4], in [0, 1)
        fov_y_deg = uniform(self.fov_y_deg, groups, generator)
        # The relative distance is half the height of the image, in world units at the origin.
        half_height = uniform(self.relative_distance, groups, generator)
        distance = half_height / torch.tan(torch.deg2rad(fov_y_deg) / 2)
        elevation_deg = elevations(self.elevation_law, self.elevation_deg, groups, generator)
        size = image_size(self.size, step)
        return orbit(
            azimuth_deg=360 * turns.flatten() - 180,
            elevation_deg=elevation_deg.repeat_interleave(GROUP),
            distance=distance.repeat_interleave(GROUP),
            fov_y_deg=fov_y_deg.repeat_interleave(GROUP),
            height=size,
            width=size,
        )
