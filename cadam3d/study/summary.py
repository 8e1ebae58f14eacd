"""Summary: the analysis of a study as Markdown, which the command also prints."""

from cadam3d.io.text_tables import bullets
from cadam3d.io.text_tables import markdown as table
from cadam3d.study.analysis import Analysis, Rate
from cadam3d.study.estimates import Interval
from cadam3d.study.questions import QUESTIONS, Question

# The table of the user study in the paper: rates in % of 30 raters, averaged over samples of GaussianDreamer,
# LucidDreamer and FlowDreamer. The paper prints no intervals.
PUBLISHED = {
    "Baseline": (50.5, 45.8, 51.9, 55.7, 50.4),
    "CAdam": (49.4, 54.1, 48.0, 44.3, 49.5),
}
NONE = "-"
READING = (
    "A star marks a certain difference: the interval excludes 50 %, and the sign tests over raters and over "
    "prompts both have p < 0.05, corrected for the number of comparisons. p is the larger one of the two. "
    "Without a star, the arms may still differ, and the interval shows which rates are possible."
)


def markdown(analysis: Analysis) -> str:
    """Return the result of a study: its size, excluded raters, rates and pairs."""
    sizes = (analysis.raters, "raters"), (analysis.prompts, "prompts"), (analysis.answers, "answers")
    parts = [
        "# User study",
        f"{len(analysis.arms)} arms, {', '.join(f'{count:,} {noun}' for count, noun in sizes)}.",
        bullets(screening_lines(analysis)),
        "How often each arm was chosen, in % of its comparisons (95 % interval over raters and prompts):",
        _rates(analysis),
        "How often the first arm of each pair was chosen:",
        _pairs(analysis),
        READING,
    ]
    return "\n\n".join(parts) + "\n"


def screening_lines(analysis: Analysis) -> list[str]:
    """Return which raters were excluded and which met no catch trial."""
    kept, excluded = analysis.screening.kept, analysis.screening.excluded
    names = ", ".join(f"{each.name} ({each.right} of {each.total})" for each in excluded) or "none"
    untested = ", ".join(each.name for each in kept if not each.total) or "none"
    least = f"{100 * analysis.screening.least:g} %"
    return [
        f"Excluded, with fewer than {least} right answers in catch trials: {names}.",
        f"Kept without an answer in a catch trial: {untested}.",
    ]


def _rates(analysis: Analysis) -> str:
    """Return the table of the paper: a row for each arm, and the published rows below."""
    found = {(each.question, rate.arm): rate for each in analysis.questions for rate in each.rates}

    def cell(question: Question, arm: str) -> str:
        rate: Rate | None = found.get((question.name, arm))
        return NONE if rate is None else f"{_percent(rate.share)} {_range(rate.interval)}"

    rows = [[arm, *(cell(question, arm) for question in QUESTIONS)] for arm in analysis.arms]
    rows += [[f"{arm} (published)", *(f"{rate:.1f}" for rate in rates)] for arm, rates in PUBLISHED.items()]
    titles = ["arm", *(question.short for question in QUESTIONS)]
    return table([titles, *rows], [True] * len(titles))


def _pairs(analysis: Analysis) -> str:
    rows = [
        [
            result.question,
            f"{pair.first} over {pair.second}",
            _percent(pair.rate.share) + ("*" if pair.is_certain else ""),
            _range(pair.rate.interval),
            f"{pair.corrected_p_value:.2g}",
        ]
        for result in analysis.questions
        for pair in result.comparisons
    ]
    return table([["question", "pair", "%", "95 % interval", "p"], *rows], [True] * 5)


def _percent(share: float) -> str:
    return f"{100 * share:.1f}"


def _range(interval: Interval) -> str:
    return f"({100 * interval.low:.1f} to {100 * interval.high:.1f})"
