"""Janus: how many fronts an asset has. Text-to-3D often shows the same face from several sides.

Each view of the asset looks like some view of the true object. If the asset has one front, its views show
every side of the object as often as the object itself does. If it has two, one side is seen twice and another
one never. Only what differs between the views of the true object says from where it is seen. Pictures are
therefore projected onto the space of these differences, which removes blur and noise. Brightness is left out,
because light makes a difference between the sides of a ball.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.cameras import Cameras, fitting_distance, turntable
from cadam3d.core.number import Number
from cadam3d.metric.base import Measurand, Measurement, Metric

VIEWS = 24
SIZE = 48  # pixels
ELEVATION_DEG = 15.0
FOV_DEG = 40.0
# Views that are rendered or traced at once, which bounds the memory.
VIEWS_AT_ONCE = 12
# Added to the sum of the channels before colours are divided by it, so that black is a colour of its own.
DARK = 0.1
# Mean squared difference between two views below which an object looks the same from all sides. On
# prior=shapes, bodies of revolution have at most 10 ** -4, and the least of all others, a lighthouse, 0.002.
LEAST_SPREAD = 10**-3.5
# Differences count as evidence if they are larger than this share of the error of the asset, and than this
# share of the spread. With smaller values, small errors decide ties such as those between the sides of a
# cube. Larger ones hide the second front of a blurred asset.
NOISE = 0.25
LEAST_NOISE = 0.03
# Directions with a smaller share of the largest singular value are left out of the projection.
LEAST_DIRECTION = 1e-3


@dataclass(frozen=True, kw_only=True)
class Janus(Metric):
    """The number of fronts of an asset, compared with the true object."""

    numbers: ClassVar[tuple[Number, ...]] = (
        Number(name="janus", label="Janus score", digits=3, is_more_better=False, needs_truth=True),
        Number(name="janus_fronts", label="fronts", digits=0, is_more_better=None, needs_truth=True),
    )

    def measure(self, measurand: Measurand) -> Measurement:
        """Return ``janus`` and ``janus_fronts``; nothing if there is no truth or no Gaussian.

        ``janus`` is the share of the views that show a side which other views show already: 0 for the true
        object, and nearly 1 - 1/k for k equal fronts. ``janus_fronts`` is how often the asset shows the
        quarter turn that it shows most, compared with the true object. The turn of the asset does not matter.
        An object without a front, such as one that looks the same from all sides, has no number, and the
        record says so.
        """
        if len(measurand.gaussians) == 0 or measurand.truth is None:
            return Measurement({})
        asset = _features(lambda cameras, background: measurand.render(cameras, background).rgb[None])[0]
        modes = _features(measurand.truth.images)
        # The mode of which each view of the asset resembles some view most.
        nearest = [torch.cdist(asset, mode).square().min(dim=1).values.mean() for mode in modes]
        return _by_truth(asset, modes[int(torch.stack(nearest).argmin())])


def _by_truth(asset: Float[Tensor, "v p"], true: Float[Tensor, "v p"]) -> Measurement:
    """Return both numbers for the features of an asset and of the true object."""
    centre = true.mean(dim=0)
    _, sizes, directions = torch.linalg.svd(true - centre, full_matrices=False)
    directions = directions[sizes > LEAST_DIRECTION * sizes.max()]
    ours, theirs = (asset - centre) @ directions.T, (true - centre) @ directions.T
    pixels = true.shape[1]
    differences = torch.cdist(ours, theirs).square() / pixels
    among_true = torch.cdist(theirs, theirs).square() / pixels
    spread = float(among_true.sum()) / (VIEWS * (VIEWS - 1))
    error = float(differences.min(dim=1).values.mean())
    noise = max(NOISE * error, LEAST_NOISE * spread, torch.finfo(torch.float64).tiny)
    # How often the asset shows each side, and how often the true object does.
    shown = (-differences / noise).softmax(dim=1).sum(dim=0)
    expected = (-among_true / noise).softmax(dim=1).sum(dim=0)
    settings = {"views": VIEWS, "elevation_deg": ELEVATION_DEG, "fov_y_deg": FOV_DEG, "size": SIZE}
    record = {
        "protocol": {"name": "truth", **settings},
        # For each view of the asset, from azimuth 0 on, the azimuth of the true view that it looks like.
        "views": {"looks_like_deg": [360.0 / VIEWS * int(best) for best in differences.argmin(dim=1)]},
    }
    if spread < LEAST_SPREAD:
        reason = "the true object looks the same from all sides, so it has no front"
        return Measurement({}, {"janus": {"value": None, "reason": reason, **record}})
    fronts = (_by_quarters(shown) / _by_quarters(expected)).max().round()
    numbers = {
        "janus": float(0.5 * (shown - expected).abs().sum() / VIEWS),
        "janus_fronts": float(fronts),
    }
    return Measurement(numbers, {name: {"value": value, **record} for name, value in numbers.items()})


def _by_quarters(counts: Float[Tensor, "v"]) -> Float[Tensor, "v"]:
    """Return the sums over the quarter turns that begin at each view."""
    return torch.stack([counts.roll(-first)[: VIEWS // 4].sum() for first in range(VIEWS)])


def _features(images: Callable[[Cameras, Tensor], Tensor]) -> Float[Tensor, "m v p"]:
    """Return opacity and hue of each pixel of all views, for each mode, whatever the light is."""
    cameras = turntable(
        VIEWS, elevation_deg=ELEVATION_DEG, distance=fitting_distance(FOV_DEG), fov_y_deg=FOV_DEG, size=SIZE
    )
    parts = []
    for some in cameras.parts(VIEWS_AT_ONCE):
        black, white = (
            images(some, torch.full((len(some), 3), level)).detach().cpu().double().clamp(0, 1)
            for level in (0.0, 1.0)
        )
        alpha = 1 - (white - black).mean(dim=-1, keepdim=True)
        parts.append(torch.cat([alpha, black / (black.sum(dim=-1, keepdim=True) + DARK)], dim=-1))
    return torch.cat(parts, dim=1).flatten(2)
