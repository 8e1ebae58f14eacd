"""Figures of a sweep that show assets: rows and columns of pictures, each with its numbers underneath."""

from collections.abc import Callable, Hashable, Sequence

import imageio.v3 as imageio
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cadam3d.report.claims import by_cell, standard
from cadam3d.report.figures import arm_of_two_thresholds, arms_of, level_title
from cadam3d.report.rows import GUIDANCE, NOISE, Cell, Row, config, histograms, measured
from cadam3d.report.style import SOFT, looks, new_figure, pictures_only

PREVIEW = "preview.png"
MAX_COLUMNS = 7  # pictures beside one another
MAX_VIEWS = 4  # of an asset, in a strip
PICTURE_INCH = 1.45
EXPECTED_NOISE = ("medium", "weak", "strong")  # the level to show, in this order of preference


def masks_figure(rows: Sequence[Row]) -> Figure | None:
    """Whom each arm chose over time: rows are arms, columns refinements (paper fig. 6)."""
    shown = showcase([row for row in rows if candidate_pictures(row)])
    if shown is None:
        return None
    members = [row for row in standard_rows(rows, shown) if candidate_pictures(row)]
    steps = sorted({step for row in members for step in candidate_pictures(row)})
    steps = [steps[i] for i in _evenly(len(steps), MAX_COLUMNS)]
    figure, panels = _grid(len(members), len(steps))
    style = looks(arms_of(rows))
    for line, row in zip(panels, members, strict=True):
        found = candidate_pictures(row)
        chosen = {each.step: (sum(each.selected), sum(each.counts)) for each in histograms(row)}
        for axes, step in zip(line, steps, strict=True):
            if step in found:
                axes.imshow(mask_of(imageio.imread(found[step])), interpolation="antialiased")
            if step in chosen:
                _caption(axes, "{:,} of {:,}".format(*chosen[step]))
        _row_title(line[0], row.arm, style[row.arm].color)
    for axes, step in zip(panels[0], steps, strict=True):
        axes.set_title(f"step {step}", fontsize=8.5, fontweight="normal", loc="center")
    _say_cell(figure, shown)
    return figure


def ablation_figure(rows: Sequence[Row]) -> Figure | None:
    """One strip per arm in one cell: the asset from some sides, its count, quality and outcome (fig. 7)."""
    shown = showcase([row for row in rows if has_views(row)])
    if shown is None:
        return None
    members = [row for row in standard_rows(rows, shown) if has_views(row)]
    if len(members) < 2:
        return None
    strips = {row.folder: views(row)[:MAX_VIEWS] for row in members}
    columns = max(len(strip) for strip in strips.values())
    figure, panels = _grid(len(members), columns, more_width=1.9)
    style = looks(arms_of(rows))
    for line, row in zip(panels, members, strict=True):
        for axes, picture in zip(line, strips[row.folder], strict=False):
            axes.imshow(picture, interpolation="antialiased")
        _row_title(line[0], row.arm, style[row.arm].color)
        line[-1].annotate(
            f"{row.count:,.0f} Gaussians\n{row.psnr:.2f} dB\n{row.outcome.replace('_', ' ')}",
            (1.06, 0.5),
            xycoords="axes fraction",
            va="center",
            fontsize=8.5,
            annotation_clip=False,
        )
    _say_cell(figure, shown)
    return figure


def objectives_figure(rows: Sequence[Row]) -> Figure | None:
    """Rows are objectives, columns arms, in one cell (paper fig. 4)."""
    style = looks(arms_of(rows))
    rows = [row for row in measured(rows) if row.cell[GUIDANCE]]
    objectives = sorted({row.cell[GUIDANCE] for row in rows})
    shown = showcase([row for row in rows if has_views(row)])
    if len(objectives) < 2 or shown is None:
        return None
    cells = {row.cell for row in rows if row.cell.without(GUIDANCE) == shown.without(GUIDANCE)}
    arms = [arm for arm in arms_of(rows) if standard(rows, arm) is not None][:MAX_COLUMNS]
    figure, panels = _grid(len(objectives), len(arms), inch=1.9)
    for line, objective in zip(panels, objectives, strict=True):
        cell = next((each for each in cells if each[GUIDANCE] == objective), None)
        members = {row.arm: row for row in standard_rows(rows, cell)} if cell else {}
        for axes, arm in zip(line, arms, strict=True):
            if (row := members.get(arm)) and has_views(row):
                axes.imshow(views(row)[0], interpolation="antialiased")
                _caption(axes, f"{row.count:,.0f}, {row.psnr:.2f} dB")
        _row_title(line[0], objective.upper())
    for axes, arm in zip(panels[0], arms, strict=True):
        axes.set_title(arm, color=style[arm].color, fontsize=9, loc="center")
    _say_cell(figure, shown.without(GUIDANCE))
    return figure


def regimes_figure(rows: Sequence[Row]) -> Figure | None:
    """The assets of the strictest, the standard and the loosest thresholds in one cell (paper fig. 8)."""
    arm = arm_of_two_thresholds(rows)
    if arm is None:
        return None
    rows = [row for row in measured(rows) if row.arm == arm and has_views(row)]
    shown = showcase(rows, kind=lambda row: row.setting)
    if shown is None:
        return None
    here = sorted((row for row in rows if row.cell == shown), key=lambda row: row.count or 0)
    middle = next((row for row in here if row.is_standard), here[len(here) // 2])
    chosen = {"fewest": here[0], "standard" if middle.is_standard else "between": middle, "most": here[-1]}
    if len({row.folder for row in chosen.values()}) < len(chosen):
        return None
    figure, panels = _grid(1, len(chosen), inch=2.1)
    for axes, (name, row) in zip(panels[0], chosen.items(), strict=True):
        axes.imshow(views(row)[0], interpolation="antialiased")
        axes.set_title(f"{name}: {row.setting.short}", fontsize=8.5, fontweight="normal", loc="center")
        _caption(axes, f"{row.count:,.0f}, {row.psnr:.2f} dB")
    _say_cell(figure, shown)
    return figure


def showcase(rows: Sequence[Row], kind: Callable[[Row], Hashable] = lambda row: row.arm) -> Cell | None:
    """The cell to show: the one with most arms (or kinds), medium noise before weak, then the first."""
    cells: dict[Cell, set[Hashable]] = {}
    for row in measured(rows):
        cells.setdefault(row.cell, set()).add(kind(row))
    preference = {level: i for i, level in enumerate(EXPECTED_NOISE)}
    worst = len(preference)
    return min(cells, key=lambda c: (-len(cells[c]), preference.get(c[NOISE], worst), c), default=None)


def standard_rows(rows: Sequence[Row], cell: Cell) -> list[Row]:
    """The row of each arm's standard setting in one cell."""
    found = []
    for arm in arms_of(rows):
        setting = standard(rows, arm)
        if setting is not None and (row := by_cell(rows, setting).get(cell)) is not None:
            found.append(row)
    return found


def candidate_pictures(row: Row) -> dict[int, str]:
    """Step and path of what the candidates callback drew."""
    found = sorted((row.folder / "candidates").glob("step_*.png"))
    return {int(path.stem.removeprefix("step_")): str(path) for path in found}


def has_views(row: Row) -> bool:
    """Whether the job left pictures of its asset."""
    return (row.folder / PREVIEW).is_file()


def views(row: Row) -> list[np.ndarray]:
    """The single pictures of the first row of ``preview.png``, which must be there."""
    sheet = imageio.imread(row.folder / PREVIEW)[..., :3]
    preview = (config(row).get("exporter") or {}).get("preview") or {}
    size = int(preview.get("size") or sheet.shape[0])
    return [sheet[:size, left : left + size] for left in range(0, sheet.shape[1] - size + 1, size)]


def mask_of(picture: np.ndarray) -> np.ndarray:
    """The mask of the first view: pictures come in pairs of a look and a mask, all square."""
    size = picture.shape[0]
    return picture[:, size : 2 * size]


def _grid(rows: int, columns: int, *, inch: float = PICTURE_INCH, more_width: float = 0.4):
    figure = new_figure(columns, rows, width=inch * columns + more_width, height=inch * 1.14)
    panels = figure.subplots(rows, columns, squeeze=False)
    for axes in panels.flat:
        pictures_only(axes)
    return figure, panels


def _caption(axes: Axes, text: str) -> None:
    axes.set_xlabel(text, fontsize=7.5, color=SOFT, labelpad=2)


def _row_title(axes: Axes, text: str, color: str = SOFT) -> None:
    axes.set_ylabel(text.replace("_", "\n"), fontsize=8.5, fontweight="bold", color=color)


def _say_cell(figure: Figure, cell: Cell) -> None:
    words = [cell["prompt"], level_title(cell[NOISE]), f"seed {cell['seed']}"]
    figure.suptitle(", ".join(word for word in words if word), fontsize=8.5, color=SOFT, x=0.01, ha="left")


def _evenly(length: int, most: int) -> list[int]:
    """At most ``most`` indices of so many things, first and last among them."""
    return sorted({round(i) for i in np.linspace(0, length - 1, min(length, most))})
