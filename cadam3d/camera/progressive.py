"""Progressive: cameras that come closer, zoom in and see more sides as training goes on (LucidDreamer)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.camera.base import CameraSampler
from cadam3d.camera.ranges import Size, image_size, require_interval, uniform
from cadam3d.core.cameras import Cameras, around, look_at, pinhole, wrapped
from cadam3d.core.checks import Count, Positive, Share, Whole, are_numbers, require, within

# Logarithm of the largest growth of a range. It stays within floating point, and every range has reached
# its end long before.
LARGEST_LOG = 500.0


@dataclass(frozen=True, kw_only=True)
class Widening:
    """A range with bounds that move by a constant factor at every widening until they reach their ends.

    The factors multiply the distance of the bounds from ``about``.
    """

    start: Sequence[float]  # [low, high]
    end: Sequence[float]  # [low, high]
    factor: Sequence[float]  # of low and of high
    about: float = 0.0

    def at(self, widenings: int) -> tuple[float, float]:
        """Return the range after ``widenings`` widenings."""
        low, high = (self._end(side, widenings) for side in (0, 1))
        return low, high

    def _end(self, side: int, widenings: int) -> float:
        start, rest = self.start[side], self.end[side]
        growth = math.exp(min(widenings * math.log(self.factor[side]), LARGEST_LOG)) if widenings else 1.0
        return min(max(self.about + (start - self.about) * growth, min(start, rest)), max(start, rest))


def require_widening(key: str, widening: Widening, *, low: float, high: float) -> None:
    """Raise ``UserError`` unless both ranges are in ``[low, high]``, and the factors can be used."""
    require_interval(f"{key}.start", widening.start, low=low, high=high)
    require_interval(f"{key}.end", widening.end, low=low, high=high)
    is_pair = are_numbers(widening.factor, low=1e-3, high=1e3) and len(widening.factor) == 2
    expected = "two numbers in [0.001, 1000]"
    require(is_pair, f"{key}.factor", expected=expected, got=widening.factor)


@dataclass(frozen=True, kw_only=True)
class Progressive(CameraSampler):
    """Slightly shaken cameras around the origin, with ranges that widen at multiples of ``every``.

    Elevation and azimuth are ``middle +- u^gamma * half range`` with uniform u, so gamma > 1 prefers the
    middle; the distance is uniform. All views of a step share one field of view. The ranges are a closed
    form of the step, so that a checkpoint does not have to store them.

    LucidDreamer draws a pool of ten poses with one field of view, and takes views from it at random until it
    is empty. Its poses are independent, so the order does not matter. The difference is that a field of view
    here lasts for one step (four views in LucidDreamer) instead of ten views. LucidDreamer's shaken up vector
    also shears the image slightly; the cameras here stay rigid.
    """

    size: Size  # pixels
    azimuth_deg: Annotated[Widening, partial(require_widening, low=-360, high=360)]
    elevation_deg: Annotated[Widening, partial(require_widening, low=-90, high=90)]
    # World units; outside the unit ball, which the object may fill.
    distance: Annotated[Widening, partial(require_widening, low=1, high=1000)]
    fov_y_deg: Annotated[Widening, partial(require_widening, low=1, high=170)]
    begin: Whole  # step
    every: Count  # steps
    gamma: Positive  # exponent
    position_jitter: Annotated[float, within(low=0, high=0.5)]  # world units
    target_jitter: Share  # world units
    up_jitter: Share  # standard deviation

    def widenings(self, step: int) -> int:
        """Return how often the ranges have widened at ``step``, where 0 is the first step."""
        # Multiples of ``every`` before ``begin`` do not count.
        earlier = math.ceil(max(self.begin, 1) / self.every) - 1
        return max(step // self.every - earlier, 0)

    def sample(self, step: int, views: int, generator: torch.Generator) -> Cameras:
        """Draw ``views`` cameras from the ranges of ``step``; they share only the field of view."""
        count = self.widenings(step)
        azimuth_deg = self._biased(self.azimuth_deg.at(count), views, generator)
        elevation_deg = self._biased(self.elevation_deg.at(count), views, generator)
        distance = uniform(self.distance.at(count), views, generator)
        fov_y_deg = uniform(self.fov_y_deg.at(count), 1, generator).expand(views)
        outward, up = around(azimuth_deg, elevation_deg)
        shake = uniform((-self.position_jitter, self.position_jitter), 3 * views, generator).view(views, 3)
        target = self.target_jitter * torch.randn(views, 3, generator=generator)
        tilt = self.up_jitter * torch.randn(views, 3, generator=generator)
        size = image_size(self.size, step)
        return Cameras(
            world_to_camera=look_at(distance[:, None] * outward + shake, target, up + tilt),
            intrinsics=pinhole(fov_y_deg, size, size),
            height=size,
            width=size,
            azimuth_deg=wrapped(azimuth_deg),
            elevation_deg=elevation_deg,
        )

    def _biased(
        self, interval: tuple[float, float], views: int, generator: torch.Generator
    ) -> Float[Tensor, "v"]:
        low, high = interval
        side = 2 * torch.rand(views, generator=generator) - 1
        return (low + high) / 2 + (high - low) / 2 * side.sign() * side.abs() ** self.gamma
