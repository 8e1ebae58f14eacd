"""Reductions of many numbers to one that torch lacks or computes slowly."""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def quantile(values: Float[Tensor, "n"], share: float) -> Float[Tensor, ""]:
    """Return the quantile ``share`` of ``values``, with linear interpolation, for any ``n``.

    ``torch.quantile`` refuses more than 2^24 values. The rank is a double, which represents every possible
    row number exactly. Infinity if there are no values, so that nothing exceeds it.
    """
    if len(values) == 0:
        return values.new_tensor(math.inf)
    rank = share * (len(values) - 1)
    below = math.floor(rank)
    # kthvalue is faster on most values, but takes quadratic time on ordered ones.
    ordered = values.sort().values
    return torch.lerp(ordered[below], ordered[math.ceil(rank)], rank - below)


def all_finite(values: Float[Tensor, "n 3"]) -> Bool[Tensor, ""]:
    """Return whether no value is NaN or infinite, in one pass and without a temporary."""
    if values.numel() == 0:
        return torch.ones((), dtype=torch.bool, device=values.device)
    # Both are NaN if any value is.
    low, high = values.aminmax()
    # A product with 0 is NaN if the factor is NaN or infinite.
    return (low * 0 + high * 0) == 0
