"""Summary: the analysis of a study in words and tables, for a terminal and as Markdown."""

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from cadam3d.study.analysis import EVEN, Analysis, Comparison, QuestionResult
from cadam3d.study.estimates import CONFIDENCE, Interval
from cadam3d.study.questions import QUESTIONS

# The table of the user study in the paper: rates in % of 30 raters, averaged over samples of GaussianDreamer,
# LucidDreamer and FlowDreamer. The paper prints no intervals.
PUBLISHED = {
    "Baseline": (50.5, 45.8, 51.9, 55.7, 50.4),
    "CAdam": (49.4, 54.1, 48.0, 44.3, 49.5),
}
LABELS = {question.name: question.label for question in QUESTIONS}
CHANCE_LIMIT = 0.1  # guesses should pass the catch trials of a rater less often
SPECIAL = re.compile(r"([\\|<*`\[])")  # in Markdown; names of arms and raters may contain them


@dataclass(frozen=True)
class Cell:
    """A number in a table, and its interval or remark, which may be empty."""

    value: str
    detail: str = ""


NONE = Cell("-")


@dataclass(frozen=True)
class Paragraph:
    """A paragraph of one line."""

    words: str

    def text(self) -> str:
        """Return the paragraph for a terminal."""
        return self.words

    def markdown(self) -> str:
        """Return the paragraph as Markdown."""
        return _escaped(self.words)


@dataclass(frozen=True)
class Bullets:
    """A list of sentences."""

    lines: Sequence[str]

    def text(self) -> str:
        """Return the list for a terminal."""
        return "\n".join(f"- {line}" for line in self.lines)

    def markdown(self) -> str:
        """Return the list as Markdown."""
        return "\n".join(f"- {_escaped(line)}" for line in self.lines)


@dataclass(frozen=True)
class Table:
    """A table with a column for each question of the paper, and a name before each row."""

    title: str  # of the names
    rows: Sequence[tuple[str, Sequence[Cell]]]

    def text(self) -> str:
        """Return the table for a terminal, with the interval of each number below it."""
        lines = [[self.title, *(question.short for question in QUESTIONS)]]
        for name, cells in self.rows:
            lines.append([name, *(cell.value for cell in cells)])
            if any(cell.detail for cell in cells):
                lines.append(["", *(cell.detail for cell in cells)])
        widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
        return "\n".join(
            "  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip()
            for line in lines
        )

    def markdown(self) -> str:
        """Return the table as Markdown."""
        titles = [self.title, *(question.short for question in QUESTIONS)]
        rows = [
            [name, *(f"{cell.value} {cell.detail}".rstrip() for cell in cells)] for name, cells in self.rows
        ]
        lines = [titles, ["---"] * len(titles), *([_escaped(cell) for cell in row] for row in rows)]
        return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _escaped(words: str) -> str:
    return SPECIAL.sub(r"\\\1", words)


def text(analysis: Analysis) -> str:
    """Return the result of a study for a terminal."""
    return "\n\n".join(block.text() for block in blocks(analysis))


def markdown(analysis: Analysis) -> str:
    """Return the result of a study as a page of Markdown."""
    return "\n\n".join(["# User study", *(block.markdown() for block in blocks(analysis))]) + "\n"


def blocks(analysis: Analysis) -> list[Paragraph | Bullets | Table]:
    """Return the parts of the summary: size, excluded raters, tables, verdicts and how to read them."""
    parts = [Paragraph(_size(analysis)), Bullets(screening_lines(analysis)), *_rates(analysis)]
    if len(analysis.arms) > 2:
        parts += [*_strengths(analysis), *_pairs(analysis)]
    verdicts = [verdict(result, analysis) for result in analysis.questions]
    return [*parts, Bullets(verdicts), Paragraph(caution(analysis)), *_agreement(analysis)]


def _size(analysis: Analysis) -> str:
    counts = {"rater": analysis.raters, "prompt": analysis.prompts, "arm": len(analysis.arms)}
    listed = ", ".join(_plural(count, noun) for noun, count in counts.items())
    return f"{listed} and {_plural(analysis.answers, 'answer')}."


def screening_lines(analysis: Analysis) -> list[str]:
    """Return which raters were excluded, by which rule, and what the catch trials cannot show."""
    screening = analysis.screening
    if not any(each.total for each in (*screening.kept, *screening.excluded)):
        return ["No rater was excluded, because none met a catch trial."]
    rule = f"fewer than {100 * screening.least:g} % right answers in catch trials"
    if screening.excluded:
        names = ", ".join(f"{each.name} ({each.right} of {each.total})" for each in screening.excluded)
        lines = [f"Excluded {_plural(len(screening.excluded), 'rater')} with {rule}: {names}."]
    else:
        lines = [f"No rater was excluded: none had {rule}."]
    untested = [each.name for each in screening.kept if not each.total]
    if untested:
        lines.append(f"Kept without an answer in a catch trial: {', '.join(untested)}.")
    weak = [each.by_chance for each in screening.kept if each.total and each.by_chance > CHANCE_LIMIT]
    if weak:
        count = _plural(len(weak), "rater")
        chance = f"{100 * max(weak):.0f} %"
        lines.append(
            f"{count} met so few catch trials that guesses pass with a probability of up to {chance}."
        )
    return lines


def _rates(analysis: Analysis) -> list[Paragraph | Table]:
    """Return the table of the paper: a row for each arm, and the published rows below."""

    def cell(result: QuestionResult, arm: str) -> Cell:
        found = [rate for rate in result.rates if rate.arm == arm]
        return _cell(found[0].share, found[0].interval) if found else NONE

    rows = [(arm, _cells(analysis, lambda result, arm=arm: cell(result, arm))) for arm in analysis.arms]
    rows += [
        (f"{arm} (published)", [Cell(f"{rate:.1f}") for rate in rates]) for arm, rates in PUBLISHED.items()
    ]
    title = f"How often each arm was chosen, in % of its comparisons, with 95 % intervals {_scope(analysis)}:"
    return [Paragraph(title), Table("arm", rows)]


def _scope(analysis: Analysis) -> str:
    """Return the words that say which raters and prompts the intervals are about."""
    counts = {"raters": analysis.raters, "prompts": analysis.prompts}
    several = [name for name, count in counts.items() if count > 1]
    if not several:
        return "(one rater and one prompt say nothing about others)"
    alone = [name.removesuffix("s") for name, count in counts.items() if count == 1]
    return f"over {' and '.join(several)}" + (f" (for this one {alone[0]})" if alone else "")


def _strengths(analysis: Analysis) -> list[Paragraph | Table | Bullets]:
    """Return the table of the Bradley-Terry model, and the questions for which it has no result."""

    def cell(result: QuestionResult, arm: str) -> Cell:
        found = [each for each in result.ranking.strengths if each.arm == arm] if result.ranking else []
        return _cell(found[0].preferred, found[0].interval) if found else NONE

    rows = [(arm, _cells(analysis, lambda result, arm=arm: cell(result, arm))) for arm in analysis.arms]
    problems = [
        f"{LABELS[result.question]}: no strengths, because {result.ranking.problem}."
        for result in analysis.questions
        if result.ranking is not None and result.ranking.problem is not None
    ]
    title = "Probability of being chosen over an arm of average strength, in % (Bradley-Terry model):"
    return [Paragraph(title), Table("arm", rows), *([Bullets(problems)] if problems else [])]


def _pairs(analysis: Analysis) -> list[Paragraph | Table]:
    """Return the table of all pairs of arms, in which a star marks a certain difference."""

    def cell(result: QuestionResult, name: tuple[str, str]) -> Cell:
        for pair in result.comparisons:
            if (pair.first, pair.second) == name:
                return _cell(pair.rate.share, pair.rate.interval, star="*" if pair.is_certain else "")
        return NONE

    names = sorted({(pair.first, pair.second) for each in analysis.questions for pair in each.comparisons})
    rows = [
        (" over ".join(name), _cells(analysis, lambda result, name=name: cell(result, name)))
        for name in names
    ]
    title = "How often the first arm of each pair was chosen, in %; a star marks a certain difference:"
    return [Paragraph(title), Table("pair", rows)]


def verdict(result: QuestionResult, analysis: Analysis) -> str:
    """Return what can be claimed about one question, in a sentence."""
    label = LABELS[result.question]
    match result.comparisons:
        case (pair,):
            return f"{label}: {_claim(pair, analysis)}."
        case pairs:
            certain = [pair for pair in pairs if pair.is_certain]
            claims = [f"{_winner(pair)} was preferred to {_loser(pair)}" for pair in certain]
            rest = "; no other difference is certain" if len(certain) < len(pairs) else ""
            found = f"{', '.join(claims)}{rest}" if claims else "no certain difference between any two arms"
            return f"{label}: {found}."


def _claim(pair: Comparison, analysis: Analysis) -> str:
    if pair.is_certain:
        return f"{_winner(pair)} was preferred, in {_evidence(pair, analysis)}"
    subject = "both arms were" if pair.rate.share == EVEN else f"{_winner(pair)} was"
    return f"no certain difference; {subject} chosen in {_evidence(pair, analysis)}"


def _winner(pair: Comparison) -> str:
    return pair.first if pair.rate.share >= EVEN else pair.second


def _loser(pair: Comparison) -> str:
    return pair.second if pair.rate.share >= EVEN else pair.first


def _evidence(pair: Comparison, analysis: Analysis) -> str:
    """Return the rate of the arm that was chosen more often, with its interval and p-value."""
    rate, low, high = pair.rate.share, pair.rate.interval.low, pair.rate.interval.high
    if rate < EVEN:
        rate, low, high = 1 - rate, 1 - high, 1 - low
    corrected = " after correction" if analysis.comparisons > 1 else ""
    return (
        f"{100 * rate:.1f} % of answers (95 % interval {100 * low:.1f} to {100 * high:.1f} %, "
        f"sign test p = {pair.corrected_p_value:.2g}{corrected})"
    )


def caution(analysis: Analysis) -> str:
    """Return how to read the verdicts, and whether the study is too small for any certain difference."""
    words = (
        "A difference is certain if the interval excludes 50 % and the sign tests over raters and over "
        "prompts agree. Without one, the arms may still differ: the interval shows which rates are possible."
    )
    needed = _least_units(analysis.comparisons)
    if min(analysis.raters, analysis.prompts) < needed:
        tests = _plural(analysis.comparisons, "comparison")
        words += f" In a study of {tests} this needs at least {needed} raters and {needed} prompts."
    return words


def _least_units(comparisons: int) -> int:
    """Return how many raters or prompts must agree for a corrected sign test to be significant."""
    return math.floor(math.log2(2 * comparisons / (1 - CONFIDENCE))) + 1


def _agreement(analysis: Analysis) -> list[Paragraph]:
    """Return how far the raters agree, for the questions for which that is defined."""
    shorts = {question.name: question.short for question in QUESTIONS}
    found = [(shorts[each.question], each.agreement) for each in analysis.questions]
    values = [f"{short} {alpha:.2f}" for short, alpha in found if alpha is not None]
    if not values:
        return []
    words = "Agreement of the raters (Krippendorff's alpha; 1 is full agreement, 0 is chance):"
    return [Paragraph(f"{words} {', '.join(values)}.")]


def _cells(analysis: Analysis, cell: Callable[[QuestionResult], Cell]) -> list[Cell]:
    """Return one cell for each question of the paper, in its order."""
    results = {result.question: result for result in analysis.questions}
    return [cell(results[each.name]) if each.name in results else NONE for each in QUESTIONS]


def _cell(share: float, interval: Interval, star: str = "") -> Cell:
    return Cell(f"{100 * share:.1f}{star}", f"({100 * interval.low:.1f} to {100 * interval.high:.1f})")


def _plural(count: int, noun: str) -> str:
    return f"{count:,} {noun}" if count == 1 else f"{count:,} {noun}s"
