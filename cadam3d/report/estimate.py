"""Estimate: a difference over prompts with its interval and exact tests, and Holm's correction.

Prompts are the sample, because the seeds, noise levels and objectives of one prompt share its object and are
not independent. Each prompt therefore counts once, with the median of its cells. The interval and the p-value
are those of Wilcoxon's signed ranks: both follow from all coin flips of the signs of the prompts, which
needs no shape of the distribution. ``tests/report/test_coverage.py`` simulates them.
"""

import math
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from jaxtyping import Float

from cadam3d.report.results import PROMPT, Cell

CONFIDENCE = 0.95


@dataclass(frozen=True)
class Estimate:
    """The typical value over prompts: the median of the means of all pairs of prompts, with its uncertainty.

    A pair may be one prompt twice. This is the estimate of Hodges and Lehmann (1963).
    """

    value: float
    # Ends of the 95 % interval; None with fewer than six prompts, too few to exclude any value.
    low: float | None
    high: float | None
    p_value: float  # two-sided, of the signed-rank test of "the typical value is 0"
    above: int  # prompts above 0
    below: int  # prompts below 0
    cells: int
    prompts: int

    @classmethod
    def of(cls, values: Mapping[Cell, float]) -> "Estimate":
        """Return the estimate from one value per cell, of which there must be at least one."""
        by_prompt: dict[str, list[float]] = defaultdict(list)
        for cell, value in values.items():
            by_prompt[cell[PROMPT]].append(value)
        prompts = np.array([np.median(group) for group in by_prompt.values()])
        first, second = np.triu_indices(len(prompts))
        means = np.sort((prompts[first] + prompts[second]) / 2)
        # The sum of the ranks of the prompts above 0 is the number of means above 0 (Tukey, 1949).
        chances = signed_rank_chances(len(prompts))
        agreeing = int(max((means > 0).sum(), (means < 0).sum()))
        outside = int((chances <= (1 - CONFIDENCE) / 2).sum())
        return cls(
            value=float(np.median(means)),
            low=float(means[outside - 1]) if outside else None,
            high=float(means[-outside]) if outside else None,
            p_value=min(1.0, 2 * float(chances[len(means) - agreeing])),
            above=int((prompts > 0).sum()),
            below=int((prompts < 0).sum()),
            cells=len(values),
            prompts=len(prompts),
        )

    @property
    def sign_p_value(self) -> float:
        """Return the two-sided p-value of the sign test over prompts; prompts at 0 are left out."""
        n, fewer = self.above + self.below, min(self.above, self.below)
        return min(1.0, 2 * sum(math.comb(n, k) for k in range(fewer + 1)) / 2**n)

    def mapped(self, function: Callable[[float], float]) -> "Estimate":
        """Return the estimate on another scale; ``function`` must rise and keep 0."""
        low, high = (None if end is None else function(end) for end in (self.low, self.high))
        return replace(self, value=function(self.value), low=low, high=high)

    def written(self, digits: int) -> str:
        """Return the value and its interval as text, such as ``+0.21 [+0.03, +0.36]``."""
        value = f"{self.value:+.{digits}f}"
        if self.low is None or self.high is None:
            return value
        return f"{value} [{self.low:+.{digits}f}, {self.high:+.{digits}f}]"


@cache
def signed_rank_chances(n: int) -> Float[np.ndarray, "sums"]:
    """Return the chance that the ranks 1 to ``n``, each kept with probability 1/2, sum to 0 at most, 1, ...

    This is the distribution of Wilcoxon's signed-rank statistic (1945) if all values have random signs.
    """
    chances = np.ones(1)
    for rank in range(1, n + 1):
        chances = (np.pad(chances, (0, rank)) + np.pad(chances, (rank, 0))) / 2
    return np.cumsum(chances)


def holm(p_values: Sequence[float]) -> list[float]:
    """Return p-values that are corrected for their number, by Holm's method (1979)."""
    corrected = [0.0] * len(p_values)
    highest = 0.0
    for rank, i in enumerate(sorted(range(len(p_values)), key=p_values.__getitem__)):
        highest = max(highest, min(1.0, p_values[i] * (len(p_values) - rank)))
        corrected[i] = highest
    return corrected
