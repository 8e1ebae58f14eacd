"""The analysis of a study finds known preferences, and does not depend on orders and names."""

import json
from dataclasses import replace
from itertools import combinations

import pytest
from raters import simulated_raters

from cadam3d.study.analysis import Analysis, analyse, screen
from cadam3d.study.answers import Answer, Rater
from cadam3d.study.estimates import least_units
from cadam3d.study.questions import QUESTION_NAMES

THREE = {"a": 1.0, "b": 0.0, "c": -1.0}


def rater(name: str, *won: tuple[str, str], catches=()) -> Rater:
    """A rater who decides ``(chosen, other)`` about one prompt after another."""
    answers = [Answer(name, f"prompt {i}", "overall", *pair) for i, pair in enumerate(won)]
    return Rater(name, tuple(answers), tuple(catches))


def renamed(raters: list[Rater], names: dict[str, str]) -> list[Rater]:
    return [
        replace(
            each,
            answers=tuple(replace(a, chosen=names[a.chosen], other=names[a.other]) for a in each.answers),
        )
        for each in raters
    ]


def numbers(analysis: Analysis) -> dict[tuple[str, str], tuple[float, ...]]:
    """The rate and its interval by question and arm."""
    return {
        (result.question, rate.arm): (rate.share, rate.interval.low, rate.interval.high)
        for result in analysis.questions
        for rate in result.rates
    }


def test_a_clear_preference_is_certain_and_a_tie_is_not():
    clear = simulated_raters({"baseline": 0.0, "cadam": 2.0}, 30, 12)
    equal = simulated_raters({"baseline": 0.0, "cadam": 0.0}, 30, 12)
    for raters, is_certain in ((clear, True), (equal, False)):
        for result in analyse(raters, least_caught=0.8).questions:
            [pair] = result.comparisons
            assert pair.is_certain is is_certain
            assert (pair.first, pair.second) == ("baseline", "cadam")
            if is_certain:
                assert pair.rate.interval.high < 0.5


@pytest.mark.parametrize(("arms", "least"), [("ab", 8), ("abc", 10)])
def test_fewer_raters_or_prompts_than_the_least_are_never_certain(arms, least):
    """All raters prefer the earlier arm, at every question."""
    pairs = list(combinations(arms, 2))
    assert least_units(len(QUESTION_NAMES) * len(pairs)) == least

    def is_certain(raters: int, prompts: int) -> bool:
        answers = [(str(i), name, *pair) for i in range(prompts) for name in QUESTION_NAMES for pair in pairs]
        study = [Rater(f"{i}", tuple(Answer(f"{i}", *each) for each in answers), ()) for i in range(raters)]
        found = analyse(study, least_caught=0.8).questions
        return any(pair.is_certain for result in found for pair in result.comparisons)

    assert is_certain(least, least)
    assert not is_certain(least - 1, 30)
    assert not is_certain(30, least - 1)


def test_swapping_two_arms_mirrors_the_rates():
    raters = simulated_raters({"a": 0.4, "b": 0.0}, 8, 6)
    swapped = numbers(analyse(renamed(raters, {"a": "b", "b": "a"}), least_caught=0.8))
    for (question, arm), (share, low, high) in numbers(analyse(raters, least_caught=0.8)).items():
        other = {"a": "b", "b": "a"}[arm]
        assert swapped[question, other] == pytest.approx((share, low, high))
        assert swapped[question, arm] == pytest.approx((1 - share, 1 - high, 1 - low))


def test_the_order_of_raters_and_answers_changes_nothing():
    raters = simulated_raters(THREE, 6, 5)
    backwards = [replace(each, answers=each.answers[::-1]) for each in reversed(raters)]
    assert analyse(backwards, least_caught=0.8) == analyse(raters, least_caught=0.8)


def test_names_of_raters_and_prompts_change_nothing():
    raters = simulated_raters({"a": 0.4, "b": 0.0}, 8, 6)
    others = [
        Rater(
            each.name[::-1],
            tuple(replace(a, rater=each.name[::-1], prompt=a.prompt[::-1]) for a in each.answers),
            each.catches,
        )
        for each in raters
    ]
    one, other = (numbers(analyse(each, least_caught=0.8)) for each in (raters, others))
    assert all(other[key] == pytest.approx(value) for key, value in one.items())


def test_raters_who_fail_the_catch_trials_are_named_and_change_nothing():
    good = simulated_raters({"a": 0.5, "b": 0.0}, 8, 6)
    bad = replace(rater("guesser", *[("b", "a")] * 6), catches=(True, False, True, True, False))
    found, without = analyse([*good, bad], least_caught=0.8), analyse(good, least_caught=0.8)
    assert found.questions == without.questions
    assert (found.raters, found.answers) == (without.raters, without.answers)
    [excluded] = found.screening.excluded
    assert (excluded.name, excluded.right, excluded.total) == ("guesser", 3, 5)
    assert analyse([*good, bad], least_caught=0.6).raters == 9


@pytest.mark.parametrize("least", [0.0, 0.1, 0.28, 0.55, 0.7, 0.8, 0.9, 1.0])
def test_a_rater_is_kept_from_exactly_the_stated_share_on(least):
    """28 % of 25 are 7, although 0.28 * 25 is more than 7 in floating point."""
    for total in (1, 3, 7, 10, 25):
        for right in range(total + 1):
            one = rater("r", catches=[i < right for i in range(total)])
            is_kept = bool(screen([one], least).kept)
            assert is_kept == (100 * right >= round(100 * least) * total)


def test_a_difference_needs_the_agreement_of_raters_and_of_prompts():
    """With few prompts even a unanimous vote of many raters is not certain."""
    raters = [rater(f"r{i}", *[("a", "b")] * 4) for i in range(40)]
    [result] = analyse(raters, least_caught=0.8).questions
    [pair] = result.comparisons
    assert pair.p_over_raters < 1e-9
    assert pair.p_over_prompts == pytest.approx(2 / 2**4)
    assert pair.p_value == pair.p_over_prompts
    assert not pair.is_certain


def test_p_values_are_corrected_for_all_comparisons_of_the_study():
    raters = simulated_raters({"a": 0.6, "b": 0.0}, 12, 10)
    found = analyse(raters, least_caught=0.8)
    p_values = sorted(
        (pair.p_value, pair.corrected_p_value) for r in found.questions for pair in r.comparisons
    )
    assert found.comparisons == len(p_values) == 5
    assert p_values[0][1] == pytest.approx(min(1, 5 * p_values[0][0]))
    alone = analyse(simulated_raters({"a": 0.6, "b": 0.0}, 12, 10, questions=["overall"]), least_caught=0.8)
    [pair] = alone.questions[0].comparisons
    assert pair.corrected_p_value == pair.p_value


def test_the_rates_of_a_pair_ignore_answers_about_other_arms():
    three = simulated_raters(THREE, 6, 5, questions=["overall"])
    two = [
        replace(each, answers=tuple(a for a in each.answers if {a.chosen, a.other} == {"a", "b"}))
        for each in three
    ]
    [of_three], [of_two] = (analyse(each, least_caught=0.8).questions for each in (three, two))
    assert of_three.comparisons[0].rate == of_two.comparisons[0].rate


def test_arms_that_were_never_compared_have_no_comparison():
    raters = [rater("one", ("a", "b"), ("b", "c")), rater("two", ("b", "a"), ("c", "b"))]
    [result] = analyse(raters, least_caught=0.8).questions
    assert [(each.first, each.second) for each in result.comparisons] == [("a", "b"), ("b", "c")]


@pytest.mark.parametrize("size", [(1, 1), (1, 4), (4, 1), (5, 4)])
@pytest.mark.parametrize("strengths", [{"a": 0.0, "b": 0.0}, {"a": 9.0, "b": -9.0}, THREE])
def test_studies_of_all_sizes_become_plain_json(size, strengths):
    found = analyse(simulated_raters(strengths, *size), least_caught=0.8)
    assert json.loads(json.dumps(found.to_json(), allow_nan=False))["raters"] == size[0]
    for share, low, high in numbers(found).values():
        assert 0 <= low <= share <= high <= 1
        assert high - low > 0.1
