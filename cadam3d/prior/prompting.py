"""Prompting: which words stand for which view, and how their embeddings are mixed and opposed.

A prompting turns a prompt into a few texts, embedded once, and every view into weights over them. Azimuth 0
is the front. Nothing here knows a network: :class:`Mix` is numbers, :func:`guide` arithmetic on predictions.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.cameras import Cameras
from cadam3d.core.checks import require, require_choice, require_range

FRONT, SIDE, BACK, OVERHEAD = range(4)
SUFFIXES = (", front view", ", side view", ", back view", ", overhead view")
QUARTER = 90.0  # degrees between the views that embeddings are interpolated between


@dataclass(frozen=True)
class Mix:
    """Per view: the text to approach, and texts to stay away from (Perp-Neg), as weights over ``k`` texts."""

    positive: Float[Tensor, "v k"]  # rows sum to 1
    repelled: Float[Tensor, "v m k"]  # rows sum to 1; m may be 0
    strengths: Float[Tensor, "v m"]  # of the repulsion, <= 0


class Prompting(ABC):
    """How a prompt speaks of views. Frozen hyper-parameters."""

    @abstractmethod
    def texts(self, prompt: str) -> list[str]:
        """The ``k`` texts to embed."""

    @abstractmethod
    def mix(self, cameras: Cameras) -> Mix:
        """The weights of the texts for each view, on the device of the cameras."""


@dataclass(frozen=True, kw_only=True)
class Plain(Prompting):
    """The prompt, whatever the view."""

    def texts(self, prompt: str) -> list[str]:
        """The prompt alone."""
        return [prompt]

    def mix(self, cameras: Cameras) -> Mix:
        """Weight 1 everywhere."""
        return _attract(torch.ones_like(cameras.azimuth_deg)[:, None])


@dataclass(frozen=True, kw_only=True)
class Discrete(Prompting):
    """One of four texts per view: front, side, back, and overhead, which wins (threestudio's rule)."""

    front_deg: float  # |azimuth| below this is the front
    back_deg: float  # |azimuth| above 180 minus this is the back
    overhead_deg: float  # elevations above this are overhead

    def __post_init__(self) -> None:
        require_range("prompting.front_deg", self.front_deg, low=0, high=180, example=45)
        require_range("prompting.back_deg", self.back_deg, low=0, high=180, example=45)
        require_range("prompting.overhead_deg", self.overhead_deg, low=-90, high=90, example=60)
        require(
            self.front_deg + self.back_deg <= 180,
            "prompting.back_deg",
            expected="front_deg + back_deg <= 180",
            got=(self.front_deg, self.back_deg),
            example="prompting.back_deg=45",
        )

    def texts(self, prompt: str) -> list[str]:
        """The prompt with each of the four suffixes."""
        return [prompt + suffix for suffix in SUFFIXES]

    def mix(self, cameras: Cameras) -> Mix:
        """One-hot rows; of the rules that fit a view, the last one wins."""
        turned = cameras.azimuth_deg.abs()
        which = torch.full_like(turned, SIDE, dtype=torch.int64)
        which[turned < self.front_deg] = FRONT
        which[turned > 180 - self.back_deg] = BACK
        which[cameras.elevation_deg > self.overhead_deg] = OVERHEAD
        return _attract(_one_hot(which, len(SUFFIXES), cameras.azimuth_deg))


@dataclass(frozen=True, kw_only=True)
class Interpolated(Prompting):
    """Embeddings change linearly with azimuth: front, side at 90 degrees, back (LucidDreamer's rule)."""

    def texts(self, prompt: str) -> list[str]:
        """The prompt with the suffixes of front, side and back."""
        return [prompt + suffix for suffix in SUFFIXES[:OVERHEAD]]

    def mix(self, cameras: Cameras) -> Mix:
        """Rows with at most two weights."""
        return _attract(_around(cameras.azimuth_deg, OVERHEAD))


@dataclass(frozen=True, kw_only=True)
class PerpNeg(Prompting):
    """Interpolated, and pushed away from the views beside it, across the prompt only (Perp-Neg).

    Armandpour et al. 2023, against the Janus problem: a side view must not look like a front view. With rho
    = 1 at the first view of a quarter (front, then side) and 0 at its second (side, then back), the strengths
    are those of the released codes:

    ==============  =======================  =====================================================
    quarter         repelled                 ``lucid`` (LucidDreamer, GCS-BEG)
    ==============  =======================  =====================================================
    front to side   front                    -2 exp(-2 rho), 0 where rho > 0.8
    front to side   side                     -2 exp(-10 (1 - rho)), 0 where rho < 0.2
    side to back    side                     -exp(-10 rho), 0 where rho > 0.8
    side to back    front                    -2
    ==============  =======================  =====================================================

    ``threestudio`` uses -(a exp(-b r) + c): front (r = rho) and side (r = 1 - rho) in the first quarter with
    (4, 0.5, -2.426); in the second, side with (1, 0.5, -0.606) and front with (1, 0.5, 0.967), both r = rho.
    There, views above ``overhead_deg`` are overhead views, and nothing is repelled.
    """

    curve: str  # "lucid" or "threestudio"
    overhead_deg: float | None  # elevations above this are overhead views; null = there are none

    def __post_init__(self) -> None:
        require_choice("prompting.curve", self.curve, ("lucid", "threestudio"))
        if self.overhead_deg is not None:
            require_range("prompting.overhead_deg", self.overhead_deg, low=-90, high=90, example=60)

    def texts(self, prompt: str) -> list[str]:
        """The prompt with each of the four suffixes."""
        return [prompt + suffix for suffix in SUFFIXES]

    def mix(self, cameras: Cameras) -> Mix:
        """Two repelled texts per view: the first is the nearer one of its quarter's rule above."""
        k = len(SUFFIXES)
        azimuth = cameras.azimuth_deg
        turned = azimuth.abs()
        is_first = turned < QUARTER
        rho = torch.where(is_first, 1 - turned / QUARTER, 2 - turned / QUARTER)
        positive = _around(azimuth, k)
        rules = torch.tensor([[SIDE, FRONT], [FRONT, SIDE]], device=azimuth.device)
        names = rules[is_first.long()]
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
    repelled: Float[Tensor, "m v *rest"],
    strengths: Float[Tensor, "v m"],
    scale: float,
) -> Float[Tensor, "v *rest"]:
    """Classifier-free guidance with Perp-Neg: negative + scale * (d + sum_i w_i perp(d_i, d)).

    d = positive - negative, d_i = repelled_i - negative, and perp(a, d) is the part of a across d, per view
    over all elements. Without repelled predictions this is the conventional form.
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


def _lucid_strengths(rho: Float[Tensor, "v"], first: bool) -> Float[Tensor, "v 2"]:
    if first:
        front = torch.where(rho > 0.8, 0.0, -2 * torch.exp(-2 * rho))
        side = torch.where(rho < 0.2, 0.0, -2 * torch.exp(-10 * (1 - rho)))
        return torch.stack([front, side], dim=-1)
    side = torch.where(rho > 0.8, 0.0, -torch.exp(-10 * rho))
    return torch.stack([side, torch.full_like(rho, -2.0)], dim=-1)


def _threestudio_strengths(rho: Float[Tensor, "v"], first: bool) -> Float[Tensor, "v 2"]:
    def curve(a: float, c: float, r: Float[Tensor, "v"]) -> Float[Tensor, "v"]:
        return -(a * torch.exp(-0.5 * r) + c)

    if first:
        return torch.stack([curve(4, -2.426, rho), curve(4, -2.426, 1 - rho)], dim=-1)
    return torch.stack([curve(1, -0.606, rho), curve(1, 0.967, rho)], dim=-1)


def _around(azimuth_deg: Float[Tensor, "v"], k: int) -> Float[Tensor, "v k"]:
    """Linear between the front at 0, the side at 90 and the back at 180 degrees, either way round."""
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
