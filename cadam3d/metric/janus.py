"""Janus: how many fronts an asset has. Text-to-3D often shows the same face from several sides.

There are two ways to find out. Their numbers have different meanings and must not be compared.

**By the truth.** Each view of the asset looks like some view of the true object. If the asset has one front,
its views show every side of the object as often as the object itself does. If it has two, one side is seen
twice and another one never. Only what differs between the views of the true object says from where it is
seen. Pictures are therefore projected onto the space of these differences, which removes blur and noise.
Brightness is left out, because light makes a difference between the sides of a ball.

**By a model.** A CLIP model says for each view whether it is a front, a side or a back view of the prompt,
and the asset has as many fronts as there are separate maxima of "front" over the azimuth.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from typing import Annotated, Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.cameras import Cameras, fitting_distance, turntable
from cadam3d.core.checks import Elevation, one_of, whole
from cadam3d.core.number import Number
from cadam3d.metric.base import Measurand, Measurement
from cadam3d.metric.clip import ClipMetric, load_clip
from cadam3d.metric.scoring import Scorer

WAYS = ("auto", "truth", "model")

# By the truth.
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

# By a model.
SIDES = ("front", "side", "back")
# Difference between the highest and the lowest probability of a front below which no view is one.
LEAST_CONTRAST = 0.1
# Views with at least this probability belong to a front, on a scale from the lowest (0) to the highest (1).
HALF = 0.5
# A second front is at least this far from the first one, in degrees.
APART_DEG = 120.0
MOST_VIEWS = 360


@dataclass(frozen=True, kw_only=True)
class Janus(ClipMetric):
    """The number of fronts of an asset, by the true object or by a model of pictures and texts."""

    node: ClassVar[str] = "metric.janus"
    numbers: ClassVar[tuple[Number, ...]] = (
        Number(name="janus", label="Janus score", digits=3, is_more_better=False),
        Number(name="janus_fronts", label="fronts", digits=0, is_more_better=None),
    )
    kind: ClassVar[str] = "clip"

    by: Annotated[str, one_of(WAYS)]
    views: Annotated[int, whole(low=6, high=MOST_VIEWS)]  # azimuths that the model sees
    elevation_deg: Elevation  # of these views

    def prepare(self) -> None:
        """Find the files of the model if ``by=model``. With ``by=auto``, the truth may replace it."""
        if self.by == "model":
            super().prepare()

    def scorer(self, device: torch.device) -> Scorer:
        """Return the model, whose scores are the logits of the texts for a picture."""
        clip = load_clip(self.find(), device)
        direction = cache(lambda text: clip.texts([text])[0])
        # The same pictures are compared with several texts in a row.
        pictures = lru_cache(maxsize=1)(clip.pictures)
        return Scorer(
            score=lambda images, text: clip.logit_scale * pictures(images) @ direction(text),
            facts=clip.facts,
            complaints=clip.complaints,
        )

    def measure(self, measurand: Measurand) -> Measurement:
        """Return ``janus`` and ``janus_fronts``; nothing if there is no truth or no Gaussian.

        By the truth, ``janus`` is the share of the views that show a side which other views show already: 0
        for the true object, and nearly 1 - 1/k for k equal fronts. ``janus_fronts`` is how often the asset
        shows the quarter turn that it shows most, compared with the true object. By a model, ``janus`` is the
        height of the second front, from 0 (there is none) to 1 (it is as clear as the first), and
        ``janus_fronts`` is the number of fronts. The turn of the asset does not matter. An object without a
        front, such as one that looks the same from all sides, has no number, and the record says so.
        """
        if len(measurand.gaussians) == 0 or (self.by == "truth" and measurand.truth is None):
            return Measurement({})
        if self.by == "model" or measurand.truth is None:
            return self._by_model(measurand)
        asset = _features(lambda cameras, background: measurand.render(cameras, background).rgb[None])[0]
        modes = _features(measurand.truth.images)
        # The mode of which each view of the asset resembles some view most.
        nearest = [torch.cdist(asset, mode).square().min(dim=1).values.mean() for mode in modes]
        return _by_truth(asset, modes[int(torch.stack(nearest).argmin())])

    def _by_model(self, measurand: Measurand) -> Measurement:
        scorer = self.scorer(measurand.gaussians.device)
        texts = [f"{side} view of {measurand.prompt}" for side in SIDES]
        logits = []
        for one in self.protocol.ring(self.views, self.elevation_deg).parts(1):
            images = measurand.render(one, self.protocol.backgrounds(1)).rgb.detach().float().clamp(0, 1)
            logits.append(torch.cat([self.scores(scorer, images, text) for text in texts]))
        fronts = torch.stack(logits).softmax(dim=1)[:, 0]
        self.require_finite(fronts)
        shown = {
            "views": self.views,
            "elevations_deg": [float(self.elevation_deg)],
            "text": "SIDE view of {}",
        }
        record = {
            "protocol": self.protocol.record() | shown,
            **scorer.facts,
            "text": texts[0],
            # The probability that each view is a front, from azimuth 0 on.
            "views": [round(float(each), 6) for each in fronts],
        }
        warnings = scorer.complaints(texts[0])
        lowest, highest = fronts.min(), fronts.max()
        if highest - lowest < LEAST_CONTRAST:
            return replace(_none("the model sees no side as the front", record), warnings=warnings)
        heights = (fronts - lowest) / (highest - lowest)
        away = torch.arange(self.views) * (360.0 / self.views)
        others = heights.roll(-int(heights.argmax()))[(away >= APART_DEG) & (away <= 360 - APART_DEG)]
        is_front = heights >= HALF
        count = (is_front & ~is_front.roll(1)).sum()
        return replace(_measured(others.max(), count, record), warnings=warnings)


def _none(reason: str, record: dict[str, Any]) -> Measurement:
    """Return the record of an asset without a number."""
    return Measurement({}, {"janus": {"value": None, "reason": reason, **record}})


def _measured(janus: Tensor, fronts: Tensor, record: dict[str, Any]) -> Measurement:
    numbers = {"janus": float(janus), "janus_fronts": float(fronts)}
    return Measurement(numbers, {name: {"value": value, **record} for name, value in numbers.items()})


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
        return _none("the true object looks the same from all sides, so it has no front", record)
    repeated = 0.5 * (shown - expected).abs().sum() / VIEWS
    return _measured(repeated, (_by_quarters(shown) / _by_quarters(expected)).max().round(), record)


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
