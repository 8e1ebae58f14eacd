"""Figures of a sweep that plot numbers; each function returns ``None`` if its figure would be empty.

There is one panel per noise level, and an arm has the same colour and marker everywhere.
"""

import math
from collections.abc import Callable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from cadam3d.core.number import Number
from cadam3d.core.palette import INK, PAPER
from cadam3d.io.records import read_metrics
from cadam3d.report.charts import Point, counts
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
LEGEND_COLUMNS = 4


def frontier_figure(results: Sequence[JobResult], quality: Number | None = None) -> Figure | None:
    """Draw quality over count, a panel per noise level: all settings, a curve per arm, quartiles as bars.

    ``quality`` is by default the number that assets are chosen by.
    """
    found = qualities(results)[:1] if quality is None else [quality]
    levels = levels_of(results)
    is_worth = any(len({each.setting for each in measured(at_noise(results, level))}) > 1 for level in levels)
    if not found or not is_worth:
        return None
    [quality] = found
    figure = new_figure(len(levels), height=3.5)
    panels = figure.subplots(1, len(levels), squeeze=False, sharey=True)[0]
    gains = all(arms_without_growth(at_noise(results, level)) for level in levels)
    style, drawn = looks(result.arm for result in results), set()
    for axes, level in zip(panels, levels, strict=True):
        here = at_noise(results, level)
        gain = gain_over(here if gains else (), value_of(quality))
        axes.set_xscale("log")
        for arm in arms_of(here):
            if points := frontier(here, arm, gain):
                _draw_frontier(axes, points, style[arm])
                drawn.add(arm)
        axes.set_title(level_title(level))
        axes.set_xlabel("Gaussians at the end")
        axes.margins(x=0.1, y=0.14)
        label_axis(axes.xaxis)
    if not drawn:
        return None
    panels[0].set_ylabel(f"{quality.heading}, gain over no growth" if gains else quality.heading)
    keys = {result.arm: [key for key, _ in result.setting.thresholds] for result in measured(results)}
    names = {arm: f"{arm}: {', '.join(keys[arm])}" if keys[arm] else arm for arm in style if arm in drawn}
    _add_legend(figure, names, style)
    return figure


def _draw_frontier(axes: Axes, points: Sequence[FrontierPoint], look: Look) -> None:
    """Draw the settings of one arm, their quartiles and their curve.

    With one threshold the curve is a line through all settings, which are labelled with it; with more it is
    the hull of their medians.
    """
    places = [(point.count.median, point.gain.median) for point in points]
    is_line = len(points[0].setting.thresholds) == 1
    curve = places if is_line else [(10**x, y) for x, y in hull_of(places)]
    axes.plot(*zip(*curve, strict=True), color=look.color, lw=1.6, zorder=3)
    pale = {"color": look.color, "alpha": 0.35, "lw": 0.9, "zorder": 2}
    for point, (x, y) in zip(points, places, strict=True):
        axes.plot([point.count.low, point.count.high], [y, y], **pale)
        axes.plot([x, x], [point.gain.low, point.gain.high], **pale)
        is_main = point.is_standard or len(points) == 1
        is_whole = point.cells == max(other.cells for other in points)
        axes.plot(
            x,
            y,
            marker=look.marker,
            ms=7.5 if is_main else 4.5,
            color=look.color,
            mfc=look.color if is_whole else PAPER,
            mec=INK if is_main and is_whole else look.color,
            mew=1.1 if is_main or not is_whole else 0.5,
            zorder=5 if is_main else 4,
        )
        text = (point.setting.values if is_line else "") + EARLY * (point.early > 0)
        axes.annotate(text, (x, y), (4, 4), textcoords="offset points", color=look.color, fontsize=7.5)


def _add_legend(figure: Figure, names: dict[str, str], style: dict[str, Look]) -> None:
    """Write the names of arms below a figure, with their colours and markers."""
    handles = [
        Line2D([], [], label=name, color=style[arm].color, marker=style[arm].marker)
        for arm, name in names.items()
    ]
    columns = min(len(handles), LEGEND_COLUMNS if len(figure.axes) > 1 else 2)
    figure.legend(handles=handles, loc="outside lower center", ncols=columns, frameon=False, fontsize=8)


def growth_figure(results: Sequence[JobResult]) -> Figure | None:
    """Draw the count over time of each arm at its main setting, a panel per noise level."""
    levels = levels_of(results)
    chosen = {arm: main_setting(results, arm) for arm in arms_of(results)}
    histories = {
        (level, arm): found
        for level in levels
        for arm, setting in chosen.items()
        if (found := _histories(at_noise(results, level), setting))
    }
    if not histories:
        return None
    figure, style = new_figure(len(levels), height=3.4), looks(result.arm for result in results)
    panels = figure.subplots(1, len(levels), squeeze=False, sharey=True)[0]
    for axes, level in zip(panels, levels, strict=True):
        axes.set_yscale("log")
        for arm in chosen:
            if found := histories.get((level, arm)):
                steps, low, middle, high = over_time(found)
                axes.fill_between(steps, low, high, step="post", color=style[arm].color, alpha=0.16, lw=0)
                axes.step(steps, middle, where="post", color=style[arm].color, lw=1.8)
                axes.plot(steps[-1], middle[-1], marker=style[arm].marker, color=style[arm].color)
        axes.set_title(level_title(level))
        axes.set_xlabel("step")
        axes.set_xlim(left=0)
        label_axis(axes.xaxis)
    label_axis(panels[0].yaxis)
    panels[0].set_ylabel("Gaussians")
    _add_legend(figure, {arm: setting.name for arm, setting in chosen.items()}, style)
    return figure


def _histories(results: Sequence[JobResult], setting: ArmSetting) -> list[list[Point]]:
    found = [counts(read_metrics(result.folder)) for result in by_cell(results, setting).values()]
    return [history for history in found if history]


def over_time(histories: Sequence[Sequence[Point]]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the steps and, of the counts there, the first quartile, the median and the third quartile.

    A job keeps its count between records and after its end. Of two records at one step, before and after a
    refinement, the later one counts.
    """
    steps = np.array(sorted({step for history in histories for step, _ in history}))
    values = []
    for history in histories:
        last = dict(history)
        at = np.searchsorted(np.array(sorted(last)), steps, side="right") - 1
        values.append(np.array([last[step] for step in sorted(last)])[at.clip(0)])
    low, middle, high = np.quantile(np.array(values), (0.25, 0.5, 0.75), axis=0)
    return steps, low, middle, high


def thresholds_figure(results: Sequence[JobResult]) -> Figure | None:
    """Draw the median count and quality of an arm over two of its thresholds (paper fig. 8)."""
    arm, quality = arm_of_two_thresholds(results), next(iter(qualities(results)), None)
    if arm is None or quality is None:
        return None
    points = {
        level: frontier(here, arm, gain_over(here, value_of(quality)))
        for level in levels_of(results)
        for here in [at_noise(results, level)]
    }
    points = {level: found for level, found in points.items() if len(found) > 2}
    if not points:
        return None
    is_gain = all(arms_without_growth(at_noise(results, level)) for level in points)
    title = f"{quality.label}, gain over no growth" if is_gain else quality.heading
    figure = new_figure(2, len(points), width=8.2, height=2.7)
    panels = figure.subplots(len(points), 2, squeeze=False)
    for (count, gain), (level, found) in zip(panels, points.items(), strict=True):
        count.set_title(", ".join(filter(None, ["Gaussians", level_title(level)])))
        _draw_heat(count, found, lambda point: math.log10(point.count.median), lambda x: f"{10**x:,.0f}")
        gain.set_title(", ".join(filter(None, [title, level_title(level)])))
        _draw_heat(gain, found, lambda point: point.gain.median, lambda x: f"{x:.{quality.digits}f}")
    return figure


def arm_of_two_thresholds(results: Sequence[JobResult]) -> str | None:
    """Return the arm with most settings among those in which two numeric thresholds vary."""
    settings: dict[str, set[ArmSetting]] = {}
    for result in measured(results):
        are_numbers = [isinstance(value, float) for _, value in result.setting.thresholds]
        if are_numbers == [True, True]:
            settings.setdefault(result.arm, set()).add(result.setting)
    return max(settings, key=lambda arm: len(settings[arm]), default=None)


def _draw_heat(
    axes: Axes,
    points: Sequence[FrontierPoint],
    value: Callable[[FrontierPoint], float],
    text: Callable[[float], str],
) -> None:
    """Draw a value of each setting as a colour and as text, over the two thresholds."""
    names = [name for name, _ in points[0].setting.thresholds]
    across, down = (sorted({dict(point.setting.thresholds)[name] for point in points}) for name in names)
    table = np.full((len(down), len(across)), np.nan)
    places = [[value for _, value in point.setting.thresholds] for point in points]
    for point, (x, y) in zip(points, places, strict=True):
        table[down.index(y), across.index(x)] = value(point)
    axes.imshow(table, cmap="viridis", origin="lower", aspect="auto", interpolation="nearest")
    middle = (np.nanmin(table) + np.nanmax(table)) / 2
    for point, (x, y) in zip(points, places, strict=True):
        found = value(point)
        axes.text(
            across.index(x),
            down.index(y),
            text(found),
            ha="center",
            va="center",
            color="#fefefe" if found < middle else "#111111",
            fontsize=8.5,
            weight="bold" if point.is_standard else "normal",
        )
    axes.set_xticks(range(len(across)), [f"{each:g}" for each in across])
    axes.set_yticks(range(len(down)), [f"{each:g}" for each in down])
    axes.set_xlabel(names[0])
    axes.set_ylabel(names[1])
    axes.grid(visible=False)
