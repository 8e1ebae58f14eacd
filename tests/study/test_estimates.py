"""Intervals and tests: laws and exact values."""

import numpy as np
import pytest
from scipy.special import expit, logit
from scipy.stats import binomtest, t

from cadam3d.study.estimates import (
    Clusters,
    margin,
    rate_interval,
    sign_test,
)


def crossed(raters: int, prompts: int) -> Clusters:
    """Every rater answers once about every prompt."""
    return Clusters(np.repeat(np.arange(raters), prompts), np.tile(np.arange(prompts), raters))


def drawn(raters: int, prompts: int, seed: int = 0, rate: float = 0.6) -> tuple[np.ndarray, Clusters]:
    generator = np.random.default_rng(seed)
    return generator.random(raters * prompts) < rate, crossed(raters, prompts)


def ends(interval) -> tuple[float, float]:
    return interval.low, interval.high


@pytest.mark.parametrize(("effect", "seed"), [(2, 0), (1, 7)])
def test_the_interval_of_a_crossed_study_has_the_variances_of_raters_and_of_prompts(effect, seed):
    """Computed from the means of rows and columns, as in a two-way analysis of variance."""
    generator = np.random.default_rng(seed)
    tastes = generator.normal(size=(10, 1)) + generator.normal(size=(1, 8))
    table = (generator.random((10, 8)) < expit(effect * tastes)).astype(float)
    share = table.mean()
    of_raters = table.mean(1).var(ddof=1) / 10
    of_prompts = table.mean(0).var(ddof=1) / 8
    of_answers = table.var(ddof=1) / 80
    assert min(of_raters, of_prompts) > of_answers, "both effects must show"
    variance = of_raters + of_prompts - of_answers
    freedom = variance**2 / (of_raters**2 / 9 + of_prompts**2 / 7)
    assert (freedom < 7) == (seed == 7), "the second case needs the lower limit of the degrees of freedom"
    half = t.ppf(0.975, max(freedom, 7)) * np.sqrt(variance) / (share * (1 - share))
    expected = expit(logit(share) + np.array([-half, half]))
    assert ends(rate_interval(table.reshape(-1) > 0, crossed(10, 8))) == pytest.approx(tuple(expected))


def test_answers_of_copied_raters_add_no_certainty():
    """Raters who always answer alike, but differ from prompt to prompt, say no more than one of them."""
    of_prompt = np.array([True, True, True, False, True, False, True, True])
    one = rate_interval(of_prompt, crossed(1, 8))
    many = rate_interval(np.tile(of_prompt, 50), crossed(50, 8))
    assert many.high - many.low == pytest.approx(one.high - one.low, rel=0.02)


def test_the_interval_does_not_depend_on_which_factor_is_called_rater():
    chosen, clusters = drawn(9, 5)
    swapped = Clusters(clusters.prompts, clusters.raters)
    assert ends(rate_interval(chosen, clusters)) == pytest.approx(ends(rate_interval(chosen, swapped)))


def test_the_interval_of_the_other_arm_is_the_mirror_image():
    for rate in (0.6, 1.0):
        chosen, clusters = drawn(7, 6, rate=rate)
        one, other = rate_interval(chosen, clusters), rate_interval(~chosen, clusters)
        assert ends(other) == pytest.approx((1 - one.high, 1 - one.low))


def test_answers_that_all_agree_leave_a_bound_that_falls_with_the_first_other_answer():
    clusters = crossed(8, 6)
    all_agree = rate_interval(np.ones(48, dtype=bool), clusters)
    one_differs = rate_interval(np.arange(48) > 0, clusters)
    assert all_agree.high == 1
    assert 0.5 < one_differs.low <= all_agree.low < 1


def test_a_few_prompts_that_all_agree_have_the_exact_bound_of_as_many_answers():
    exact = binomtest(4, 4).proportion_ci(method="exact").low
    assert rate_interval(np.ones(4, dtype=bool), crossed(1, 4)).low == pytest.approx(exact)


def test_one_rater_and_one_prompt_say_nothing_about_others():
    for count in (1, 3):
        clusters = Clusters(np.zeros(count, dtype=int), np.zeros(count, dtype=int))
        assert ends(rate_interval(np.arange(count) > 0, clusters)) == (0, 1)
        assert margin(np.zeros(count), clusters) == np.inf


def test_an_interval_is_never_empty_even_if_clusters_agree_by_chance():
    chosen = np.array([True, False] * 4)
    clusters = Clusters(np.repeat(np.arange(4), 2), np.tile([0, 1], 4))
    for factor in (clusters, Clusters(clusters.raters, np.zeros(8, dtype=int))):
        interval = rate_interval(chosen, factor)
        assert interval.low < 0.3
        assert interval.high > 0.7


def test_several_seeds_of_an_arm_are_not_independent_answers():
    """Ten answers of each rater about each prompt that always agree are worth one."""
    chosen, clusters = drawn(6, 6)
    copies = Clusters(np.repeat(clusters.raters, 10), np.repeat(clusters.prompts, 10))
    one, ten = rate_interval(chosen, clusters), rate_interval(np.repeat(chosen, 10), copies)
    assert ends(ten) == pytest.approx(ends(one), abs=0.005)


def test_the_sign_test_counts_majorities_and_leaves_out_ties():
    """Six units have a majority for the first arm, each by one answer; a seventh one is a tie."""
    chosen, units = np.array([1, 1, 0] * 6 + [1, 0]) > 0, np.array([*np.repeat(range(6), 3), 6, 6])
    assert sign_test(chosen, units) == pytest.approx(2 / 2**6)
    assert sign_test(np.array([True, False]), np.array([0, 0])) == 1
