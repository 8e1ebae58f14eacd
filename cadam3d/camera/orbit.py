"""Cameras around the object within chosen ranges, spread evenly in azimuth over the views of a step."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.camera.base import CameraSampler
from cadam3d.core.cameras import Cameras, orbit
from cadam3d.core.checks import are_numbers, require, require_choice, require_whole

ELEVATION_LAWS = ("uniform", "sphere")


@dataclass(frozen=True, kw_only=True)
class Orbit(CameraSampler):
    """Upright cameras that look at the origin; every range is ``[low, high]``.

    The azimuth range is cut into as many equal strata as there are views, one view in each, so that a
    step never sees the object from one side only.
    """

    size: int  # pixels; images are square
    azimuth_deg: Sequence[float]  # 0 = front (+x), 90 = the +y side
    elevation_deg: Sequence[float]  # 0 = horizon, 90 = from above
    elevation_law: str  # "uniform" in degrees, or "sphere": uniform on the sphere between the two latitudes
    distance: Sequence[float]  # world units from the origin; the object fits in the unit ball
    fov_y_deg: Sequence[float]  # vertical field of view

    def __post_init__(self) -> None:
        require_whole("camera.size", self.size, low=1, example=128)
        require_interval("camera.azimuth_deg", self.azimuth_deg, low=-360, high=360, example="[-180,180]")
        require_interval("camera.elevation_deg", self.elevation_deg, low=-90, high=90, example="[-10,60]")
        require_choice("camera.elevation_law", self.elevation_law, ELEVATION_LAWS)
        require_lens(self.distance, self.fov_y_deg)

    def sample(self, step: int, views: int, generator: torch.Generator) -> Cameras:
        """One camera per stratum of azimuth; all else is drawn independently, the same at every ``step``."""
        low, high = self.azimuth_deg
        strata = torch.arange(views) + torch.rand(views, generator=generator)
        return orbit(
            azimuth_deg=low + (high - low) * strata / views,
            elevation_deg=self._elevations(views, generator),
            distance=uniform(self.distance, views, generator),
            fov_y_deg=uniform(self.fov_y_deg, views, generator),
            height=self.size,
            width=self.size,
        )

    def _elevations(self, views: int, generator: torch.Generator) -> Float[Tensor, "v"]:
        if self.elevation_law == "uniform":
            return uniform(self.elevation_deg, views, generator)
        heights = torch.deg2rad(torch.tensor([float(angle) for angle in self.elevation_deg])).sin()
        return torch.rad2deg(uniform(heights.tolist(), views, generator).asin())


def uniform(interval: Sequence[float], views: int, generator: torch.Generator) -> Float[Tensor, "v"]:
    """``views`` independent uniform draws from ``[low, high]``."""
    low, high = interval
    return low + (high - low) * torch.rand(views, generator=generator)


def require_interval(key: str, interval: object, *, low: float, high: float, example: str) -> None:
    """Raise ``UserError`` unless ``interval`` is two ascending numbers in ``[low, high]``."""
    is_interval = (
        are_numbers(interval, low=low, high=high) and len(interval) == 2 and interval[0] <= interval[1]
    )
    require(
        is_interval,
        key,
        wanted=f"[low, high] in ascending order between {low:g} and {high:g}",
        got=interval,
        example=f"'{key}={example}'",
    )


def require_lens(distance: object, fov_y_deg: object) -> None:
    """Raise ``UserError`` unless distances lie outside the unit ball and fields of view are possible."""
    require_interval("camera.distance", distance, low=1, high=1000, example="[3.0,3.6]")
    require_interval("camera.fov_y_deg", fov_y_deg, low=1, high=170, example="[40,45]")
