"""The summary of a study: the table of the paper, and sentences that claim no more than is certain."""

import pytest
from raters import simulated_raters

from cadam3d.study.analysis import analyse
from cadam3d.study.answers import Answer, Rater
from cadam3d.study.summary import markdown, text

PUBLISHED = ["50.5", "45.8", "51.9", "55.7", "50.4"], ["49.4", "54.1", "48.0", "44.3", "49.5"]


def shown(raters, least_caught: float = 0.8) -> str:
    return text(analyse(raters, least_caught=least_caught))


def rows(page: str) -> dict[str, list[str]]:
    """The cells of the first table of a page by the name of their row."""
    table = [line.strip("| ").split(" | ") for line in page.splitlines() if line.startswith("|")]
    return {name: cells for name, *cells in table}


def test_the_table_of_the_paper_has_our_arms_above_the_published_ones():
    page = markdown(analyse(simulated_raters({"baseline": 0.0, "cadam": 0.3}, 8, 6), least_caught=0.8))
    found = rows(page)
    assert list(found) == ["arm", "---", "baseline", "cadam", "Baseline (published)", "CAdam (published)"]
    assert found["arm"] == ["TA", "TD", "GP", "CL", "OP"]
    assert (found["Baseline (published)"], found["CAdam (published)"]) == PUBLISHED
    for ours, theirs in zip(found["baseline"], found["cadam"], strict=True):
        assert float(ours.split()[0]) + float(theirs.split()[0]) == pytest.approx(100, abs=0.11)


def test_a_question_without_answers_has_empty_cells_and_no_verdict():
    raters = simulated_raters({"a": 0, "b": 0}, 4, 3, questions=["cleanliness"])
    page = markdown(analyse(raters, least_caught=0.8))
    assert [cell == "-" for cell in rows(page)["a"]] == [True, True, True, False, True]
    assert "Cleanliness: " in page
    assert "Texture detail: " not in page


def test_only_certain_differences_are_called_preferences():
    clear = shown(simulated_raters({"baseline": 0.0, "cadam": 3.0}, 30, 12))
    assert clear.count("cadam was preferred, in ") == 5
    equal = shown(simulated_raters({"baseline": 0.0, "cadam": 0.0}, 30, 12))
    assert "preferred" not in equal
    assert equal.count("no certain difference; ") == 5
    assert "the arms may still differ" in equal


def test_the_verdict_has_the_rate_of_the_arm_that_was_chosen_more_often():
    answers = [Answer("r", f"p{i}", "overall", *(("b", "a") if i < 3 else ("a", "b"))) for i in range(4)]
    assert "no certain difference; b was chosen in 75.0 % of answers" in shown(
        [Rater("r", tuple(answers), ())]
    )
    even = [*answers[:3], *(Answer("r", f"q{i}", "overall", "a", "b") for i in range(3))]
    assert "both arms were chosen in 50.0 % of answers" in shown([Rater("r", tuple(even), ())])


def test_a_study_that_is_too_small_for_any_certain_difference_says_what_it_needs():
    # 2 / 2**8 is below 0.05 / 5, and 2 / 2**7 is not.
    needs = "In a study of 5 comparisons this needs at least 8 raters and 8 prompts."
    assert needs in shown(simulated_raters({"a": 0, "b": 0}, 7, 9))
    assert needs in shown(simulated_raters({"a": 0, "b": 0}, 9, 7))
    assert "this needs" not in shown(simulated_raters({"a": 0, "b": 0}, 8, 8))


def test_raters_who_were_excluded_or_not_tested_are_named():
    raters = simulated_raters({"a": 0, "b": 0}, 3, 2, catches=[True] * 10)
    for name, catches in (("guesser", (True, False)), ("early", ())):
        raters.append(Rater(name, (Answer(name, "prompt 0", "overall", "a", "b"),), catches))
    page = shown(raters)
    assert "Excluded 1 rater with fewer than 80 % right answers in catch trials: guesser (1 of 2)." in page
    assert "Kept without an answer in a catch trial: early." in page
    assert "are few" not in page
    few = shown(simulated_raters({"a": 0, "b": 0}, 3, 2, catches=[True] * 5))
    assert "3 raters met so few catch trials that guesses pass with a probability of up to 19 %." in few
    assert "No rater was excluded" in few


def test_a_study_without_catch_trials_says_so():
    page = shown(simulated_raters({"a": 0, "b": 0}, 3, 2, catches=[]))
    assert "- No rater was excluded, because none met a catch trial.\n" in page
    assert "Kept" not in page


def test_intervals_say_what_they_are_about():
    for size, scope in {
        (3, 4): "with 95 % intervals over raters and prompts:",
        (1, 4): "with 95 % intervals over prompts (for this one rater):",
        (3, 1): "with 95 % intervals over raters (for this one prompt):",
        (1, 1): "with 95 % intervals (one rater and one prompt say nothing about others):",
    }.items():
        assert scope in shown(simulated_raters({"a": 0, "b": 0}, *size))


def test_more_than_two_arms_have_strengths_and_pairs():
    page = shown(simulated_raters({"a": 2.0, "b": 0.0, "c": 0.0}, 20, 12))
    assert "Bradley-Terry" in page
    assert "b over c" in page
    assert page.count("a was preferred to b, a was preferred to c; no other difference is certain.") == 5
    separated = shown(simulated_raters({"a": 99.0, "b": 0.0, "c": 0.0}, 4, 4))
    assert separated.count("no strengths, because a won every comparison with b, c") == 5


def test_names_do_not_break_the_table_and_are_unchanged_in_a_terminal():
    raters = simulated_raters({"a|b": 0.0, "<i>*c*": 1.0}, 4, 3)
    page = markdown(analyse(raters, least_caught=0.8))
    assert "| a\\|b |" in page
    assert "| \\<i>\\*c\\* |" in page
    assert "\na|b " in shown(raters)


def test_a_terminal_of_ordinary_width_shows_the_table_of_two_arms():
    lines = shown(simulated_raters({"baseline": 0.0, "cadam": 3.0}, 8, 8)).splitlines()
    table = lines[lines.index(next(line for line in lines if line.startswith("arm"))) :][:7]
    assert max(map(len, table)) <= 105
