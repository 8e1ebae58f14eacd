"""Trajectories of a prior between noise levels: inversion towards larger t, sampling towards smaller t."""

import math
from collections.abc import Sequence
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.prior.base import Condition, DiffusionPrior
from cadam3d.prior.path import per_view

# Both halves of an unprompted condition are empty. At scale 1 a prior needs to evaluate only one of them.
UNGUIDED = 1.0
# Distance in t between two of the thousand rows of Stable Diffusion's noise table. The first is at t = ROW.
ROW = 0.001
# Tolerance in strides, so that 0.6 / 0.2 gives three steps in spite of rounding.
TIE = 1e-4


def ddim(
    noisy: Float[Tensor, "v c h w"],
    levels: Sequence[Float[Tensor, "v"]],
    condition: Condition,
    prior: DiffusionPrior,
    scale: float = UNGUIDED,
) -> Float[Tensor, "v c h w"]:
    """Follow the prior's deterministic trajectory (DDIM, eta = 0) from the first of ``levels`` to the last.

    ``noisy`` is at the first level, the returned image at the last. Every level except the last costs one
    prediction. On a flow path each step is an Euler step. A view keeps its image while its level stays equal.
    """
    for now, then in pairwise(levels):
        guess = prior.predict(noisy, now, condition, scale)
        has_arrived = per_view(now) == per_view(then)
        noisy = torch.where(has_arrived, noisy, prior.noise_path.mix(guess.clean, guess.noise, then))
    return noisy


def strides(start: Float[Tensor, "v"], end: Float[Tensor, "v"], stride: float) -> list[Float[Tensor, "v"]]:
    """Return levels from ``start`` to ``end``, ``stride`` apart in t; the last step may be shorter.

    A view that has arrived repeats its last level until all views have. If no view has any distance to go,
    the list holds ``start`` alone.
    """
    length, way = (end - start).abs(), (end - start).sign()
    steps = math.ceil(float(length.max()) / stride - TIE)
    marks = [k * stride for k in range(1, steps)]
    between = [torch.where(length > mark, start + way * mark, end) for mark in marks]
    return [start, *between, end] if steps > 0 else [start]
