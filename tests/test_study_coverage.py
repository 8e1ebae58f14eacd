"""The script that simulates studies: intervals contain known preferences in 90 to 99 % of 500 simulations."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "scripts"))

import study_coverage
from study_coverage import Study, false_alarms, independent_interval, rate_coverage, strength_coverage

from cadam3d.study.estimates import rate_interval

SIMULATIONS = 500


@pytest.mark.parametrize(
    ("raters", "prompts", "rater_sd", "prompt_sd", "rate"),
    [
        (8, 6, 0.5, 0.5, 0.5),
        (8, 6, 1.5, 0.0, 0.7),
        (30, 12, 0.0, 0.0, 0.7),
        (30, 12, 1.5, 0.0, 0.5),
    ],
)
def test_the_interval_of_a_rate_covers_the_true_rate(raters, prompts, rater_sd, prompt_sd, rate):
    study = study_coverage.two_arms(rate, rater_sd, prompt_sd, raters=raters, prompts=prompts)
    coverage, _ = rate_coverage(study, SIMULATIONS, rate_interval)
    assert 90 <= coverage <= 99


def test_the_interval_also_covers_if_raters_answer_about_some_prompts_only():
    study = study_coverage.two_arms(0.6, 0.7, 0.7, raters=20, prompts=12, answered=0.4)
    assert 90 <= rate_coverage(study, SIMULATIONS, rate_interval)[0] <= 99


def test_an_interval_that_ignores_raters_and_prompts_would_not_cover():
    study = study_coverage.two_arms(0.6, 1.0, 1.0, raters=30, prompts=12)
    assert rate_coverage(study, SIMULATIONS, independent_interval)[0] < 75


def test_the_intervals_of_three_strengths_cover_the_true_strengths():
    study = Study(strengths=(0.8, 0.0, -0.8), rater_sd=0.8, prompt_sd=0.8, raters=12, prompts=8)
    assert all(90 <= coverage <= 99 for coverage in strength_coverage(study, SIMULATIONS))


@pytest.mark.parametrize("effects", [(1.5, 0.0), (0.0, 1.5)])
def test_the_sign_tests_together_rarely_find_a_difference_between_equal_arms(effects):
    study = study_coverage.two_arms(0.5, *effects, raters=30, prompts=12)
    over_prompts, over_raters, both = false_alarms(study, SIMULATIONS)
    assert both <= 5
    assert max(over_prompts, over_raters) > 9, "one of the two alone would not be enough"


def test_the_true_rate_is_the_one_of_very_many_answers():
    study = Study(strengths=(0.7, 0.0), rater_sd=1.0, prompt_sd=0.5, raters=2000, prompts=500)
    arms, _, _ = study.answers(np.random.default_rng(0))
    assert (arms == 0).mean() == pytest.approx(study.true_rate(0, 1), abs=0.01)
