"""Ranges: how every sampler draws from ``[low, high]``, and the checks of such ranges."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.checks import are_numbers, require, require_choice, require_whole
from cadam3d.core.pictures import MOST_PIXELS
from cadam3d.core.schedule import Schedule, as_schedule, require_scheduled

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


def require_size(size: int | Schedule) -> None:
    """Raise ``UserError`` unless ``size`` is a schedule or a whole number of pixels."""
    if isinstance(size, Schedule):
        require_scheduled("camera.size", size, low=1)
    else:
        require_whole("camera.size", size, low=1, high=MOST_PIXELS)


def require_interval(key: str, interval: object, *, low: float, high: float) -> None:
    """Raise ``UserError`` unless ``interval`` is two ascending numbers in ``[low, high]``."""
    is_interval = (
        are_numbers(interval, low=low, high=high) and len(interval) == 2 and interval[0] <= interval[1]
    )
    require(
        is_interval,
        key,
        expected=f"[low, high] in ascending order between {low:g} and {high:g}",
        got=interval,
    )


def require_elevations(law: object, interval: object) -> None:
    """Raise ``UserError`` unless ``law`` is known and ``interval`` is two ascending elevations in degrees."""
    require_choice("camera.elevation_law", law, ELEVATION_LAWS)
    require_interval("camera.elevation_deg", interval, low=-90, high=90)


def require_lens(distance: object, fov_y_deg: object, suffix: str = "") -> None:
    """Raise ``UserError`` unless distances are outside the unit ball and fields of view are in [1, 170].

    ``suffix`` is appended to the names of the keys in the message, such as ``.start``.
    """
    require_interval(f"camera.distance{suffix}", distance, low=1, high=1000)
    require_interval(f"camera.fov_y_deg{suffix}", fov_y_deg, low=1, high=170)
