"""Intervals and tests for answers that share raters and prompts.

The answers of one rater resemble each other, and so do the answers about one prompt. A formula for
independent answers would give intervals that are far too narrow. All intervals here have one form: an
estimate in log-odds, plus and minus a quantile of Student's t times a standard error that clusters the
answers by rater and by prompt. ``docs/notes/study_statistics.md`` has the measured coverage.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import expit, logit, stdtrit
from scipy.stats import binomtest

CONFIDENCE = 0.95


@dataclass(frozen=True)
class Interval:
    """The ends of a 95 % confidence interval."""

    low: float
    high: float


@dataclass(frozen=True)
class Clusters:
    """The rater and the prompt of each of n answers, as positions counted from 0."""

    raters: Int[np.ndarray, "n"]
    prompts: Int[np.ndarray, "n"]

    @classmethod
    def of(cls, raters: Sequence[str], prompts: Sequence[str]) -> "Clusters":
        """Return the clusters of answers from the names of their raters and prompts."""
        return cls(*(np.unique(names, return_inverse=True)[1] for names in (raters, prompts)))

    @cached_property
    def cells(self) -> Int[np.ndarray, "n"]:
        """Return the position of the pair of rater and prompt to which each answer belongs."""
        return np.unique(self.raters * (self.prompts.max() + 1) + self.prompts, return_inverse=True)[1]


def margin(influences: Float[np.ndarray, "n"], clusters: Clusters) -> float:
    """Return half the width of the 95 % interval of an estimate; infinity if there is only one cell.

    ``influences`` says by how much each answer moves the estimate; they sum to 0. The variance has three
    parts: what single answers contribute, and what raters, and what prompts, contribute beyond that. It is
    the two-way clustered variance of Cameron, Gelbach and Miller (2011), ``V_rater + V_prompt - V_answer``,
    except that no part is negative. The degrees of freedom of t follow Welch and Satterthwaite, but at
    least the smaller number of clusters minus 1. With a single rater the interval is about prompts alone, and
    with a single prompt about raters alone.
    """
    cells = int(clusters.cells.max()) + 1
    if cells == 1:
        return np.inf
    # An arm with several seeds has several answers in a cell, which may resemble each other as well.
    answer = max(_variance(influences, np.arange(len(influences))), _variance(influences, clusters.cells))
    ways = [groups for groups in (clusters.raters, clusters.prompts) if groups.max() > 0]
    parts = [(_variance(influences, groups), int(groups.max())) for groups in ways]
    beyond = [(variance, freedom) for variance, freedom in parts if variance > answer]
    variance = answer + sum(each - answer for each, _ in beyond)
    freedom: float = cells - 1
    if beyond:
        satterthwaite = variance**2 / sum(each**2 / own for each, own in beyond)
        freedom = max(satterthwaite, min(own for _, own in parts))
    return float(stdtrit(freedom, (1 + CONFIDENCE) / 2) * np.sqrt(variance))


def _variance(influences: Float[np.ndarray, "n"], groups: Int[np.ndarray, "n"]) -> float:
    """Return the variance of an estimate if only the groups of answers are independent of each other."""
    sums = np.bincount(groups, weights=influences)
    return float((sums**2).sum() * len(sums) / (len(sums) - 1))


def rate_interval(chosen: Bool[np.ndarray, "n"], clusters: Clusters) -> Interval:
    """Return the interval of the rate at which an arm is chosen, in [0, 1]; n is at least 1.

    If all answers agree, one end is that rate itself, and :func:`_unanimous` gives the other one. Answers in
    a single cell say nothing about others, and give the interval from 0 to 1.
    """
    if clusters.cells.max() == 0:
        return Interval(0.0, 1.0)
    share = float(chosen.mean())
    if share == 1:
        return Interval(_unanimous(clusters), 1.0)
    if share == 0:
        return Interval(0.0, 1 - _unanimous(clusters))
    half = margin((chosen - share) / (len(chosen) * share * (1 - share)), clusters)
    low, high = expit(logit(share) + np.array([-half, half]))
    return Interval(float(low), float(high))


def _unanimous(clusters: Clusters) -> float:
    """Return the lower end of the interval of a rate if all answers choose the arm.

    Such answers do not show how much raters and prompts differ. The result is the larger of two bounds that
    are both cautious: the exact bound of a study with as many answers as there are raters or prompts,
    whichever are fewer, and the bound of this study with one answer reversed.
    """
    units = min(int(groups.max()) + 1 for groups in (clusters.raters, clusters.prompts) if groups.max() > 0)
    exact = ((1 - CONFIDENCE) / 2) ** (1 / units)
    # Answers that share rater, prompt and cell with equally many others are interchangeable. One of each kind
    # is reversed, and the lowest bound counts.
    groupings = (clusters.raters, clusters.prompts, clusters.cells)
    sizes = np.stack([np.bincount(groups)[groups] for groups in groupings])
    _, kinds = np.unique(sizes, axis=1, return_index=True)
    positions = np.arange(len(clusters.cells))
    turned = min(rate_interval(positions != i, clusters).low for i in kinds)
    return max(exact, turned)


def sign_test(chosen: Bool[np.ndarray, "n"], units: Int[np.ndarray, "n"]) -> float:
    """Return the two-sided p-value of "neither arm has more majorities", in which each unit has one vote.

    Units with equally many answers for both arms are left out. The result is 1 if all units are such.
    """
    margins = np.bincount(units, weights=np.where(chosen, 1, -1))
    wins, losses = int((margins > 0).sum()), int((margins < 0).sum())
    return float(binomtest(wins, wins + losses).pvalue) if wins + losses else 1.0


def least_units(comparisons: int) -> int:
    """Return how many raters, and how many prompts, a certain difference needs at least.

    The sign test of fewer units has a p-value of 0.05 or more even if all of them agree, because it is
    corrected for ``comparisons`` (at least 1) of arms and questions.
    """
    units = 1
    while comparisons * sign_test(np.ones(units, dtype=bool), np.arange(units)) >= 1 - CONFIDENCE:
        units += 1
    return units
