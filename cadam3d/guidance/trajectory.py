"""The prior's own trajectory between noise levels: inversion upwards in t, sampling downwards."""

import math
from collections.abc import Sequence
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.prior.base import Condition, DiffusionPrior
from cadam3d.prior.path import per_view

UNGUIDED = 1.0  # both halves of an unprompted condition are empty; at 1 a prior needs only one of them
TIE = 1e-4  # of a stride: 0.6 / 0.2 is three steps, whatever the rounding says


def ddim(
    noisy: Float[Tensor, "v c h w"],
    levels: Sequence[Float[Tensor, "v"]],
    condition: Condition,
    prior: DiffusionPrior,
    scale: float = UNGUIDED,
) -> Float[Tensor, "v c h w"]:
    """Follow the prior's deterministic trajectory (DDIM, eta = 0) from the first of ``levels`` to the last.

    ``noisy`` lies at the first, the answer at the last; every level but the last costs one prediction. On a
    flow path a step is one of Euler's. A view whose level does not change keeps its image.
    """
    for now, then in pairwise(levels):
        guess = prior.predict(noisy, now, condition, scale)
        has_arrived = per_view(now) == per_view(then)
        noisy = torch.where(has_arrived, noisy, prior.noise_path.mix(guess.clean, guess.noise, then))
    return noisy


def strides(start: Float[Tensor, "v"], end: Float[Tensor, "v"], stride: float) -> list[Float[Tensor, "v"]]:
    """Levels from ``start`` to ``end``, ``stride`` apart in t; the last step is shorter.

    A view that has arrived waits for the others. Without any distance to go, ``start`` alone.
    """
    length, way = (end - start).abs(), (end - start).sign()
    steps = math.ceil(float(length.max()) / stride - TIE)
    marks = [k * stride for k in range(1, steps)]
    between = [torch.where(length > mark, start + way * mark, end) for mark in marks]
    return [start, *between, end] if steps > 0 else [start]
