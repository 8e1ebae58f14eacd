"""Prompting: the texts that describe each view, and how their embeddings are mixed or repelled.

A prompting turns a prompt into a few texts, which are embedded once, and every view into weights over these
texts. Azimuth 0 is the front. This module is independent of networks: a :class:`Mix` holds weights, and
:func:`guide` combines predictions.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.cameras import Cameras
from cadam3d.core.checks import Declared, Elevation, one_of, within
from cadam3d.prior.path import PerView

FRONT, SIDE, BACK, OVERHEAD = range(4)
SUFFIXES = (", front view", ", side view", ", back view", ", overhead view")
# Eight sides of the object, an eighth of a turn apart, from the front on. Left and right are as seen from the
# front.
SIDES = ("front", "front right", "right", "back right", "back", "back left", "left", "front left")
# From below, at the height of the object, and from above.
HEIGHTS = (" from below", "", " from above")
# The angle between front, side and back. Embeddings are interpolated within it.
QUARTER = 90.0  # degrees
EIGHTH = 45.0  # degrees


@dataclass(frozen=True)
class Mix:
    """The text to approach and the texts to avoid (Perp-Neg) for each view, as weights over ``k`` texts."""

    positive: Float[Tensor, "v k"]  # rows sum to 1
    repelled: Float[Tensor, "v m k"]  # rows sum to 1; m may be 0
    strengths: Float[Tensor, "v m"]  # of the repulsion, <= 0


class Prompting(Declared, ABC):
    """Decides how a prompt describes views. Holds frozen hyper-parameters."""

    @abstractmethod
    def texts(self, prompt: str) -> list[str]:
        """Return the ``k`` texts to embed."""

    @abstractmethod
    def mix(self, cameras: Cameras) -> Mix:
        """Return the weights of the texts for each view, on the device of the cameras."""


@dataclass(frozen=True, kw_only=True)
class Plain(Prompting):
    """The same prompt for every view."""

    def texts(self, prompt: str) -> list[str]:
        """Return the prompt alone."""
        return [prompt]

    def mix(self, cameras: Cameras) -> Mix:
        """Return weight 1 for every view."""
        return _attract(torch.ones_like(cameras.azimuth_deg)[:, None])


@dataclass(frozen=True, kw_only=True)
class Discrete(Prompting):
    """One of four texts per view, by threestudio's rule: front, side, back or overhead.

    A view above ``overhead_deg`` is overhead, whatever its azimuth.
    """

    front_deg: Annotated[float, within(low=0, high=180)]
    back_deg: Annotated[float, within(low=0, high=180)]
    overhead_deg: Elevation

    def __post_init__(self) -> None:
        super().__post_init__()
        most = 180 - self.front_deg
        self.expect(self.back_deg <= most, "back_deg", f"at most {most:g}, as front_deg={self.front_deg:g}")

    def texts(self, prompt: str) -> list[str]:
        """Return the prompt with each of the four suffixes."""
        return [prompt + suffix for suffix in SUFFIXES]

    def mix(self, cameras: Cameras) -> Mix:
        """Return one-hot rows; if several rules fit a view, the last one applies."""
        turned = cameras.azimuth_deg.abs()
        which = torch.full_like(turned, SIDE, dtype=torch.int64)
        which[turned < self.front_deg] = FRONT
        which[turned > 180 - self.back_deg] = BACK
        which[cameras.elevation_deg > self.overhead_deg] = OVERHEAD
        return _attract(_one_hot(which, len(SUFFIXES), cameras.azimuth_deg))


@dataclass(frozen=True, kw_only=True)
class Compass(Prompting):
    """One of 24 texts per view: eight sides, each from below, at the height of the object, and from above."""

    below_deg: Elevation
    above_deg: Elevation

    def __post_init__(self) -> None:
        super().__post_init__()
        expected = f"at least below_deg={self.below_deg:g}"
        self.expect(self.above_deg >= self.below_deg, "above_deg", expected)

    def texts(self, prompt: str) -> list[str]:
        """Return the prompt with the words of every side and height."""
        return [f"{prompt}, {side} view{height}" for height in HEIGHTS for side in SIDES]

    def mix(self, cameras: Cameras) -> Mix:
        """Return one-hot rows, for the nearest side and the height of each view."""
        eighths = (cameras.azimuth_deg / EIGHTH).round().long() % len(SIDES)
        elevation = cameras.elevation_deg
        height = (elevation >= self.below_deg).long() + (elevation > self.above_deg).long()
        which = height * len(SIDES) + eighths
        return _attract(_one_hot(which, len(SIDES) * len(HEIGHTS), cameras.azimuth_deg))


@dataclass(frozen=True, kw_only=True)
class Interpolated(Prompting):
    """Embeddings that change linearly with azimuth: front, side at 90 degrees, back (LucidDreamer's rule)."""

    def texts(self, prompt: str) -> list[str]:
        """Return the prompt with the suffixes of front, side and back."""
        return [prompt + suffix for suffix in SUFFIXES[:OVERHEAD]]

    def mix(self, cameras: Cameras) -> Mix:
        """Return rows with at most two weights that are not 0."""
        return _attract(_around(cameras.azimuth_deg, OVERHEAD))


@dataclass(frozen=True, kw_only=True)
class PerpNeg(Prompting):
    """Interpolated, and repelled from neighbouring views perpendicular to the prompt (Perp-Neg).

    Armandpour et al. 2023 propose it against the Janus problem: a side view must not look like a front view.
    Let rho be 1 at the first view of a quarter (front, or side) and 0 at its second (side, or back). The
    strengths come from the released code:

    ==============  =======================  =====================================================
    quarter         repelled                 ``lucid`` (LucidDreamer, GCS-BEG)
    ==============  =======================  =====================================================
    front to side   front                    -2 exp(-2 rho), 0 where rho > 0.8
    front to side   side                     -2 exp(-10 (1 - rho)), 0 where rho < 0.2
    side to back    side                     -exp(-10 rho), 0 where rho > 0.8
    side to back    front                    -2
    ==============  =======================  =====================================================

    ``threestudio`` uses -(a exp(-b r) + c). In the first quarter (a, b, c) is (4, 0.5, -2.426) for the front
    with r = rho and for the side with r = 1 - rho. In the second quarter, it is (1, 0.5, -0.606) for the side
    and (1, 0.5, 0.967) for the front, both with r = rho. Views above ``overhead_deg`` are overhead views;
    nothing is repelled from them.
    """

    curve: Annotated[str, one_of(("lucid", "threestudio"))]
    overhead_deg: Elevation | None

    def texts(self, prompt: str) -> list[str]:
        """Return the prompt with each of the four suffixes."""
        return [prompt + suffix for suffix in SUFFIXES]

    def mix(self, cameras: Cameras) -> Mix:
        """Return weights with two repelled texts per view, in the order of the table above."""
        k = len(SUFFIXES)
        azimuth = cameras.azimuth_deg
        turned = azimuth.abs()
        is_first = turned < QUARTER
        rho = torch.where(is_first, 1 - turned / QUARTER, 2 - turned / QUARTER)
        positive = _around(azimuth, k)
        # A table of these numbers would have to be copied to the device, which waits for it.
        names = torch.stack([torch.where(is_first, FRONT, SIDE), torch.where(is_first, SIDE, FRONT)], dim=-1)
        curves = _lucid_strengths if self.curve == "lucid" else _threestudio_strengths
        strengths = torch.where(is_first[:, None], curves(rho, True), curves(rho, False))
        if self.overhead_deg is not None:
            is_overhead = (cameras.elevation_deg > self.overhead_deg)[:, None]
            above = _one_hot(torch.full_like(turned, OVERHEAD, dtype=torch.int64), k, azimuth)
            positive = torch.where(is_overhead, above, positive)
            strengths = torch.where(is_overhead, 0.0, strengths)
        return Mix(positive=positive, repelled=_one_hot(names, k, azimuth), strengths=strengths)


def guide(
    negative: Float[Tensor, "v *rest"],
    positive: Float[Tensor, "v *rest"],
    repelled: Sequence[Float[Tensor, "v *rest"]],
    strengths: Float[Tensor, "v m"],
    scale: float,
) -> Float[Tensor, "v *rest"]:
    """Return the prediction under guidance with Perp-Neg: negative + scale * (d + sum_i w_i perp(d_i, d)).

    Here d = positive - negative, d_i = repelled_i - negative, and perp(a, d) is the component of a
    perpendicular to d, for each view over all elements. Without repelled predictions this is conventional
    classifier-free guidance.
    """
    direction = positive - negative
    flat = direction.flatten(1)
    total = direction
    for i, other in enumerate(repelled):
        away = (other - negative).flatten(1)
        along = (away * flat).sum(dim=1) / flat.square().sum(dim=1).clamp_min(1e-12)
        across = away - along[:, None] * flat
        total = total + (strengths[:, i, None] * across).view_as(direction)
    return negative + scale * total


def _lucid_strengths(rho: PerView, first: bool) -> Float[Tensor, "v 2"]:
    if first:
        front = torch.where(rho > 0.8, 0.0, -2 * torch.exp(-2 * rho))
        side = torch.where(rho < 0.2, 0.0, -2 * torch.exp(-10 * (1 - rho)))
        return torch.stack([front, side], dim=-1)
    side = torch.where(rho > 0.8, 0.0, -torch.exp(-10 * rho))
    return torch.stack([side, torch.full_like(rho, -2.0)], dim=-1)


def _threestudio_strengths(rho: PerView, first: bool) -> Float[Tensor, "v 2"]:
    def curve(a: float, c: float, r: PerView) -> PerView:
        return -(a * torch.exp(-0.5 * r) + c)

    if first:
        return torch.stack([curve(4, -2.426, rho), curve(4, -2.426, 1 - rho)], dim=-1)
    return torch.stack([curve(1, -0.606, rho), curve(1, 0.967, rho)], dim=-1)


def _around(azimuth_deg: PerView, k: int) -> Float[Tensor, "v k"]:
    """Interpolate between the front at 0, the side at 90 and the back at 180 degrees, on either side."""
    position = azimuth_deg.abs() / QUARTER
    weights = azimuth_deg.new_zeros(len(azimuth_deg), k)
    for text in (FRONT, SIDE, BACK):
        weights[:, text] = (1 - (position - text).abs()).clamp_min(0)
    return weights


def _one_hot(which: Tensor, k: int, like: Tensor) -> Tensor:
    return torch.nn.functional.one_hot(which.to(like.device), k).to(like)


def _attract(positive: Float[Tensor, "v k"]) -> Mix:
    v, k = positive.shape
    return Mix(positive=positive, repelled=positive.new_zeros(v, 0, k), strengths=positive.new_zeros(v, 0))
