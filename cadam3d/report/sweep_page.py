"""report.html of a sweep: the verdict in words, the key table, the figures, and the jobs that went wrong."""

import shlex
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import shorten

from matplotlib.figure import Figure

from cadam3d.core.errors import UserError
from cadam3d.core.outcome import Outcome
from cadam3d.io.jsonl import read_json
from cadam3d.io.run_folder import CHOICE, FIGURES, REPORT, TABLE
from cadam3d.report import figures, pictures, table_formats, tables, verdicts
from cadam3d.report.claims import LEAST_FOR_QUARTILES, compare, standard_setting
from cadam3d.report.formatting import plural
from cadam3d.report.pages import Column, Table, Tile, table, write_page
from cadam3d.report.paper_table import PaperTable
from cadam3d.report.results import ARM, NOISE, PROMPT, SEED, JobResult, arms_of, read, with_noise
from cadam3d.report.score_maps import declared_scores, score_figure
from cadam3d.report.style import inline, styled, write_figure
from cadam3d.report.table_files import FORMATS, read_table
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


@dataclass(frozen=True)
class ShownPaperTable:
    """The paper's table as a part of the page."""

    sections: list[tuple[str, Table]]  # with the category, if there is more than one
    notes: list[str]

    @classmethod
    def of(cls, found: PaperTable) -> "ShownPaperTable":
        """Return the table, ready to be shown."""
        titles = [
            Column(title, is_text=position < len(table_formats.FIRST), is_link=False)
            for position, title in enumerate(table_formats.headings(found))
        ]
        sections = [
            (
                (section.category or table_formats.ALL) if len(found.sections) > 1 else "",
                Table(titles, [table_formats.texts(row, found.names) for row in section.rows]),
            )
            for section in found.sections
        ]
        return cls(sections, found.notes)


SPREAD = (
    f"the quartiles over cells or, with fewer than {LEAST_FOR_QUARTILES} prompts, the lowest and the highest "
    "value"
)
# The figures of every sweep. Those of declared scores come after "growth".
KINDS = {
    "frontier": FigureKind(
        figures.frontier_figure,
        "Quality against count",
        "Up and to the left is better: more PSNR from fewer Gaussians. Each mark is the median of one "
        "setting over cells, labelled with its thresholds; the standard setting is ringed. Thick bars show "
        f"the spread over seeds, thin bars {SPREAD}. A hollow mark lacks some cells, and a "
        "dagger means that jobs ended early. The dashed line is the best that any arm reaches with the same "
        "seeds and no noise.",
    ),
    "frontier_ssim": FigureKind(
        figures.frontier_ssim_figure,
        "Structure against count",
        "The same figure for SSIM: up and to the left is better.",
    ),
    "growth": FigureKind(
        figures.growth_figure,
        "Gaussians over time",
        "An arm that stops growing on its own levels off; an arm that does not keeps climbing. Medians over "
        f"cells; the shaded areas show {SPREAD}.",
    ),
    "masks": FigureKind(
        pictures.masks_figure,
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
    "regimes": FigureKind(
        pictures.regimes_figure,
        "From fewest to most Gaussians",
        "The same scene with the thresholds that leave fewest Gaussians, the standard ones, and those that "
        "leave most.",
    ),
    "ablation": FigureKind(
        pictures.ablation_figure,
        "Arms side by side",
        "The same scene from the same start; only the arm differs.",
    ),
    "objectives": FigureKind(
        pictures.objectives_figure,
        "Objectives and arms",
        "One scene under each objective (lines) and arm (columns), with its final count and PSNR.",
    ),
}
MOST_PROMPTS = 3  # in the title of a page
LONGEST_PROMPT = 60  # characters of a prompt there
SCORES_AFTER = "growth"
SCORE_CAPTION = "Darker cells hold more Gaussians; the dashed lines are values to compare with."


def write(sweep_folder: Path, names: Sequence[str] | None = None) -> Path:
    """Write ``report.html`` and ``figures/`` of the sweep in ``sweep_folder`` from the jobs done so far.

    ``names`` are the figures to draw: those of ``KINDS`` and the scores that the jobs declare. ``None``
    stands for the figures that the grid of the sweep names, or else for all that the data allow. Raises
    ``UserError`` if the folder holds no sweep and if a file cannot be written.
    """
    if not is_sweep(sweep_folder):
        raise UserError(f"{sweep_folder}: expected a sweep, got another folder. Try: cadam3d sweep --help")
    plan, results = read_plan(sweep_folder), read(sweep_folder)
    if not results:
        raise UserError(f"{sweep_folder}: expected a sweep with jobs, got none. Try: cadam3d sweep --help")
    kinds = _kinds(results)
    names = plan.figures if names is None else names
    folder = sweep_folder / FIGURES
    contents = {
        "objectives": tables.objectives_table(results),
        "frontiers": tables.frontier_table(results),
        "standings": tables.standings_table(results),
    }
    for name, lines in contents.items():
        tables.write_csv(folder / f"{name}.csv", lines)
    paper = read_table(sweep_folder)
    drawn = [_drawn(results, name, kinds[name], folder) for name in names or kinds if name in kinds]
    files = [name for name in (TABLE, *FORMATS, FIGURES) if (sweep_folder / name).exists()]
    return write_page(
        sweep_folder / REPORT,
        "sweep.html.jinja",
        title=_title(plan, results),
        outcomes=Counter(result.outcome for result in results).most_common(),
        extent=_extent(results),
        warnings=_unknown(names or (), kinds),
        paper_table=None if paper is None else ShownPaperTable.of(paper),
        verdict=[*_choice(sweep_folder, plan), *verdicts.headline(results)],
        tiles=_tiles(results),
        key_table=table(contents["objectives"], align_decimals=True),
        without_standard=[arm for arm in arms_of(results) if standard_setting(results, arm) is None],
        figures=[figure for figure in drawn if figure is not None],
        standings=table(contents["standings"], align_decimals=True),
        theirs=verdicts.THEIRS,
        frontiers=table(contents["frontiers"], align_decimals=True),
        early=[each for each in results if each.outcome != Outcome.FINISHED and not each.is_unfinished],
        waiting=sum(result.is_unfinished for result in results),
        jobs=table(tables.jobs_table(results), link="job", align_decimals=True),
        commands=_commands(plan),
        files=files,
    )


def _choice(folder: Path, plan: Plan) -> list[str]:
    """Return why one of several attempts is the best, if the jobs are attempts and one was chosen."""
    if plan.command != "train" or not (folder / CHOICE).is_file():
        return []
    try:
        content = read_json(folder / CHOICE)
    except UserError:
        return []
    reason = content.get("why") if isinstance(content, dict) else None
    return [reason] if isinstance(reason, str) else []


def for_shell(word: str) -> str:
    """Return a word quoted for a shell, in double quotes where they are enough."""
    plain = shlex.quote(word)
    return plain if plain == word or set(word) & set('"$`\\!') else f'"{word}"'


def _kinds(results: Sequence[JobResult]) -> dict[str, FigureKind]:
    """Return all figures that these results can have, in the order of the page."""
    kinds: dict[str, FigureKind] = {}
    for name, kind in KINDS.items():
        kinds[name] = kind
        if name == SCORES_AFTER:
            kinds |= {
                score: FigureKind(
                    lambda results, chart=chart: score_figure(results, chart),
                    chart.title,
                    f"{chart.caption.rstrip('.')}. {SCORE_CAPTION}",
                )
                for score, chart in declared_scores(results).items()
                if score not in KINDS
            }
    return kinds


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
    """Return the name of the grid, or the keys that vary, and the prompts."""
    grids = [str(word).partition("=")[2].strip("'\"") for word in plan.line if key_of(str(word)) == "grid"]
    grid = next((name for name in grids if name not in ("", "null")), None)
    varied = [ARM] if len({result.arm for result in results}) > 1 else []
    for pairs in (
        [result.setting.thresholds for result in results],
        [result.cell.axes for result in results],
    ):
        keys = dict.fromkeys(key for each in pairs for key, _ in each if key != PROMPT)
        varied += [key for key in keys if len({dict(each).get(key) for each in pairs}) > 1]
    listed = " and ".join(filter(None, [", ".join(varied[:-1]), *varied[-1:]]))
    name = grid or f"Sweep of {listed}".removesuffix(" of ")
    if plan.command == "train":
        name = plural(len(results), "attempt")
    texts = dict.fromkeys(result.cell[PROMPT] for result in results)
    prompts = [shorten(text, LONGEST_PROMPT, placeholder=" ...") for text in texts]
    shown = list(filter(None, prompts))[:MOST_PROMPTS]
    more = f" and {len(prompts) - len(shown)} more" if len(prompts) > len(shown) > 0 else ""
    return f"{name}: {', '.join(shown)}{more}" if shown else name


def _extent(results: Sequence[JobResult]) -> list[str]:
    """Return how many prompts, seeds, noise levels and settings there are, and how assets are compared."""
    texts = []
    for key, noun in ((PROMPT, "prompt"), (SEED, "seed"), (NOISE, "noise level")):
        if values := {result.cell[key] for result in results if result.cell[key]}:
            texts.append(plural(len(values), noun))
    texts.append(plural(len({result.setting for result in results}), "setting"))
    if any(result.is_turned for result in results):
        texts.append("PSNR and SSIM at the best turn about the vertical axis")
    return texts


def _tiles(results: Sequence[JobResult]) -> list[Tile]:
    """Return the paper's claim in numbers, over all levels of noise."""
    results = with_noise(results)
    ours, theirs = standard_setting(results, verdicts.OURS), standard_setting(results, verdicts.THEIRS)
    found = compare(results, ours, theirs) if ours and theirs else None
    if found is None:
        return []
    fewer, psnr, ssim = found.reduction, found.psnr, found.ssim
    cells = psnr.described(lambda value: f"{value:+.2f}")
    seeds = cells if found.psnr_over_seeds is None else f"{found.psnr_over_seeds:.2f} dB over seeds"
    early = plural(found.early + found.theirs_early, "run")
    return [
        Tile("Fewer Gaussians", f"{fewer.median:.1%}", fewer.described(lambda value: f"{value:.1%}")),
        Tile("PSNR difference", f"{psnr.median:+.2f} dB", seeds),
        Tile(
            "SSIM difference",
            "-" if ssim is None else f"{ssim.median:+.4f}",
            f"{found.ours.arm} minus {found.theirs.arm}",
        ),
        Tile("Cells compared", str(found.cells), f"{early} ended early"),
    ]


def _commands(plan: Plan) -> str:
    """Return the command line of the sweep and that of each of its jobs."""
    lines = [[plan.command, *plan.line]] if plan.line else []
    lines += [["train", *job.overrides] for job in plan.jobs]
    return "\n".join(" ".join(["cadam3d", *(for_shell(str(word)) for word in line)]) for line in lines)
