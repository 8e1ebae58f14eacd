"""Figures of a sweep that plot numbers; each function returns ``None`` if its figure would be empty.

There is one panel per noise level, and an arm has the same colour and marker everywhere.
"""

from collections.abc import Callable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from cadam3d.core.number import Number
from cadam3d.core.palette import INK
from cadam3d.io.records import counts, read_metrics
from cadam3d.report.charts import Point
from cadam3d.report.compare import (
    FrontierPoint,
    arms_without_growth,
    by_cell,
    frontier,
    gain_over,
    hull_of,
    main_setting,
    qualities,
    value_of,
)
from cadam3d.report.results import (
    ArmSetting,
    JobResult,
    arms_of,
    at_noise,
    level_title,
    levels_of,
    measured,
)
from cadam3d.report.style import Look, label_axis, looks, new_figure

# A dagger: some jobs of the setting ended before their last step.
EARLY = "\u2020"
LEGEND_WIDTH, LEGEND_LINE = 2.6, 0.19  # inches


def frontier_figure(results: Sequence[JobResult], quality: Number | None = None) -> Figure | None:
    """Draw quality over count, a panel per noise level: all settings, a curve per arm, quartiles as bars.

    ``quality`` is by default the number that assets are chosen by.
    """
    quality = quality or next(iter(qualities(results)), None)
    if quality is None or len({result.setting for result in measured(results)}) < 2:
        return None
    gains = all(arms_without_growth(at_noise(results, level)) for level in levels_of(results))

    def draw(axes: Axes, here: Sequence[JobResult]) -> None:
        axes.set_xscale("log")
        for arm in arms_of(here):
            if points := frontier(here, arm, gain_over(here if gains else (), value_of(quality))):
                _draw_frontier(axes, points, style[arm])
        axes.margins(x=0.1, y=0.14)

    style = looks(result.arm for result in results)
    title = f"{quality.heading}, gain over no growth" if gains else quality.heading
    figure = _panels(results, draw, "Gaussians at the end", title, 3.5)
    keys = {result.arm: [key for key, _ in result.setting.thresholds] for result in measured(results)}
    names = {arm: f"{arm}: {', '.join(found)}" if found else arm for arm, found in keys.items()}
    _add_legend(figure, names, style)
    return figure


def _panels(
    results: Sequence[JobResult],
    draw: Callable[[Axes, list[JobResult]], None],
    across: str,
    up: str,
    height: float,
) -> Figure:
    """Return a figure in which ``draw`` has filled a panel per noise level with the results of that level.

    It has room for a legend on the right.
    """
    levels = levels_of(results)
    width = min(1.6 + 3.4 * len(levels), 9.4) + LEGEND_WIDTH
    figure = new_figure(
        len(levels), width=width, height=max(height, LEGEND_LINE * len(arms_of(results)) + 0.6)
    )
    panels = figure.subplots(1, len(levels), squeeze=False, sharey=True)[0]
    for axes, level in zip(panels, levels, strict=True):
        draw(axes, at_noise(results, level))
        axes.set_title(level_title(level))
        axes.set_xlabel(across)
        label_axis(axes.xaxis)
    panels[0].set_ylabel(up)
    return figure


def _draw_frontier(axes: Axes, points: Sequence[FrontierPoint], look: Look) -> None:
    """Draw the settings of one arm, their quartiles and their curve.

    With one threshold the curve is a line through all settings, which are labelled with it; with more it is
    the hull of their medians.
    """
    places = [(point.count[1], point.gain[1]) for point in points]
    is_line = len(points[0].setting.thresholds) == 1
    curve = places if is_line else [(10**x, y) for x, y in hull_of(places)]
    axes.plot(*zip(*curve, strict=True), color=look.color, lw=1.6, zorder=3)
    for point, (x, y) in zip(points, places, strict=True):
        bar = {"color": look.color, "alpha": 0.35, "lw": 0.9, "zorder": 2}
        axes.plot(point.count[::2], (y, y), **bar)
        axes.plot((x, x), point.gain[::2], **bar)
        is_main = point.is_standard or len(points) == 1
        size, edge = (7.5, INK) if is_main else (4.5, look.color)
        axes.plot(x, y, marker=look.marker, ms=size, color=look.color, mec=edge, zorder=5)
        text = (point.setting.values if is_line else "") + EARLY * (point.early > 0)
        axes.annotate(text, (x, y), (4, 4), textcoords="offset points", color=look.color, fontsize=7.5)


def _add_legend(figure: Figure, names: dict[str, str], style: dict[str, Look]) -> None:
    """Write the names of arms beside a figure, with their colours and markers."""
    handles = [
        Line2D([], [], label=name, color=style[arm].color, marker=style[arm].marker)
        for arm, name in names.items()
    ]
    figure.legend(handles=handles, loc="outside right upper", frameon=False, fontsize=8)


def growth_figure(results: Sequence[JobResult]) -> Figure | None:
    """Draw the count over time of each arm at its main setting, a panel per noise level."""
    chosen = {arm: main_setting(results, arm) for arm in arms_of(results)}
    style = looks(result.arm for result in results)
    if not any(_histories(results, setting) for setting in chosen.values()):
        return None

    def draw(axes: Axes, here: Sequence[JobResult]) -> None:
        axes.set_yscale("log")
        for arm, setting in chosen.items():
            if found := _histories(here, setting):
                steps, low, middle, high = over_time(found)
                axes.fill_between(steps, low, high, step="post", color=style[arm].color, alpha=0.16, lw=0)
                axes.step(steps, middle, where="post", color=style[arm].color, lw=1.8)
                axes.plot(steps[-1], middle[-1], marker=style[arm].marker, color=style[arm].color)
        axes.set_xlim(left=0)

    figure = _panels(results, draw, "step", "Gaussians", 3.4)
    label_axis(figure.axes[0].yaxis)
    _add_legend(figure, {arm: setting.name for arm, setting in chosen.items()}, style)
    return figure


def _histories(results: Sequence[JobResult], setting: ArmSetting) -> list[list[Point]]:
    found: list[list[Point]] = [
        list(counts(read_metrics(result.folder))) for result in by_cell(results, setting).values()
    ]
    return [history for history in found if history]


def over_time(histories: Sequence[Sequence[Point]]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the steps and, of the counts there, the first quartile, the median and the third quartile.

    A job keeps its count between records and after its end. Of two records at one step, before and after a
    refinement, the later one counts.
    """
    steps = np.array(sorted({step for history in histories for step, _ in history}))
    values = []
    for history in histories:
        times, numbers = np.array(history).T
        at = np.searchsorted(times, steps, side="right") - 1
        values.append(numbers[at.clip(0)])
    low, middle, high = np.quantile(np.array(values), (0.25, 0.5, 0.75), axis=0)
    return steps, low, middle, high


def thresholds_figure(results: Sequence[JobResult]) -> Figure | None:
    """Draw the median count and quality of an arm over two of its thresholds (paper fig. 8)."""
    arm, quality = arm_of_two_thresholds(results), next(iter(qualities(results)), None)
    if arm is None or quality is None:
        return None
    levels = levels_of(results)
    figure = new_figure(len(levels), width=4.6 * len(levels), height=3.4)
    for axes, level in zip(figure.subplots(1, len(levels), squeeze=False)[0], levels, strict=True):
        if points := frontier(at_noise(results, level), arm, value_of(quality)):
            _draw_heat(axes, points, quality)
        axes.set_title(f"Gaussians and {quality.heading}, {level_title(level)}".removesuffix(", "))
    return figure


def arm_of_two_thresholds(results: Sequence[JobResult]) -> str | None:
    """Return the first arm in which two numeric thresholds vary."""
    for result in measured(results):
        if [type(value) for _, value in result.setting.thresholds] == [float, float]:
            return result.arm
    return None


def _draw_heat(axes: Axes, points: Sequence[FrontierPoint], quality: Number) -> None:
    """Draw the quality of each setting as a colour, and its count and quality as text."""
    names, places = zip(*(zip(*point.setting.thresholds, strict=True) for point in points), strict=True)
    across, down = (sorted(set(values)) for values in zip(*places, strict=True))
    table = np.full((len(down), len(across)), np.nan)
    for point, (x, y) in zip(points, places, strict=True):
        table[down.index(y), across.index(x)] = point.gain[1]
        text = f"{point.count[1]:,.0f}\n{point.gain[1]:.{quality.digits}f}"
        axes.text(
            across.index(x),
            down.index(y),
            text,
            ha="center",
            va="center",
            fontsize=8.5,
            weight="bold" if point.is_standard else "normal",
            color="#111111",
        )
    axes.imshow(table, cmap="summer", origin="lower", aspect="auto")
    axes.set_xticks(range(len(across)), [f"{each:g}" for each in across])
    axes.set_yticks(range(len(down)), [f"{each:g}" for each in down])
    axes.set_xlabel(names[0][0])
    axes.set_ylabel(names[0][1])
    axes.grid(visible=False)
