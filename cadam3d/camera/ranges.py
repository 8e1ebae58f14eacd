"""Ranges: how every sampler draws from ``[low, high]``, and the checks of such ranges."""

from collections.abc import Sequence
from functools import partial
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.checks import are_numbers, one_of, require, within
from cadam3d.core.pictures import MOST_PIXELS
from cadam3d.core.schedule import Schedule, as_schedule

ELEVATION_LAWS = ("uniform", "sphere", "mixture")


def uniform(interval: Sequence[float], views: int, generator: torch.Generator) -> Float[Tensor, "v"]:
    """Draw ``views`` independent, uniformly distributed numbers from ``[low, high]``."""
    low, high = interval
    return low + (high - low) * torch.rand(views, generator=generator)


def elevations(
    law: str, interval: Sequence[float], views: int, generator: torch.Generator
) -> Float[Tensor, "v"]:
    """Draw ``views`` elevations in degrees, within ``interval``, by one of ``ELEVATION_LAWS``.

    - ``uniform``: uniform in degrees.
    - ``sphere``: equal areas between the two latitudes are equally likely.
    - ``mixture``: threestudio's law, which GaussianDreamer and MVDream keep. With even odds per call, all
      views are uniform in degrees, or their sines are uniform in [low / 90, high / 90]. The second case was
      meant to be ``sphere``, but it reaches only asin(high / 90): [-10, 60] becomes [-6.4, 41.8].
    """
    if law == "uniform":
        return uniform(interval, views, generator)
    if law == "sphere":
        heights = torch.deg2rad(torch.tensor([float(angle) for angle in interval])).sin()
        return torch.rad2deg(uniform(heights.tolist(), views, generator).asin())
    in_degrees = torch.rand(1, generator=generator) < 0.5
    degrees = uniform(interval, views, generator)
    return torch.where(in_degrees, degrees, torch.rad2deg((degrees / 90).asin()))


def image_size(size: int | Schedule, step: int) -> int:
    """Return the height and width of the square image at ``step`` (0 is the first), in pixels."""
    return round(as_schedule(size)(step))


def require_interval(key: str, interval: object, *, low: float, high: float) -> None:
    """Raise ``UserError`` unless ``interval`` is two ascending numbers in ``[low, high]``."""
    is_interval = (
        are_numbers(interval, low=low, high=high) and len(interval) == 2 and interval[0] <= interval[1]
    )
    expected = f"[low, high] in ascending order between {low:g} and {high:g}"
    require(is_interval, key, expected=expected, got=interval)


Size = Annotated[int | Schedule, within(low=1, high=MOST_PIXELS)]
AzimuthRange = Annotated[Sequence[float], partial(require_interval, low=-360, high=360)]
ElevationRange = Annotated[Sequence[float], partial(require_interval, low=-90, high=90)]
# Outside the unit ball, which the object may fill.
DistanceRange = Annotated[Sequence[float], partial(require_interval, low=1, high=1000)]
FovRange = Annotated[Sequence[float], partial(require_interval, low=1, high=170)]
Law = Annotated[str, one_of(ELEVATION_LAWS)]
