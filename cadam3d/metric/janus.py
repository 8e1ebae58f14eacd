"""Janus: how many fronts an asset has. Text-to-3D often shows the same face from several sides.

The true object answers the question without a model. Each view of the asset looks like some view of the true
object. If the asset has one front, its views show every side of the object as often as the object itself
does. If it has two, one side is seen twice and another one never.

Only what differs between the views of the true object says from where it is seen. Pictures are therefore
projected onto the space of these differences, which removes blur and noise. Brightness is left out,
because light makes a difference between the sides of a ball.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.cameras import Cameras, fitting_distance, turntable
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
# Differences smaller than this share of the spread are no evidence.
LEAST_NOISE = 0.05
# Directions with a smaller share of the largest singular value are left out of the projection.
LEAST_DIRECTION = 1e-3


@dataclass(frozen=True, kw_only=True)
class Janus(Metric):
    """Compare which sides the asset shows with those that the true object shows."""

    def measure(self, measurand: Measurand) -> Measurement:
        """Return ``janus`` in [0, 1) and ``janus_fronts``; nothing without a truth or without Gaussians.

        ``janus`` is the share of the views that show a side which the other views show already: 0 for the
        true object, and nearly 1 - 1/k for k equal fronts. ``janus_fronts`` is how often the asset shows the
        quarter turn that it shows most, compared with the true object: 1, 2, 3 and so on. The turn of the
        asset does not matter. An object that looks the same from all sides has no front and no number; the
        record says so.
        """
        truth = measurand.truth
        if truth is None or len(measurand.gaussians) == 0:
            return Measurement({})
        asset = _features(lambda cameras, background: measurand.render(cameras, background).rgb[None])[0]
        best = min((_compare(asset, mode) for mode in _features(truth.images)), key=lambda each: each.error)
        if best.spread < LEAST_SPREAD:
            reason = "the true object looks the same from all sides, so it has no front"
            return Measurement({}, {"janus": {"value": None, "reason": reason, **_protocol()}})
        return best.measurement()


@dataclass(frozen=True)
class _Comparison:
    """The views of an asset, compared with those of one mode of the truth."""

    likeness: Float[Tensor, "v v"]  # of each view of the asset to each true one; rows have the sum 1
    expected: Float[Tensor, "v"]  # how often the true object shows each side
    error: float  # mean squared difference to the most similar true view
    spread: float  # mean squared difference between two true views

    def measurement(self) -> Measurement:
        shown = self.likeness.sum(dim=0)
        repeated = 0.5 * (shown - self.expected).abs().sum() / VIEWS
        quarter = VIEWS // 4

        def by_quarters(counts: Tensor) -> Tensor:
            return torch.stack([counts.roll(-first)[:quarter].sum() for first in range(VIEWS)])

        fronts = (by_quarters(shown) / by_quarters(self.expected)).max().round()
        numbers = {"janus": float(repeated), "janus_fronts": float(fronts)}
        record = {
            **_protocol(),
            # For each view of the asset from azimuth 0 on, the azimuth of the true view that it looks like.
            "looks_like_deg": [360.0 / VIEWS * int(best) for best in self.likeness.argmax(dim=1)],
            # For each true view from azimuth 0 on, how often it is shown, and how often it should be.
            "shown": [round(float(count), 4) for count in shown],
            "expected": [round(float(count), 4) for count in self.expected],
            "error": self.error,
            "spread": self.spread,
        }
        return Measurement(numbers, {name: {"value": value, **record} for name, value in numbers.items()})


def _protocol() -> dict[str, Any]:
    views = {"views": VIEWS, "elevation_deg": ELEVATION_DEG, "fov_y_deg": FOV_DEG, "size": SIZE}
    return {"protocol": {"name": "truth", **views}}


def _compare(asset: Float[Tensor, "v p"], true: Float[Tensor, "v p"]) -> _Comparison:
    pixels = true.shape[1]
    centre = true.mean(dim=0)
    _, sizes, directions = torch.linalg.svd(true - centre, full_matrices=False)
    directions = directions[sizes > LEAST_DIRECTION * sizes.max()]
    ours, theirs = (asset - centre) @ directions.T, (true - centre) @ directions.T
    differences = torch.cdist(ours, theirs).square() / pixels
    among_true = torch.cdist(theirs, theirs).square() / pixels
    spread = float(among_true.sum()) / (VIEWS * (VIEWS - 1))
    error = float(differences.min(dim=1).values.mean())
    noise = max(error, LEAST_NOISE * spread, torch.finfo(torch.float64).tiny)
    return _Comparison(
        likeness=(-differences / noise).softmax(dim=1),
        expected=(-among_true / noise).softmax(dim=1).sum(dim=0),
        error=error,
        spread=spread,
    )


def _features(images: Callable[[Cameras, Tensor], Tensor]) -> Float[Tensor, "m v p"]:
    """Return opacity and hue of each pixel of all views, for each mode, whatever the light is."""
    cameras = turntable(
        VIEWS, elevation_deg=ELEVATION_DEG, distance=fitting_distance(FOV_DEG), fov_y_deg=FOV_DEG, size=SIZE
    )
    parts = []
    for first in range(0, VIEWS, VIEWS_AT_ONCE):
        some = cameras.index(slice(first, first + VIEWS_AT_ONCE))
        black, white = (
            images(some, torch.full((len(some), 3), level)).detach().cpu().double().clamp(0, 1)
            for level in (0.0, 1.0)
        )
        alpha = 1 - (white - black).mean(dim=-1, keepdim=True)
        parts.append(torch.cat([alpha, black / (black.sum(dim=-1, keepdim=True) + DARK)], dim=-1))
    return torch.cat(parts, dim=1).flatten(2)
