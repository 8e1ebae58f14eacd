"""report.html of a sweep: the table that compares its arms, the figures, and the jobs that went wrong."""

import shlex
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from textwrap import shorten

from matplotlib.figure import Figure

from cadam3d.core.errors import UserError
from cadam3d.core.outcome import Outcome
from cadam3d.io.jsonl import read_json
from cadam3d.io.run_folder import CHOICE, FIGURES, REPORT, TABLE
from cadam3d.report import figures, strips, tables
from cadam3d.report.compare import could_be_certain, every_pair
from cadam3d.report.pages import table, write_page
from cadam3d.report.paper_formats import FORMATS, read_table
from cadam3d.report.results import NOISE, PROMPT, JobResult, arms_of, measured, objective_axis, read
from cadam3d.report.score_maps import declared_scores, score_figure
from cadam3d.report.style import inline, styled, write_figure
from cadam3d.settings.line import key_of
from cadam3d.sweep.folder import Plan, is_sweep, load, read_plan
from cadam3d.sweep.table import records_of

Results = Sequence[JobResult]


@dataclass(frozen=True)
class FigureKind:
    """A figure that a sweep can have."""

    draw: Callable[[Results], Figure | None]  # None: the results have no data for it
    title: str
    caption: str
    # More sentences of the caption, each with the question whether the figure of these results has that.
    details: Sequence[tuple[Callable[[Results], bool], str]] = ()

    def described(self, results: Results) -> str:
        """Return the caption of the figure of these results."""
        shown = measured(results)
        return " ".join([self.caption, *(text for is_drawn, text in self.details if is_drawn(shown))])


def _has_cells(results: Results) -> bool:
    return len({result.cell.without(NOISE) for result in results}) > 1


def _has_labels(results: Results) -> bool:
    return any(len(result.setting.thresholds) == 1 for result in results)


def _has_standard(results: Results) -> bool:
    return any(result.is_standard and result.setting.thresholds for result in results)


def _has_objectives(results: Results) -> bool:
    return len({result.cell[objective_axis(results)] for result in results}) > 1


FRONTIER = "Up and to the left is better. Each mark is one setting."
FRONTIER_DETAILS = (
    (_has_cells, "It is the median over cells, and bars hold the middle half of the cells."),
    (_has_labels, "An arm with one threshold has it beside each mark."),
    (_has_standard, "The standard setting is ringed."),
    (lambda results: any(result.ended_early for result in results), "A dagger means that jobs ended early."),
)
# The figures of every sweep. A sweep also has declared scores, and a grid may name "frontier_NAME",
# the frontier of any other number.
KINDS = {
    "frontier": FigureKind(
        figures.frontier_figure, "Quality against count", FRONTIER, details=FRONTIER_DETAILS
    ),
    "growth": FigureKind(
        figures.growth_figure,
        "Gaussians over time",
        "An arm that stops growing on its own levels off; an arm that does not keeps climbing.",
        details=[(_has_cells, "Medians over cells; the shaded areas hold the middle half of the cells.")],
    ),
    "masks": FigureKind(
        strips.masks_figure,
        "Selected Gaussians",
        "The Gaussians that each arm selects before a refinement, in orange. An arm that follows noise "
        "selects Gaussians everywhere.",
    ),
    "thresholds": FigureKind(
        figures.thresholds_figure,
        "Two thresholds",
        "How the count and the quality depend on two thresholds of one arm.",
        details=[(_has_cells, "Medians over cells."), (_has_standard, "The standard setting is bold.")],
    ),
    "assets": FigureKind(
        strips.assets_figure,
        "Arms side by side",
        "One scene from the same start, with the final count and quality.",
        details=[(_has_objectives, "Columns are arms, and rows are objectives.")],
    ),
}
LONGEST_PROMPTS = 120  # characters, in the title of a page
SCORE_CAPTION = "Darker cells hold more Gaussians."
LEVELS_CAPTION = "The dashed lines are values to compare with."


def write(sweep_folder: Path, baseline: str | None = None) -> Path:
    """Write ``report.html`` and ``figures/`` of the sweep in ``sweep_folder`` from the jobs done so far.

    The grid of the sweep may name its figures: those of ``KINDS``, the scores that the jobs declare, and
    ``frontier_NAME`` of a number. Otherwise all are drawn that have data. ``baseline`` is the arm that others
    are compared with. Raises ``UserError`` if the folder holds no sweep and if a file cannot be written.
    """
    if not is_sweep(sweep_folder):
        raise UserError(f"{sweep_folder}: expected a sweep, got another folder. Try: cadam3d sweep --help")
    plan, results = read_plan(sweep_folder), read(sweep_folder)
    if not results:
        raise UserError(f"{sweep_folder}: expected a sweep with jobs, got none. Try: cadam3d sweep --help")
    folder = sweep_folder / FIGURES
    comparison = tables.comparison_table(results, baseline)
    medians = tables.medians_table(results)
    pairs = every_pair(results) if len(arms_of(results)) > 2 else []
    tables.write(folder / "comparison.csv", comparison)
    tables.write(folder / "medians.csv", medians)
    tables.write(folder / "pairs.csv", tables.pairs_table(pairs))
    kinds = KINDS | _scores(results)
    chosen = list(kinds) if plan.figures is None else plan.figures
    kinds |= _frontiers(results)
    drawn = [(kinds[name], _drawn(results, name, kinds[name], folder)) for name in chosen if name in kinds]
    unknown = [name for name in chosen if name not in kinds]
    return write_page(
        sweep_folder / REPORT,
        "sweep.html.jinja",
        title=_title(plan, results),
        outcomes=Counter(result.outcome for result in results).most_common(),
        warnings=[f"figures: expected one of {', '.join(kinds)}, got {name}." for name in unknown],
        choice=_choice(sweep_folder),
        comparison=table(tables.shown_comparison(comparison, results), align_decimals=True),
        pairs=pairs,
        could_be_certain=could_be_certain(pairs),
        matrix=table(tables.shown_matrix(pairs)),
        paper=read_table(sweep_folder),
        medians=table(medians, align_decimals=True),
        figures=[(kind.title, kind.described(results), svg) for kind, svg in drawn if svg],
        early=[each for each in results if each.outcome != Outcome.FINISHED and not each.is_unfinished],
        waiting=sum(result.is_unfinished for result in results),
        jobs=table(records_of(load(sweep_folder)), align_decimals=True),
        commands=_commands(plan),
        files=[name for name in (TABLE, *FORMATS, FIGURES) if (sweep_folder / name).exists()],
    )


def _choice(folder: Path) -> str:
    """Return why one of several attempts is the best; empty if none was chosen."""
    try:
        return str(read_json(folder / CHOICE)["why"])
    except (UserError, LookupError, TypeError):
        return ""


def _scores(results: Results) -> dict[str, FigureKind]:
    """Return the figures of the scores that the jobs declare."""
    return {
        score: FigureKind(
            partial(score_figure, chart=chart),
            chart.title,
            " ".join([chart.caption, SCORE_CAPTION, *([LEVELS_CAPTION] if chart.levels else [])]),
        )
        for score, chart in declared_scores(results).items()
        if score not in KINDS
    }


def _frontiers(results: Results) -> dict[str, FigureKind]:
    """Return the frontiers of all declared numbers, which are drawn only on request.

    A number that replaces another one, such as the PSNR at the best turn, is drawn under the other's name.
    """
    numbers = [result.declared[name] for result in measured(results) for name in result.numbers]
    return {
        f"frontier_{each.replaces or each.name}": FigureKind(
            partial(figures.frontier_figure, quality=each),
            f"{each.fact} against count",
            FRONTIER,
            details=FRONTIER_DETAILS,
        )
        for each in numbers
    }


def _drawn(results: Results, name: str, kind: FigureKind, folder: Path) -> str:
    """Return a figure as a part of the page, and write its files; empty if there are no data for it."""
    with styled():
        figure = kind.draw(results)
        return inline(write_figure(figure, folder, name)) if figure else ""


def _title(plan: Plan, results: Results) -> str:
    """Return the name of the grid, if there is one, and the prompts."""
    grids = [str(word).partition("=")[2].strip("'\"") for word in plan.line if key_of(str(word)) == "grid"]
    name = next(filter(None, grids), "Sweep") if plan.command == "sweep" else f"{len(results)} attempts"
    prompts = ", ".join(filter(None, dict.fromkeys(result.cell[PROMPT] for result in results)))
    return f"{name}: {shorten(prompts, LONGEST_PROMPTS, placeholder=' ...')}" if prompts else name


def _commands(plan: Plan) -> str:
    """Return the command lines of the sweep and of each job."""
    lines = [[plan.command, *plan.line]] if plan.line else []
    lines += [["train", *plan.flags, *job.overrides] for job in plan.jobs]
    return "\n".join(shlex.join(["cadam3d", *map(str, line)]) for line in lines)
