"""Intervals of simulated studies contain the known preferences in at least 90 % of them, but not in all."""

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.special import expit

from cadam3d.study.estimates import Clusters, rate_interval, sign_test

SIMULATIONS = 200


@dataclass(frozen=True, kw_only=True)
class Simulation:
    """A study whose raters choose the first of two arms with the probability ``expit(u)``.

    u is a constant plus normal effects of the rater and of the prompt.
    """

    raters: int
    prompts: int
    difference: float  # of the two arms, in log-odds
    rater_sd: float
    prompt_sd: float
    answered: float = 1.0  # share of the prompts about which a rater answers

    def true_rate(self) -> float:
        """Return the rate at which the first arm is chosen by all raters for all prompts."""
        points, weights = np.polynomial.hermite_e.hermegauss(61)
        sd = np.hypot(self.rater_sd, self.prompt_sd)
        return float(expit(self.difference + sd * points) @ weights / weights.sum())

    def answers(self, generator: np.random.Generator) -> tuple[np.ndarray, Clusters]:
        """Return whether each answer chose the first arm, and the clusters of one study."""
        of_raters = self.rater_sd * generator.standard_normal((self.raters, 1))
        of_prompts = self.prompt_sd * generator.standard_normal((1, self.prompts))
        utility = self.difference + of_raters + of_prompts
        raters, prompts = np.nonzero(generator.random(utility.shape) < self.answered)
        return generator.random(len(raters)) < expit(utility[raters, prompts]), Clusters(raters, prompts)


def two_arms(rate: float, **settings: float) -> Simulation:
    """Return a study of two arms, of which the first is chosen at ``rate``."""

    def study(difference: float) -> Simulation:
        return Simulation(difference=difference, **settings)

    return study(brentq(lambda difference: study(difference).true_rate() - rate, -20, 20))


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
    intervals = [rate_interval(*study.answers(generator)) for _ in range(SIMULATIONS)]
    found = [each.low <= rate <= each.high for each in intervals]
    assert 0.9 <= np.mean(found) < 1


@pytest.mark.parametrize(
    "effects", [{"rater_sd": 1.5, "prompt_sd": 0.0}, {"rater_sd": 0.0, "prompt_sd": 1.5}]
)
def test_the_sign_tests_together_rarely_find_a_difference_between_equal_arms(effects):
    study, generator, alarms = two_arms(0.5, raters=30, prompts=12, **effects), np.random.default_rng(0), []
    for _ in range(SIMULATIONS):
        chosen, clusters = study.answers(generator)
        tests = [sign_test(chosen, units) for units in (clusters.prompts, clusters.raters)]
        alarms.append([p_value < 0.05 for p_value in tests])
    either = np.array(alarms)
    assert either.all(axis=1).mean() <= 0.05
    assert either.mean(axis=0).max() > 0.09, "one of the two alone would not be enough"
