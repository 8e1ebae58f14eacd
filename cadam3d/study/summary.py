"""Summary: the analysis of a study as text that can be read in a terminal and pasted into Markdown."""

import math
from collections.abc import Callable, Sequence

from cadam3d.study.analysis import Analysis, Comparison, QuestionResult
from cadam3d.study.estimates import CONFIDENCE, Interval
from cadam3d.study.questions import QUESTIONS

# The user study of the paper (its table of the user study): rates in % of 30 raters, who compared samples of
# GaussianDreamer, LucidDreamer and FlowDreamer. The paper prints no intervals.
PUBLISHED = {
    "Baseline": (50.5, 45.8, 51.9, 55.7, 50.4),
    "CAdam": (49.4, 54.1, 48.0, 44.3, 49.5),
}
NONE = "-"  # in a table, where there is nothing to show
LABELS = {question.name: question.label for question in QUESTIONS}
# A rater who guesses should pass the catch trials less often than this.
CHANCE_LIMIT = 0.1


def summary(analysis: Analysis) -> str:
    """Return the tables and verdicts of a study in Markdown."""
    parts = [_size(analysis), _rates(analysis)]
    if len(analysis.arms) > 2:
        parts += [_strengths(analysis), _pairs(analysis)]
    parts += [_bullets([verdict(result, analysis) for result in analysis.questions]), caution(analysis)]
    parts += [_bullets(screening_lines(analysis))]
    return "\n\n".join(parts) + "\n"


def _size(analysis: Analysis) -> str:
    counts = [
        _plural(analysis.raters, "rater"),
        _plural(analysis.prompts, "prompt"),
        f"{_plural(len(analysis.arms), 'arm')} and {_plural(analysis.answers, 'answer')}",
    ]
    return f"{', '.join(counts)}."


def _rates(analysis: Analysis) -> str:
    """Return the table of the paper: a row for each arm, and the published rows below."""
    rows = [[arm, *_cells(analysis, lambda result, arm=arm: _rate_of(result, arm))] for arm in analysis.arms]
    rows += [[f"{arm} (published)", *(f"{rate:.1f}" for rate in rates)] for arm, rates in PUBLISHED.items()]
    note = f"Rates in % of the comparisons of an arm, with 95 % intervals over {_scope(analysis)}:"
    return f"{note}\n\n{_table('arm', rows)}"


def _rate_of(result: QuestionResult, arm: str) -> str:
    found = [rate for rate in result.rates if rate.arm == arm]
    return _with_interval(found[0].share, found[0].interval) if found else NONE


def _scope(analysis: Analysis) -> str:
    """Return the things that an interval generalises to: those of which the study has at least two."""
    names = [name for name in ("raters", "prompts") if getattr(analysis, name) > 1]
    return " and ".join(names) or "nothing, as there is one rater and one prompt"


def _strengths(analysis: Analysis) -> str:
    """Return the table of the Bradley-Terry model, and for which questions it cannot be estimated."""

    def cell(result: QuestionResult, arm: str) -> str:
        found = [each for each in result.ranking.strengths if each.arm == arm] if result.ranking else []
        return _with_interval(found[0].preferred, found[0].interval) if found else NONE

    rows = [[arm, *_cells(analysis, lambda result, arm=arm: cell(result, arm))] for arm in analysis.arms]
    note = "Probability in % of being chosen over an arm of average strength (Bradley-Terry):"
    problems = [
        f"{LABELS[result.question]}: no strengths, because {result.ranking.problem}."
        for result in analysis.questions
        if result.ranking is not None and result.ranking.problem is not None
    ]
    return "\n\n".join([note, _table("arm", rows), *([_bullets(problems)] if problems else [])])


def _pairs(analysis: Analysis) -> str:
    """Return the table of all pairs of arms, in which a star marks a certain difference."""
    names = sorted({(pair.first, pair.second) for each in analysis.questions for pair in each.comparisons})

    def cell(result: QuestionResult, name: tuple[str, str]) -> str:
        found = [pair for pair in result.comparisons if (pair.first, pair.second) == name]
        if not found:
            return NONE
        star = " *" if found[0].is_certain else ""
        return _with_interval(found[0].rate.share, found[0].rate.interval) + star

    rows = [
        [f"{' over '.join(name)}", *_cells(analysis, lambda result, name=name: cell(result, name))]
        for name in names
    ]
    note = "Rates in % of the first arm of each pair; a star marks a certain difference:"
    return f"{note}\n\n{_table('pair', rows)}"


def verdict(result: QuestionResult, analysis: Analysis) -> str:
    """Return what can be claimed about one question, in a sentence."""
    label = LABELS[result.question]
    if len(result.comparisons) == 1:
        [pair] = result.comparisons
        if pair.is_certain:
            return f"{label}: {_winner(pair)} was preferred, in {_evidence(pair, analysis)}."
        if pair.rate.share == 1 / 2:
            return f"{label}: no certain difference; both arms were chosen in {_evidence(pair, analysis)}."
        return f"{label}: no certain difference; {_winner(pair)} was chosen in {_evidence(pair, analysis)}."
    certain = [pair for pair in result.comparisons if pair.is_certain]
    if not certain:
        return f"{label}: no certain difference between any two arms."
    claims = [f"{_winner(each)} was preferred to {_loser(each)}" for each in certain]
    others = "; no other difference is certain" if len(certain) < len(result.comparisons) else ""
    return f"{label}: {', '.join(claims)}{others}."


def _winner(pair: Comparison) -> str:
    return pair.first if pair.rate.share >= 1 / 2 else pair.second


def _loser(pair: Comparison) -> str:
    return pair.second if pair.rate.share >= 1 / 2 else pair.first


def _evidence(pair: Comparison, analysis: Analysis) -> str:
    """Return the rate of the arm that was chosen more often, with its interval and p-value."""
    rate, low, high = pair.rate.share, pair.rate.interval.low, pair.rate.interval.high
    if rate < 1 / 2:
        rate, low, high = 1 - rate, 1 - high, 1 - low
    corrected = " after correction" if analysis.comparisons > 1 else ""
    return (
        f"{100 * rate:.1f} % of answers (95 % interval {100 * low:.1f} to {100 * high:.1f} %, "
        f"sign test p = {pair.corrected_p_value:.2g}{corrected})"
    )


def caution(analysis: Analysis) -> str:
    """Return how to read the verdicts, and whether the study is too small for any certain difference."""
    text = (
        "A difference is certain if the interval excludes 50 % and the sign tests over raters and over "
        "prompts agree. Without one, the arms may still differ: the interval shows which rates are possible."
    )
    needed = _least_units(analysis.comparisons)
    if min(analysis.raters, analysis.prompts) < needed:
        tests = _plural(analysis.comparisons, "comparison")
        text += f" In a study of {tests} this needs at least {needed} raters and {needed} prompts."
    return text


def _least_units(comparisons: int) -> int:
    """Return how many raters or prompts must agree for a corrected sign test to be significant."""
    return math.floor(math.log2(2 * comparisons / (1 - CONFIDENCE))) + 1


def screening_lines(analysis: Analysis) -> list[str]:
    """Return which raters were excluded, by which rule, and what the catch trials cannot show."""
    screening = analysis.screening
    rule = f"fewer than {100 * screening.least:g} % right answers in catch trials"
    if screening.excluded:
        names = ", ".join(f"{each.name} ({each.right} of {each.total})" for each in screening.excluded)
        count = _plural(len(screening.excluded), "rater")
        lines = [f"Excluded {count} with {rule}: {names}."]
    else:
        lines = [f"No rater was excluded: none had {rule}."]
    untested = [each.name for each in screening.kept if not each.total]
    if untested:
        lines.append(f"No catch trial was answered by {', '.join(untested)}; their answers are used.")
    weak = [each for each in screening.kept if each.total and each.by_chance > CHANCE_LIMIT]
    if weak:
        worst = max(each.by_chance for each in weak)
        lines.append(
            f"{_plural(len(weak), 'rater')} had so few catch trials that guesses pass them with a "
            f"probability of up to {100 * worst:.0f} %."
        )
    return lines


def _cells(analysis: Analysis, cell: Callable[[QuestionResult], str]) -> list[str]:
    """Return one cell for each question of the paper, in its order."""
    results = {result.question: result for result in analysis.questions}
    return [cell(results[each.name]) if each.name in results else NONE for each in QUESTIONS]


def _table(first: str, rows: Sequence[Sequence[str]]) -> str:
    """Return a table in Markdown whose columns also line up in a terminal."""
    header = [first, *(question.short for question in QUESTIONS)]
    widths = [max(len(row[i]) for row in (header, *rows)) for i in range(len(header))]
    lines = [header, ["-" * width for width in widths], *rows]
    return "\n".join(
        f"| {' | '.join(cell.ljust(width) for cell, width in zip(line, widths, strict=True))} |"
        for line in lines
    )


def _with_interval(share: float, interval: Interval) -> str:
    return f"{100 * share:.1f} ({100 * interval.low:.1f} to {100 * interval.high:.1f})"


def _bullets(lines: Sequence[str]) -> str:
    return "\n".join(f"- {line}" for line in lines)


def _plural(count: int, noun: str) -> str:
    return f"{count:,} {noun}" if count == 1 else f"{count:,} {noun}s"
