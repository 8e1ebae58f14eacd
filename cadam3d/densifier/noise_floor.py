"""Distribution of the SNR of pure noise, and the threshold that noise exceeds with a given probability.

Let the gradients of a Gaussian be zero-mean noise, independent from step to step, equally strong along the
three axes. Then the bias-corrected first moment is a weighted mean with

    s(beta, a) = sum of squared weights = (1 - beta)(1 + beta^a) / ((1 + beta)(1 - beta^a))

after ``a`` updates, so E[SNR^2] is about s(beta1, a): 1 at age 1, and (1 - beta1) / (1 + beta1) in the end.

For its distribution, stack the gradients of ``n`` equally weighted steps into one vector of 3n numbers. Its
direction is uniform, and the share of its energy that is in a fixed subspace of 3 dimensions (the weights of
the first moment, once per axis) follows Beta(3/2, 3 (n - 1)/2). The weights of the second moment are not
quite equal; n = 1 / s(beta2, a) is its effective number of steps. Hence

    SNR^2 ~ s(beta1, a) n Beta(3/2, 3 (n - 1)/2).

This is exact if v has an infinite memory. ``tests/densifier/test_noise_floor.py`` shows that it is close for
any memory at least as long as with beta2 = beta1^2. For large n it becomes s(beta1, a) chi^2_3 / 3.
"""

import math

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

AXES = 3  # along which the noise is assumed to be equally strong


def snr_threshold(alpha: float, beta1: float, beta2: float, age: Int[Tensor, "n"]) -> Float[Tensor, "n"]:
    """Return the SNR that pure noise of this ``age`` (in updates) exceeds with probability ``alpha``.

    Infinite below age 2, because a single gradient cannot show whether it is consistent. Waits for the
    device.
    """
    from scipy.special import betaincinv  # takes a fifth of a second to import

    ages, rows = age.unique(return_inverse=True)
    grown = np.maximum(ages.cpu().numpy().astype(np.float64), 2)
    steps = 1 / squared_weights(beta2, grown)
    share = betaincinv(AXES / 2, AXES * (steps - 1) / 2, 1 - alpha)
    thresholds = torch.from_numpy(np.sqrt(squared_weights(beta1, grown) * steps * share))
    return thresholds.float().to(age.device)[rows].masked_fill(age < 2, torch.inf)


def white_noise_snr(beta1: float, beta2: float) -> float | None:
    """Return the root mean square SNR of stationary white noise: ``sqrt((1 - beta1) / (1 + beta1))``.

    ``None`` for a ``beta2`` below 0.99: with so short a second moment the SNR of noise has no fixed level.
    """
    return math.sqrt((1 - beta1) / (1 + beta1)) if beta2 >= 0.99 else None


def squared_weights(beta: float, age: np.ndarray) -> np.ndarray:
    """Return the sum of squared weights of a bias-corrected moving average: 1 / its effective steps."""
    fading = beta**age
    return (1 - beta) * (1 + fading) / ((1 + beta) * (1 - fading))
