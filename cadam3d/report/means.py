"""Means: averages over prompts and paired differences, with 95 % intervals over prompts.

The paper's table has means. The other tables of a sweep have medians.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student

from cadam3d.report.claims import CONFIDENCE


@dataclass(frozen=True)
class Mean:
    """A mean over prompts, or a difference or a ratio of means."""

    value: float
    half: float | None  # half the width of its 95 % interval; None for a single prompt
    prompts: int


def mean(values: Mapping[str, float]) -> Mean | None:
    """Return the mean of one value per prompt with Student's t interval; None without values."""
    if not values:
        return None
    numbers = list(values.values())
    return Mean(float(np.mean(numbers)), _half(numbers), len(numbers))


def difference(ours: Mapping[str, float], theirs: Mapping[str, float]) -> Mean | None:
    """Return the mean of ``ours`` minus ``theirs`` over the prompts that both have; None without any."""
    return mean({prompt: ours[prompt] - theirs[prompt] for prompt in ours.keys() & theirs.keys()})


def change(ours: Mapping[str, float], theirs: Mapping[str, float]) -> Mean | None:
    """Return the mean of ``ours`` over that of ``theirs``, minus 1, over the prompts that both have.

    The interval is that of the ratio of two paired means by linearisation: the mean of ``ours - ratio *
    theirs`` is 0, and its interval is divided by the mean of ``theirs``. None without a prompt that both
    have, and if the mean of ``theirs`` is 0.
    """
    both = sorted(ours.keys() & theirs.keys())
    if not both or not (base := float(np.mean([theirs[prompt] for prompt in both]))):
        return None
    ratio = float(np.mean([ours[prompt] for prompt in both])) / base
    half = _half([ours[prompt] - ratio * theirs[prompt] for prompt in both])
    return Mean(ratio - 1, None if half is None else half / abs(base), len(both))


def _half(values: Sequence[float]) -> float | None:
    """Return half the width of Student's t interval of the mean; None for a single value."""
    if len(values) < 2:
        return None
    quantile = float(student.ppf((1 + CONFIDENCE) / 2, len(values) - 1))
    return quantile * float(np.std(values, ddof=1)) / math.sqrt(len(values))
