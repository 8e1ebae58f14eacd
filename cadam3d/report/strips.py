"""Strips: figures of a sweep that show assets in lines and columns, each with its numbers underneath."""

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from cadam3d.core.palette import INK, SOFT
from cadam3d.io.image import read_png, step_pictures
from cadam3d.io.records import read_config
from cadam3d.io.run_folder import CANDIDATES, CONFIG, PREVIEW
from cadam3d.report.compare import by_cell, main_setting, qualities
from cadam3d.report.results import (
    NOISE,
    PROMPT,
    SEED,
    Cell,
    JobResult,
    arms_of,
    histograms,
    level_title,
    measured,
    objective_axis,
)
from cadam3d.report.style import hide_axes, looks, new_figure
from cadam3d.settings.compose import flatten

MAX_COLUMNS = 7  # pictures in one line
TITLE_CHARACTERS_PER_INCH = 15  # that surely fit at the size of a title
PICTURE_INCH = 1.6
PREFERRED_NOISE = "medium"  # the level to show

# A picture with the text above it and the text below it; None for an empty place.
ShownPicture = tuple[np.ndarray, str, str] | None


def masks_figure(results: Sequence[JobResult]) -> Figure | None:
    """Show the selected Gaussians over time: a line per arm, a column per refinement (paper fig. 6)."""
    members = main_results([result for result in results if candidate_pictures(result)])
    if not members:
        return None
    steps = sorted({step for result in members for step in candidate_pictures(result)})
    picked = np.linspace(0, len(steps) - 1, min(len(steps), MAX_COLUMNS)).round().astype(int)
    lines = {result.arm: [_mask(result, steps[i]) for i in picked] for result in members}
    return _draw(lines, results, members[0].cell)


def _mask(result: JobResult, step: int) -> ShownPicture:
    path = candidate_pictures(result).get(step)
    if path is None:
        return None
    found = [line for line in histograms(result) if line["step"] == step]
    text = f"{sum(found[0]['selected']):,} of {sum(found[0]['counts']):,}" if found else ""
    # Pictures come in pairs of a view and its mask, all square.
    picture = read_png(path)
    size = picture.shape[0]
    return picture[:, size : 2 * size], f"step {step}", text


def assets_figure(results: Sequence[JobResult]) -> Figure | None:
    """Show the assets of one cell: a line per objective, a column per arm (paper fig. 4 and 7)."""
    axis = objective_axis(results)
    shown = [result for result in measured(results) if (result.folder / PREVIEW).is_file()]
    arms = arms_of(shown)[:MAX_COLUMNS]
    if len({(result.cell[axis], result.arm) for result in shown}) < 2:
        return None
    cell = main_results(shown)[0].cell.without(axis)
    lines = {}
    for objective in sorted({result.cell[axis] for result in shown}):
        own = [each for each in shown if (each.cell[axis], each.cell.without(axis)) == (objective, cell)]
        members = {result.arm: result for result in main_results(own)}
        lines[objective] = [
            (first_view(members[arm]), arm, _facts(members[arm])) if arm in members else None for arm in arms
        ]
    return _draw(lines, results, cell)


def main_results(results: Sequence[JobResult]) -> list[JobResult]:
    """Return the result of each arm at its main setting, all in one cell.

    The cell is one with most arms, preferably at medium noise.
    """
    of_arms = [by_cell(results, main_setting(results, arm)) for arm in arms_of(results)]
    cells = sorted({cell for members in of_arms for cell in members})
    if not cells:
        return []
    shown = max(
        cells, key=lambda cell: (sum(cell in each for each in of_arms), cell[NOISE] == PREFERRED_NOISE)
    )
    return [members[shown] for members in of_arms if shown in members]


def candidate_pictures(result: JobResult) -> dict[int, Path]:
    """Return the pictures of the candidates callback: step and path."""
    return dict(step_pictures(result.folder / CANDIDATES))


def first_view(result: JobResult) -> np.ndarray:
    """Return the first picture of ``preview.png``, which must exist."""
    sheet, path = read_png(result.folder / PREVIEW), result.folder / CONFIG
    size = dict(flatten(read_config(path))).get("exporter.preview.size") if path.is_file() else None
    size = size if type(size) is int and size > 0 else min(sheet.shape[:2])
    return sheet[:size, :size]


def _facts(result: JobResult) -> str:
    """Return the count and the quality of an asset, and how its job ended if that was early."""
    facts = [f"{result.count:,.0f} Gaussians"]
    facts += [each.written(result.numbers[each.name]) for each in qualities([result])[:1]]
    facts += [result.outcome.replace("_", " ")] * result.ended_early
    return "\n".join(facts)


def _draw(lines: Mapping[str, Sequence[ShownPicture]], results: Sequence[JobResult], cell: Cell) -> Figure:
    """Draw lines of pictures with their titles on the left, and the name of the cell above all."""
    columns = max(map(len, lines.values()))
    figure = new_figure(columns, len(lines), width=PICTURE_INCH * columns + 0.4, height=PICTURE_INCH * 1.25)
    panels = figure.subplots(len(lines), columns, squeeze=False)
    colors = {arm: look.color for arm, look in looks(result.arm for result in results).items()}
    for row, (name, pictures) in zip(panels, lines.items(), strict=True):
        row[0].set_ylabel(name.replace("_", "\n"), fontsize=8.5, weight="bold", color=colors.get(name, SOFT))
        for axes in row:
            hide_axes(axes)
        for axes, (image, above, below) in ((row[i], each) for i, each in enumerate(pictures) if each):
            axes.imshow(image, interpolation="antialiased")
            axes.set_xlabel(below, fontsize=7.5, color=SOFT, labelpad=2)
            axes.set_title(above, fontsize=8.5, weight="normal", loc="center", color=colors.get(above, INK))
    words = [cell[PROMPT], level_title(cell[NOISE]), f"seed {cell[SEED]}"]
    title = textwrap.fill(
        ", ".join(filter(None, words)), int(TITLE_CHARACTERS_PER_INCH * figure.get_figwidth())
    )
    figure.suptitle(title, fontsize=8.5, color=SOFT, x=0.01, ha="left")
    return figure
