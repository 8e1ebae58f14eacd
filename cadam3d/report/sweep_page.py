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
from cadam3d.report import figures, paper_formats, strips, tables
from cadam3d.report.formatting import plural
from cadam3d.report.pages import Column, Table, table, write_page
from cadam3d.report.paper_formats import FORMATS, read_table
from cadam3d.report.paper_table import PaperTable
from cadam3d.report.results import NOISE, PROMPT, SEED, JobResult, measured, read
from cadam3d.report.score_maps import declared_scores, score_figure
from cadam3d.report.style import inline, styled, write_figure
from cadam3d.settings.line import key_of
from cadam3d.sweep.folder import Plan, is_sweep, read_plan


@dataclass(frozen=True)
class FigureKind:
    """A figure that a sweep can have."""

    draw: Callable[[Sequence[JobResult]], Figure | None]  # None: the results have no data for it
    title: str
    caption: str


@dataclass(frozen=True)
class ShownFigure:
    """A figure as a part of the page."""

    title: str
    caption: str
    svg: str


FRONTIER = (
    "Up and to the left is better. Each mark is the median of one setting over cells; an arm with one "
    "threshold has it beside each mark, and the standard setting is ringed. Bars hold the middle half of the "
    "cells. A hollow mark lacks some cells, and a dagger means that jobs ended early."
)
# The figures of every sweep. Those of declared scores come after "growth", and a grid may also name
# "frontier_NAME", the frontier of any other number.
KINDS = {
    "frontier": FigureKind(figures.frontier_figure, "Quality against count", FRONTIER),
    "growth": FigureKind(
        figures.growth_figure,
        "Gaussians over time",
        "An arm that stops growing on its own levels off; an arm that does not keeps climbing. Medians over "
        "cells; the shaded areas hold the middle half of the cells.",
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
        "How the count and the quality depend on two thresholds of one arm. Medians over cells; the standard "
        "setting is bold.",
    ),
    "ablation": FigureKind(
        strips.ablation_figure,
        "Arms side by side",
        "The same scene from the same start; only the arm differs.",
    ),
    "objectives": FigureKind(
        strips.objectives_figure,
        "Objectives and arms",
        "One scene under each objective (lines) and arm (columns), with its final count and quality.",
    ),
}
MOST_PROMPTS = 3  # in the title of a page
LONGEST_PROMPT = 60  # characters of a prompt there
SCORES_AFTER = "growth"
SCORE_CAPTION = "Darker cells hold more Gaussians; the dashed lines are values to compare with."


def write(sweep_folder: Path, names: Sequence[str] | None = None, baseline: str | None = None) -> Path:
    """Write ``report.html`` and ``figures/`` of the sweep in ``sweep_folder`` from the jobs done so far.

    ``names`` are the figures to draw: those of ``KINDS``, the scores that the jobs declare, and
    ``frontier_NAME`` of a number. ``None`` stands for the figures that the grid of the sweep names, or else
    for all that the data allow. ``baseline`` is the arm that others are compared with. Raises ``UserError``
    if the folder holds no sweep and if a file cannot be written.
    """
    if not is_sweep(sweep_folder):
        raise UserError(f"{sweep_folder}: expected a sweep, got another folder. Try: cadam3d sweep --help")
    plan, results = read_plan(sweep_folder), read(sweep_folder)
    if not results:
        raise UserError(f"{sweep_folder}: expected a sweep with jobs, got none. Try: cadam3d sweep --help")
    names = plan.figures if names is None else names
    kinds = _kinds(results)
    chosen = list(kinds) if names is None else names
    kinds |= _frontiers(results)
    folder = sweep_folder / FIGURES
    comparison = tables.comparison_table(results, baseline)
    medians = tables.medians_table(results)
    tables.write_csv(folder / "comparison.csv", comparison)
    tables.write_csv(folder / "medians.csv", medians)
    drawn = [_drawn(results, name, kinds[name], folder) for name in chosen if name in kinds]
    paper = read_table(sweep_folder)
    return write_page(
        sweep_folder / REPORT,
        "sweep.html.jinja",
        title=_title(plan, results),
        outcomes=Counter(result.outcome for result in results).most_common(),
        extent=_extent(results),
        warnings=_unknown(chosen, kinds),
        choice=_choice(sweep_folder, plan),
        comparison=table(tables.shown_comparison(comparison, results), align_decimals=True),
        paper_table=_shown(paper),
        paper_notes=[] if paper is None else paper.notes,
        medians=table(medians, align_decimals=True),
        figures=[figure for figure in drawn if figure is not None],
        early=[each for each in results if each.outcome != Outcome.FINISHED and not each.is_unfinished],
        waiting=sum(result.is_unfinished for result in results),
        jobs=table(tables.jobs_table(results), link="job", align_decimals=True),
        commands=_commands(plan),
        files=[name for name in (TABLE, *FORMATS, FIGURES) if (sweep_folder / name).exists()],
    )


def _choice(folder: Path, plan: Plan) -> str:
    """Return why one of several attempts is the best, if the jobs are attempts and one was chosen."""
    if plan.command != "train" or not (folder / CHOICE).is_file():
        return ""
    try:
        content = read_json(folder / CHOICE)
    except UserError:
        return ""
    reason = content.get("why") if isinstance(content, dict) else None
    return reason if isinstance(reason, str) else ""


def _shown(found: PaperTable | None) -> Table:
    """Return the paper's table as a part of the page; it is empty if there is none."""
    if found is None:
        return Table([], [])
    titles = paper_formats.headings(found)
    texts = len(titles) - len(found.numbers)
    columns = [Column(title, is_text=i < texts, is_link=False) for i, title in enumerate(titles)]
    return Table(columns, paper_formats.texts(found))


def _kinds(results: Sequence[JobResult]) -> dict[str, FigureKind]:
    """Return all figures that these results can have, in the order of the page."""
    kinds: dict[str, FigureKind] = {}
    for name, kind in KINDS.items():
        kinds[name] = kind
        if name == SCORES_AFTER:
            kinds |= {
                score: FigureKind(
                    partial(score_figure, chart=chart),
                    chart.title,
                    f"{chart.caption.rstrip('.')}. {SCORE_CAPTION}",
                )
                for score, chart in declared_scores(results).items()
                if score not in KINDS
            }
    return kinds


def _frontiers(results: Sequence[JobResult]) -> dict[str, FigureKind]:
    """Return the frontiers of all declared numbers, which are drawn only on request.

    A number that replaces another one, such as the PSNR at the best turn, is drawn under the other's name.
    """
    numbers = {each.name: each for result in measured(results) for each in result.declared.values()}
    return {
        f"frontier_{each.replaces or each.name}": FigureKind(
            partial(figures.frontier_figure, quality=each), f"{each.fact} against count", FRONTIER
        )
        for each in numbers.values()
        if any(each.name in result.numbers for result in results)
    }


def _unknown(names: Sequence[str], kinds: dict[str, FigureKind]) -> list[str]:
    """Return a remark for each figure that does not exist, or not yet: a score may still be declared."""
    return [
        f"figures: no figure is called {name}. The figures of this sweep are {', '.join(kinds)}."
        for name in names
        if name not in kinds
    ]


def _drawn(results: Sequence[JobResult], name: str, kind: FigureKind, folder: Path) -> ShownFigure | None:
    with styled():
        figure = kind.draw(results)
        if figure is None:
            return None
        return ShownFigure(kind.title, kind.caption, inline(write_figure(figure, folder, name)))


def _title(plan: Plan, results: Sequence[JobResult]) -> str:
    """Return the name of the grid, if there is one, and the prompts."""
    grids = [str(word).partition("=")[2].strip("'\"") for word in plan.line if key_of(str(word)) == "grid"]
    name = next((grid for grid in grids if grid not in ("", "null")), "Sweep")
    if plan.command == "train":
        name = plural(len(results), "attempt")
    prompts = list(filter(None, dict.fromkeys(result.cell[PROMPT] for result in results)))
    shown = [shorten(text, LONGEST_PROMPT, placeholder=" ...") for text in prompts[:MOST_PROMPTS]]
    more = f" and {len(prompts) - len(shown)} more" if len(prompts) > len(shown) else ""
    return f"{name}: {', '.join(shown)}{more}" if shown else name


def _extent(results: Sequence[JobResult]) -> list[str]:
    """Return how many prompts, seeds, noise levels and settings there are."""
    texts = []
    for key, noun in ((PROMPT, "prompt"), (SEED, "seed"), (NOISE, "noise level")):
        if values := {result.cell[key] for result in results if result.cell[key]}:
            texts.append(plural(len(values), noun))
    return [*texts, plural(len({result.setting for result in results}), "setting")]


def _commands(plan: Plan) -> str:
    """Return the command line of the sweep and that of each of its jobs."""
    lines = [[plan.command, *plan.line]] if plan.line else []
    lines += [["train", *job.overrides] for job in plan.jobs]
    return "\n".join(shlex.join(["cadam3d", *map(str, line)]) for line in lines)
