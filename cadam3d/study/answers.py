"""Answers: what raters have answered in a study, with the arms instead of the sides."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Answer:
    """One decision of one rater between two arms, about one question."""

    rater: str
    prompt: str
    question: str  # one of QUESTION_NAMES
    chosen: str  # the arm that won
    other: str  # the arm that lost; never the same as chosen


@dataclass(frozen=True)
class Rater:
    """All that one rater has answered.

    If an arm has several runs of one prompt (seeds), there are several answers to a question about one prompt.
    A rater who stopped early has fewer answers, and fewer catches, than the others.
    """

    name: str  # unique in a study
    answers: tuple[Answer, ...]  # without those of catch trials
    catches: tuple[bool, ...]  # for each answered catch trial, whether its answer was right
