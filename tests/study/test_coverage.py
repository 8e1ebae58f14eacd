"""Intervals of simulated studies contain the known preferences in at least 90 % of them, but not in all."""

from dataclasses import dataclass
from itertools import combinations

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.special import expit

from cadam3d.study.estimates import (
    Clusters,
    count_wins,
    fit_strengths,
    is_ranked,
    rate_interval,
    sign_test,
    strength_margins,
)

SIMULATIONS = 200


@dataclass(frozen=True, kw_only=True)
class Simulation:
    """A study whose raters choose arm i over arm j with the probability ``expit(u[i] - u[j])``.

    u is the strength of the arm plus normal effects of the rater and of the prompt on this arm.
    """

    raters: int
    prompts: int
    strengths: tuple[float, ...]  # of the arms, in log-odds
    rater_sd: float  # standard deviations of the effects on the difference of two arms
    prompt_sd: float
    answered: float = 1.0  # share of the prompts about which a rater answers

    @property
    def pairs(self) -> list[tuple[int, int]]:
        return list(combinations(range(len(self.strengths)), 2))

    def true_rate(self, first: int, second: int) -> float:
        """Return the rate at which the first arm is chosen by all raters for all prompts."""
        points, weights = np.polynomial.hermite_e.hermegauss(61)
        sd = np.hypot(self.rater_sd, self.prompt_sd)
        difference = self.strengths[first] - self.strengths[second]
        return float(expit(difference + sd * points) @ weights / weights.sum())

    def answers(self, generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray, Clusters]:
        """Return the chosen arms, the others and the clusters of one study."""
        arms = len(self.strengths)
        of_raters = self.rater_sd / np.sqrt(2) * generator.standard_normal((self.raters, 1, arms))
        of_prompts = self.prompt_sd / np.sqrt(2) * generator.standard_normal((1, self.prompts, arms))
        utility = np.asarray(self.strengths) + of_raters + of_prompts
        answered = generator.random((self.raters, self.prompts)) < self.answered
        raters, prompts = np.nonzero(answered)
        chosen, other = [], []
        for first, second in self.pairs:
            wins = generator.random(len(raters)) < expit(
                (utility[..., first] - utility[..., second])[answered]
            )
            chosen.append(np.where(wins, first, second))
            other.append(np.where(wins, second, first))
        copies = len(self.pairs)
        clusters = Clusters(np.tile(raters, copies), np.tile(prompts, copies))
        return np.concatenate(chosen), np.concatenate(other), clusters


def two_arms(rate: float, **settings: float) -> Simulation:
    """Return a study of two arms, of which the first is chosen at ``rate``."""

    def study(strength: float) -> Simulation:
        return Simulation(strengths=(strength, 0.0), **settings)

    return study(brentq(lambda strength: study(strength).true_rate(0, 1) - rate, -20, 20))


@pytest.mark.parametrize(
    ("rate", "settings"),
    [
        (0.5, {"raters": 8, "prompts": 6, "rater_sd": 0.5, "prompt_sd": 0.5}),
        (0.7, {"raters": 8, "prompts": 6, "rater_sd": 1.5, "prompt_sd": 0.0}),
        (0.7, {"raters": 30, "prompts": 12, "rater_sd": 0.0, "prompt_sd": 0.0}),
        (0.6, {"raters": 20, "prompts": 12, "rater_sd": 0.7, "prompt_sd": 0.7, "answered": 0.4}),
    ],
)
def test_the_interval_of_a_rate_covers_the_true_rate(rate, settings):
    study, generator = two_arms(rate, **settings), np.random.default_rng(0)
    found = []
    for _ in range(SIMULATIONS):
        arms, _, clusters = study.answers(generator)
        found.append(not rate_interval(arms == 0, clusters).excludes(rate))
    assert 0.9 <= np.mean(found) < 1


def test_the_intervals_of_three_strengths_cover_the_true_strengths():
    study = Simulation(strengths=(0.8, 0.0, -0.8), rater_sd=0.8, prompt_sd=0.8, raters=12, prompts=8)
    expected, generator, hits = np.zeros((3, 3)), np.random.default_rng(0), []
    for first, second in study.pairs:
        expected[first, second] = study.true_rate(first, second)
        expected[second, first] = 1 - expected[first, second]
    truth = fit_strengths(expected)
    while len(hits) < SIMULATIONS:
        chosen, other, clusters = study.answers(generator)
        wins = count_wins(chosen, other, len(truth))
        if is_ranked(wins):
            strengths = fit_strengths(wins)
            hits.append(np.abs(strengths - truth) <= strength_margins(chosen, other, clusters, strengths))
    assert all(0.9 <= share <= 0.99 for share in np.mean(hits, axis=0))


@pytest.mark.parametrize(
    "effects", [{"rater_sd": 1.5, "prompt_sd": 0.0}, {"rater_sd": 0.0, "prompt_sd": 1.5}]
)
def test_the_sign_tests_together_rarely_find_a_difference_between_equal_arms(effects):
    study, generator, alarms = two_arms(0.5, raters=30, prompts=12, **effects), np.random.default_rng(0), []
    for _ in range(SIMULATIONS):
        arms, _, clusters = study.answers(generator)
        tests = [sign_test(arms == 0, units) for units in (clusters.prompts, clusters.raters)]
        alarms.append([test.p_value < 0.05 for test in tests])
    either = np.array(alarms)
    assert either.all(axis=1).mean() <= 0.05
    assert either.mean(axis=0).max() > 0.09, "one of the two alone would not be enough"
