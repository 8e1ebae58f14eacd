"""Figures of a sweep that show assets: lines and columns of pictures, each with its numbers underneath."""

import textwrap
from collections.abc import Callable, Hashable, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cadam3d.io.image import read_png, step_pictures
from cadam3d.io.run_folder import CANDIDATES, PREVIEW
from cadam3d.report.claims import by_cell, standard_setting
from cadam3d.report.figures import arm_of_two_thresholds
from cadam3d.report.palette import SOFT
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
PICTURE_INCH = 1.45
PREFERRED_NOISE = ("medium", "weak", "strong")  # the level to show, the first choice first


def masks_figure(results: Sequence[JobResult]) -> Figure | None:
    """Show the selected Gaussians over time: a line per arm, a column per refinement (paper fig. 6)."""
    shown = showcase([result for result in results if candidate_pictures(result)])
    if shown is None:
        return None
    members = [result for result in standard_results(results, shown) if candidate_pictures(result)]
    steps = sorted({step for result in members for step in candidate_pictures(result)})
    steps = [steps[i] for i in _evenly(len(steps), MAX_COLUMNS)]
    figure, panels = _grid(len(members), len(steps))
    style = looks(arms_of(results))
    for line, result in zip(panels, members, strict=True):
        found = candidate_pictures(result)
        chosen = {each.step: (sum(each.selected), sum(each.counts)) for each in histograms(result)}
        for axes, step in zip(line, steps, strict=True):
            if step in found:
                axes.imshow(mask_of(read_png(found[step])), interpolation="antialiased")
            if step in chosen:
                _caption(axes, "{:,} of {:,}".format(*chosen[step]))
        _line_title(line[0], result.arm, style[result.arm].color)
    for axes, step in zip(panels[0], steps, strict=True):
        axes.set_title(f"step {step}", fontsize=8.5, fontweight="normal", loc="center")
    _name_cell(figure, shown)
    return figure


def ablation_figure(results: Sequence[JobResult]) -> Figure | None:
    """Show one strip per arm in one cell: views of the asset, its count, quality and outcome (fig. 7)."""
    shown = showcase([result for result in results if has_views(result)])
    if shown is None:
        return None
    members = [result for result in standard_results(results, shown) if has_views(result)]
    if len(members) < 2:
        return None
    strips = {result.folder: views(result)[:MAX_VIEWS] for result in members}
    columns = max(len(strip) for strip in strips.values())
    figure, panels = _grid(len(members), columns, more_width=1.9)
    style = looks(arms_of(results))
    for line, result in zip(panels, members, strict=True):
        for axes, picture in zip(line, strips[result.folder], strict=False):
            axes.imshow(picture, interpolation="antialiased")
        _line_title(line[0], result.arm, style[result.arm].color)
        line[-1].annotate(
            f"{result.count:,.0f} Gaussians\n{result.psnr:.2f} dB\n{result.outcome.replace('_', ' ')}",
            (1.06, 0.5),
            xycoords="axes fraction",
            va="center",
            fontsize=8.5,
            annotation_clip=False,
        )
    _name_cell(figure, shown)
    return figure


def objectives_figure(results: Sequence[JobResult]) -> Figure | None:
    """Show one cell with a line per objective and a column per arm (paper fig. 4)."""
    style, axis = looks(arms_of(results)), objective_axis(results)
    results = [result for result in measured(results) if result.cell[axis]]
    objectives = sorted({result.cell[axis] for result in results})
    shown = showcase([result for result in results if has_views(result)])
    if len(objectives) < 2 or shown is None:
        return None
    cells = {result.cell for result in results if result.cell.without(axis) == shown.without(axis)}
    arms = [arm for arm in arms_of(results) if standard_setting(results, arm) is not None][:MAX_COLUMNS]
    figure, panels = _grid(len(objectives), len(arms), inch=1.9)
    for line, objective in zip(panels, objectives, strict=True):
        cell = next((each for each in cells if each[axis] == objective), None)
        members = {result.arm: result for result in standard_results(results, cell)} if cell else {}
        for axes, arm in zip(line, arms, strict=True):
            if (result := members.get(arm)) and has_views(result):
                axes.imshow(views(result)[0], interpolation="antialiased")
                _caption(axes, f"{result.count:,.0f}, {result.psnr:.2f} dB")
        _line_title(line[0], objective if axis == RECIPE else objective.upper())
    for axes, arm in zip(panels[0], arms, strict=True):
        axes.set_title(arm, color=style[arm].color, fontsize=9, loc="center")
    _name_cell(figure, shown.without(axis))
    return figure


def regimes_figure(results: Sequence[JobResult]) -> Figure | None:
    """Show the assets of the strictest, standard and loosest thresholds in one cell (paper fig. 8)."""
    arm = arm_of_two_thresholds(results)
    if arm is None:
        return None
    results = [result for result in measured(results) if result.arm == arm and has_views(result)]
    shown = showcase(results, kind=lambda result: result.setting)
    if shown is None:
        return None
    here = sorted(
        (result for result in results if result.cell == shown), key=lambda result: result.count or 0
    )
    middle = next((result for result in here if result.is_standard), here[len(here) // 2])
    chosen = {"fewest": here[0], "standard" if middle.is_standard else "between": middle, "most": here[-1]}
    if len({result.folder for result in chosen.values()}) < len(chosen):
        return None
    figure, panels = _grid(1, len(chosen), inch=2.1)
    for axes, (name, result) in zip(panels[0], chosen.items(), strict=True):
        axes.imshow(views(result)[0], interpolation="antialiased")
        axes.set_title(f"{name}: {result.setting.short}", fontsize=8.5, fontweight="normal", loc="center")
        _caption(axes, f"{result.count:,.0f}, {result.psnr:.2f} dB")
    _name_cell(figure, shown)
    return figure


def showcase(
    results: Sequence[JobResult], kind: Callable[[JobResult], Hashable] = lambda result: result.arm
) -> Cell | None:
    """Return the cell to show: one with most arms (or kinds), preferably at medium noise; ties by name."""
    cells: dict[Cell, set[Hashable]] = {}
    for result in measured(results):
        cells.setdefault(result.cell, set()).add(kind(result))
    preference = {level: i for i, level in enumerate(PREFERRED_NOISE)}
    worst = len(preference)
    return min(cells, key=lambda c: (-len(cells[c]), preference.get(c[NOISE], worst), c), default=None)


def standard_results(results: Sequence[JobResult], cell: Cell) -> list[JobResult]:
    """Return the result of each arm at its standard setting in one cell."""
    found = []
    for arm in arms_of(results):
        setting = standard_setting(results, arm)
        if setting is not None and (result := by_cell(results, setting).get(cell)) is not None:
            found.append(result)
    return found


def candidate_pictures(result: JobResult) -> dict[int, Path]:
    """Return the pictures of the candidates callback: step and path."""
    return dict(step_pictures(result.folder / CANDIDATES))


def has_views(result: JobResult) -> bool:
    """Return whether the job left pictures of its asset."""
    return (result.folder / PREVIEW).is_file()


def views(result: JobResult) -> list[np.ndarray]:
    """Return the single pictures in the first line of ``preview.png``, which must exist."""
    sheet = read_png(result.folder / PREVIEW)
    settings = dict(flatten(config(result)))
    size = settings.get("exporter.preview.size")
    if type(size) is not int or not 0 < size <= min(sheet.shape[:2]):
        size = min(sheet.shape[:2])
    return [sheet[:size, left : left + size] for left in range(0, sheet.shape[1] - size + 1, size)]


def mask_of(picture: np.ndarray) -> np.ndarray:
    """Return the mask of the first view: pictures come in pairs of a view and its mask, all square."""
    size = picture.shape[0]
    return picture[:, size : 2 * size]


def _grid(lines: int, columns: int, *, inch: float = PICTURE_INCH, more_width: float = 0.4):
    figure = new_figure(columns, lines, width=inch * columns + more_width, height=inch * 1.14)
    panels = figure.subplots(lines, columns, squeeze=False)
    for axes in panels.flat:
        hide_axes(axes)
    return figure, panels


def _caption(axes: Axes, text: str) -> None:
    axes.set_xlabel(text, fontsize=7.5, color=SOFT, labelpad=2)


def _line_title(axes: Axes, text: str, color: str = SOFT) -> None:
    axes.set_ylabel(text.replace("_", "\n"), fontsize=8.5, fontweight="bold", color=color)


def _name_cell(figure: Figure, cell: Cell) -> None:
    """Write prompt, noise and seed of a cell above a figure, in as many lines as its width needs."""
    words = [cell["prompt"], level_title(cell[NOISE]), f"seed {cell['seed']}"]
    title = ", ".join(word for word in words if word)
    lines = textwrap.fill(title, int(TITLE_CHARACTERS_PER_INCH * figure.get_figwidth()))
    figure.suptitle(lines, fontsize=8.5, color=SOFT, x=0.01, ha="left")


def _evenly(length: int, most: int) -> list[int]:
    """Return at most ``most`` indices below ``length``, evenly spread, the first and the last among them."""
    return sorted({round(i) for i in np.linspace(0, length - 1, min(length, most))})
