"""Analysis: turn the answers of a study into numbers about its arms, with their uncertainty.

All functions are pure, and no result depends on the order of raters or of answers. ``study/estimates.py`` has
the intervals and tests, and ``study/summary.py`` writes the analysis as text.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np

from cadam3d.core.errors import UserError
from cadam3d.report.estimate import holm
from cadam3d.study.answers import Answer, Rater
from cadam3d.study.estimates import (
    CONFIDENCE,
    Clusters,
    Interval,
    rate_interval,
    sign_test,
)
from cadam3d.study.questions import QUESTION_NAMES

EVEN = 0.5  # the rate of two arms that are liked equally


@dataclass(frozen=True)
class Screened:
    """The result of one rater in the catch trials."""

    name: str
    right: int  # answers in catch trials
    total: int


@dataclass(frozen=True)
class Screening:
    """The raters whose answers count, and those who failed the catch trials."""

    least: float  # share of the answers in catch trials that must be right, in [0, 1]
    kept: tuple[Screened, ...]
    excluded: tuple[Screened, ...]


@dataclass(frozen=True)
class Rate:
    """The share of its comparisons in which an arm was chosen."""

    arm: str
    chosen: int
    answers: int
    share: float  # chosen / answers
    interval: Interval  # of the share, over raters and prompts


@dataclass(frozen=True)
class ComparedPair:
    """Two arms and the answers to one question about them."""

    first: str
    second: str
    rate: Rate  # of the first arm, against the second
    # A test over prompts says whether other prompts would give the same result with these raters, and a test
    # over raters whether other raters would with these prompts. A claim about both needs both tests.
    p_over_prompts: float
    p_over_raters: float
    p_value: float  # the larger one of the two
    corrected_p_value: float  # by Holm's method, for the number of comparisons in the study

    @property
    def is_certain(self) -> bool:
        """Return whether the interval excludes one half and the corrected sign test agrees."""
        is_even = self.rate.interval.low <= EVEN <= self.rate.interval.high
        return not is_even and self.corrected_p_value < 1 - CONFIDENCE


@dataclass(frozen=True)
class QuestionResult:
    """The result of one question."""

    question: str  # one of QUESTION_NAMES
    rates: tuple[Rate, ...]  # one for each arm that was compared, by name
    comparisons: tuple[ComparedPair, ...]  # one for each pair of arms that was compared


@dataclass(frozen=True)
class Analysis:
    """The result of a study: its size, the raters who were excluded, and the result of each question."""

    arms: tuple[str, ...]
    raters: int  # that were kept and have answered
    prompts: int
    answers: int
    comparisons: int  # sign tests, for whose number the p-values are corrected
    screening: Screening
    questions: tuple[QuestionResult, ...]  # in the order of the paper; without unanswered ones

    def to_json(self) -> dict[str, Any]:
        """Return the analysis as nested dictionaries of plain values, for a JSON file."""
        return asdict(self)


def analyse(raters: Sequence[Rater], *, least_caught: float) -> Analysis:
    """Return the analysis of the answers of all raters who pass the catch trials.

    A rater is excluded if the share of right answers in catch trials is below ``least_caught``, in [0, 1]. A
    rater who has seen no catch trial is kept. Raises ``UserError`` if no answer is left.
    """
    screening = screen(raters, least_caught)
    kept = {rater.name for rater in screening.kept}
    answers = [answer for rater in raters if rater.name in kept for answer in rater.answers]
    if not answers:
        raise UserError(
            "answers: expected answers of a rater who passes the catch trials, got none. Try: least_caught=0"
        )
    by_question = [[each for each in answers if each.question == name] for name in QUESTION_NAMES]
    results = [question_result(each) for each in by_question if each]
    p_values = iter(holm([each.p_value for result in results for each in result.comparisons]))
    results = [
        replace(
            result,
            comparisons=tuple(replace(each, corrected_p_value=next(p_values)) for each in result.comparisons),
        )
        for result in results
    ]
    return Analysis(
        arms=_arms(answers),
        raters=len({answer.rater for answer in answers}),
        prompts=len({answer.prompt for answer in answers}),
        answers=len(answers),
        comparisons=sum(len(result.comparisons) for result in results),
        screening=screening,
        questions=tuple(results),
    )


def screen(raters: Sequence[Rater], least: float) -> Screening:
    """Divide the raters into those who pass the catch trials and those who do not.

    ``least`` is the share of the answers in catch trials that must be right, in [0, 1].
    """
    kept, excluded = [], []
    for rater in sorted(raters, key=lambda rater: rater.name):
        right, total = sum(rater.catches), len(rater.catches)
        needed = math.ceil(total * least - 1e-9)
        passed = kept if right >= needed else excluded
        passed.append(Screened(rater.name, right, total))
    return Screening(least, tuple(kept), tuple(excluded))


def question_result(answers: Sequence[Answer]) -> QuestionResult:
    """Return the result of one question from its answers, of which there must be at least one.

    The p-values of the comparisons are not corrected.
    """
    answers = sorted(answers, key=lambda each: (each.rater, each.prompt, each.chosen, each.other))
    arms = _arms(answers)
    pairs = [pair for pair in combinations(arms, 2) if _between(answers, *pair)]
    return QuestionResult(
        question=answers[0].question,
        rates=tuple(
            _rate(arm, [each for each in answers if arm in (each.chosen, each.other)]) for arm in arms
        ),
        comparisons=tuple(_comparison(*pair, _between(answers, *pair)) for pair in pairs),
    )


def _arms(answers: Sequence[Answer]) -> tuple[str, ...]:
    return tuple(sorted({arm for answer in answers for arm in (answer.chosen, answer.other)}))


def _between(answers: Sequence[Answer], first: str, second: str) -> list[Answer]:
    return [answer for answer in answers if {answer.chosen, answer.other} == {first, second}]


def _is_chosen(arm: str, answers: Sequence[Answer]) -> np.ndarray:
    return np.array([answer.chosen == arm for answer in answers])


def _clusters(answers: Sequence[Answer]) -> Clusters:
    return Clusters.of([answer.rater for answer in answers], [answer.prompt for answer in answers])


def _rate(arm: str, answers: Sequence[Answer]) -> Rate:
    """Return the rate of an arm from the answers in which it took part."""
    chosen = _is_chosen(arm, answers)
    interval = rate_interval(chosen, _clusters(answers))
    return Rate(arm, int(chosen.sum()), len(chosen), float(chosen.mean()), interval)


def _comparison(first: str, second: str, answers: Sequence[Answer]) -> ComparedPair:
    chosen, clusters = _is_chosen(first, answers), _clusters(answers)
    over_prompts, over_raters = sign_test(chosen, clusters.prompts), sign_test(chosen, clusters.raters)
    p_value = max(over_prompts, over_raters)
    return ComparedPair(
        first,
        second,
        rate=_rate(first, answers),
        p_over_prompts=over_prompts,
        p_over_raters=over_raters,
        p_value=p_value,
        corrected_p_value=p_value,
    )
