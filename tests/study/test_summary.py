"""The summary of a study: the table of the paper, and stars that claim no more than is certain."""

import pytest
from raters import simulated_raters

from cadam3d.study.analysis import analyse
from cadam3d.study.answers import Answer, Rater
from cadam3d.study.summary import markdown

PUBLISHED = ["50.5", "45.8", "51.9", "55.7", "50.4"], ["49.4", "54.1", "48.0", "44.3", "49.5"]


def shown(raters, least_caught: float = 0.8) -> str:
    return markdown(analyse(raters, least_caught=least_caught))


def tables(page: str) -> list[list[list[str]]]:
    """The cells of all tables of a page, row by row."""
    blocks = [block.splitlines() for block in page.split("\n\n") if block.startswith("|")]
    return [[[cell.strip() for cell in line.strip("|").split(" | ")] for line in block] for block in blocks]


def test_the_table_of_the_paper_has_our_arms_above_the_published_ones():
    table = tables(shown(simulated_raters({"baseline": 0.0, "cadam": 0.3}, 8, 6)))[0]
    found = {name: cells for name, *cells in table if not name.startswith("-")}
    assert list(found) == ["arm", "baseline", "cadam", "Baseline (published)", "CAdam (published)"]
    assert found["arm"] == ["TA", "TD", "GP", "CL", "OP"]
    assert (found["Baseline (published)"], found["CAdam (published)"]) == PUBLISHED
    for ours, theirs in zip(found["baseline"], found["cadam"], strict=True):
        assert float(ours.split()[0]) + float(theirs.split()[0]) == pytest.approx(100, abs=0.11)


def test_a_question_without_answers_has_empty_cells():
    page = shown(simulated_raters({"a": 0, "b": 0}, 4, 3, questions=["cleanliness"]))
    rates, pairs = tables(page)
    assert [cell == "-" for cell in rates[2][1:]] == [True, True, True, False, True]
    assert [row[0] for row in pairs[2:]] == ["cleanliness"]


def test_only_certain_differences_have_a_star():
    clear = tables(shown(simulated_raters({"baseline": 0.0, "cadam": 3.0}, 30, 12)))[1][2:]
    equal = tables(shown(simulated_raters({"baseline": 0.0, "cadam": 0.0}, 30, 12)))[1][2:]
    assert [row[2].endswith("*") for row in clear] == [True] * 5
    assert [row[2].endswith("*") for row in equal] == [False] * 5
    assert all(float(row[4]) < 0.05 for row in clear)


def test_raters_who_were_excluded_or_not_tested_are_named():
    raters = simulated_raters({"a": 0, "b": 0}, 3, 2, catches=[True] * 10)
    for name, catches in (("guesser", (True, False)), ("early", ())):
        raters.append(Rater(name, (Answer(name, "prompt 0", "overall", "a", "b"),), catches))
    page = shown(raters)
    assert "fewer than 80 % right answers in catch trials: guesser (1 of 2)." in page
    assert "Kept without an answer in a catch trial: early." in page


def test_more_than_two_arms_are_compared_pair_by_pair():
    _, pairs = tables(shown(simulated_raters({"a": 2.0, "b": 0.0, "c": 0.0}, 20, 12)))
    assert [row[1] for row in pairs[2:5]] == ["a over b", "a over c", "b over c"]
    assert [row[2].endswith("*") for row in pairs[2:5]] == [True, True, False]


def test_names_do_not_break_the_table():
    page = shown(simulated_raters({"a|b": 0.0, "<i>*c*": 1.0}, 4, 3))
    assert "| a\\|b " in page
    assert "| \\<i>\\*c\\* " in page
