"""Strips: figures of a sweep that show assets in lines and columns, each with its numbers underneath."""

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from cadam3d.core.palette import INK, SOFT
from cadam3d.io.image import read_png, step_pictures
from cadam3d.io.run_folder import CANDIDATES, PREVIEW
from cadam3d.report.compare import by_cell, main_setting, qualities
from cadam3d.report.results import (
    NOISE,
    RECIPE,
    Cell,
    JobResult,
    arms_of,
    config,
    histograms,
    level_title,
    measured,
    objective_axis,
)
from cadam3d.report.style import hide_axes, looks, new_figure
from cadam3d.settings.compose import flatten

MAX_COLUMNS = 7  # pictures in one line
TITLE_CHARACTERS_PER_INCH = 15  # that surely fit at the size of a title
MAX_VIEWS = 4  # of one asset
PICTURE_INCH = 1.6
PREFERRED_NOISE = ("medium", "weak", "strong")  # the level to show, the first choice first


@dataclass(frozen=True)
class ShownPicture:
    """A picture of a strip with the text below it and above it."""

    image: np.ndarray | None  # None: an empty place
    caption: str = ""
    title: str = ""


def masks_figure(results: Sequence[JobResult]) -> Figure | None:
    """Show the selected Gaussians over time: a line per arm, a column per refinement (paper fig. 6)."""
    shown = showcase([result for result in results if candidate_pictures(result)])
    if shown is None:
        return None
    members = [result for result in main_results(results, shown) if candidate_pictures(result)]
    steps = sorted({step for result in members for step in candidate_pictures(result)})
    steps = [steps[i] for i in _evenly(len(steps), MAX_COLUMNS)]
    lines = {}
    for result in members:
        pictures = candidate_pictures(result)
        chosen = {
            each["step"]: f"{sum(each['selected']):,} of {sum(each['counts']):,}"
            for each in histograms(result)
        }
        lines[result.arm] = [
            ShownPicture(
                mask_of(read_png(pictures[step])) if step in pictures else None,
                chosen.get(step, ""),
                f"step {step}",
            )
            for step in steps
        ]
    return _draw(lines, results, shown)


def ablation_figure(results: Sequence[JobResult]) -> Figure | None:
    """Show one strip per arm in one cell: views of the asset, its count, quality and outcome (fig. 7)."""
    shown = showcase([result for result in results if has_views(result)])
    members = [result for result in main_results(results, shown) if has_views(result)] if shown else []
    if shown is None or len(members) < 2:
        return None
    lines = {}
    for result in members:
        first, *others = views(result)[:MAX_VIEWS]
        lines[result.arm] = [ShownPicture(first, _facts(result)), *map(ShownPicture, others)]
    return _draw(lines, results, shown)


def objectives_figure(results: Sequence[JobResult]) -> Figure | None:
    """Show one cell with a line per objective and a column per arm (paper fig. 4)."""
    axis = objective_axis(results)
    with_views = [result for result in measured(results) if result.cell[axis] and has_views(result)]
    objectives = sorted({result.cell[axis] for result in with_views})
    shown = showcase(with_views)
    if len(objectives) < 2 or shown is None:
        return None
    arms = arms_of(with_views)[:MAX_COLUMNS]
    cells = {
        result.cell[axis]: result.cell
        for result in with_views
        if result.cell.without(axis) == shown.without(axis)
    }
    lines = {}
    for objective in objectives:
        members = {result.arm: result for result in main_results(with_views, cells.get(objective))}
        lines[objective if axis == RECIPE else objective.upper()] = [
            ShownPicture(views(members[arm])[0], _facts(members[arm]), arm)
            if arm in members
            else ShownPicture(None)
            for arm in arms
        ]
    return _draw(lines, results, shown.without(axis))


def showcase(results: Sequence[JobResult]) -> Cell | None:
    """Return the cell to show: one with most arms, preferably at medium noise; ties by name."""
    cells: dict[Cell, set[str]] = {}
    for result in measured(results):
        cells.setdefault(result.cell, set()).add(result.arm)
    preference = {level: i for i, level in enumerate(PREFERRED_NOISE)}
    worst = len(preference)
    return min(cells, key=lambda c: (-len(cells[c]), preference.get(c[NOISE], worst), c), default=None)


def main_results(results: Sequence[JobResult], cell: Cell | None) -> list[JobResult]:
    """Return the result of each arm at its main setting in one cell."""
    found = [by_cell(results, main_setting(results, arm)) for arm in arms_of(results)]
    return [members[cell] for members in found if cell is not None and cell in members]


def candidate_pictures(result: JobResult) -> dict[int, Path]:
    """Return the pictures of the candidates callback: step and path."""
    return dict(step_pictures(result.folder / CANDIDATES))


def has_views(result: JobResult) -> bool:
    """Return whether the job left pictures of its asset."""
    return (result.folder / PREVIEW).is_file()


def views(result: JobResult) -> list[np.ndarray]:
    """Return the single pictures in the first line of ``preview.png``, which must exist."""
    sheet = read_png(result.folder / PREVIEW)
    size = dict(flatten(config(result))).get("exporter.preview.size")
    if type(size) is not int or not 0 < size <= min(sheet.shape[:2]):
        size = min(sheet.shape[:2])
    return [sheet[:size, left : left + size] for left in range(0, sheet.shape[1] - size + 1, size)]


def mask_of(picture: np.ndarray) -> np.ndarray:
    """Return the mask of the first view: pictures come in pairs of a view and its mask, all square."""
    size = picture.shape[0]
    return picture[:, size : 2 * size]


def _facts(result: JobResult) -> str:
    """Return the count and the quality of an asset, and how its job ended if that was early."""
    quality = next(iter(qualities([result])), None)
    facts = [f"{result.count:,.0f} Gaussians"]
    if quality is not None:
        facts.append(quality.written(result.numbers[quality.name]))
    if result.ended_early:
        facts.append(result.outcome.replace("_", " "))
    return "\n".join(facts)


def _draw(
    lines: Mapping[str, Sequence[ShownPicture]],
    results: Sequence[JobResult],
    cell: Cell,
) -> Figure:
    """Draw lines of pictures with their titles on the left, and the name of the cell above all."""
    columns = max(map(len, lines.values()))
    figure = new_figure(columns, len(lines), width=PICTURE_INCH * columns + 0.4, height=PICTURE_INCH * 1.25)
    panels = figure.subplots(len(lines), columns, squeeze=False)
    colors = {arm: look.color for arm, look in looks(result.arm for result in results).items()}
    for axes in panels.flat:
        hide_axes(axes)
    for i, (row, (name, tiles)) in enumerate(zip(panels, lines.items(), strict=True)):
        row[0].set_ylabel(name.replace("_", "\n"), fontsize=8.5, weight="bold", color=colors.get(name, SOFT))
        for axes, tile in zip(row, tiles, strict=False):
            if tile.image is not None:
                axes.imshow(tile.image, interpolation="antialiased")
            axes.set_xlabel(tile.caption, fontsize=7.5, color=SOFT, labelpad=2)
            if i == 0:
                color = colors.get(tile.title, INK)
                axes.set_title(tile.title, fontsize=8.5, weight="normal", loc="center", color=color)
    words = [cell["prompt"], level_title(cell[NOISE]), f"seed {cell['seed']}"]
    title = ", ".join(word for word in words if word)
    text = textwrap.fill(title, int(TITLE_CHARACTERS_PER_INCH * figure.get_figwidth()))
    figure.suptitle(text, fontsize=8.5, color=SOFT, x=0.01, ha="left")
    return figure


def _evenly(length: int, most: int) -> list[int]:
    """Return at most ``most`` indices below ``length``, evenly spread, the first and the last among them."""
    return sorted({round(i) for i in np.linspace(0, length - 1, min(length, most))})
