"""Figures of a sweep that plot numbers; each function returns ``None`` if its figure would be empty.

There is one panel per noise level. The names of arms are next to their curves, and an arm has the same colour
everywhere.
"""

import math
from collections.abc import Callable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cadam3d.report.claims import (
    PSNR,
    SSIM,
    Compared,
    FrontierPoint,
    Hull,
    Spread,
    by_cell,
    frontier,
    has_no_growth,
    standard_setting,
)
from cadam3d.report.labels import Label, place_labels
from cadam3d.report.palette import INK, PAPER, SOFT
from cadam3d.report.results import (
    NO_NOISE,
    ArmSetting,
    JobResult,
    arms_of,
    at_noise,
    counts,
    level_title,
    levels_of,
    measured,
)
from cadam3d.report.style import (
    Look,
    label_log_axis,
    label_ticks,
    looks,
    new_figure,
    round_ticks,
    spread_labels,
)

# A dagger: some jobs of the setting ended before their last step.
EARLY = "\u2020"
ROOM = 0.07  # between labels, as a share of the axis


def frontier_ssim_figure(results: Sequence[JobResult]) -> Figure | None:
    """Draw :func:`frontier_figure` of SSIM, which measures structure rather than brightness."""
    return frontier_figure(results, SSIM)


def frontier_figure(results: Sequence[JobResult], quality: Compared = PSNR) -> Figure | None:
    """Draw quality over count, a panel per noise level: all settings, a curve per arm, spreads as bars."""
    style = looks(arms_of(results))
    results = [result for result in results if quality.of(result) is not None]
    levels, arms = levels_of(results), arms_of(results)
    if not any(
        len({result.setting for result in measured(at_noise(results, level))}) > 1 for level in levels
    ):
        return None
    figure = new_figure(len(levels), height=3.5)
    panels = figure.subplots(1, len(levels), squeeze=False, sharey=True)[0]
    gains = all(has_no_growth(at_noise(results, level)) for level in levels)
    labels: dict[str, list[Label]] = {}
    for axes, level in zip(panels, levels, strict=True):
        here = at_noise(results, level)
        axes.set_xscale("log")
        curves = {arm: frontier(here, arm, here if gains else (), quality) for arm in arms}
        found = [_frontier_curve(axes, curve, style[arm]) for arm, curve in curves.items() if curve]
        # The names of the arms come first and get the best places.
        labels[level] = sorted(
            (label for each in found for label in each), key=lambda label: not label.is_name
        )
        axes.set_title(level_title(level))
        axes.set_xlabel("Gaussians at the end")
        label_log_axis(axes.xaxis, room=1.25)
        axes.margins(y=0.14)
    low, high = panels[0].get_ylim()
    panels[0].set_ylim(low - 0.06 * (high - low), high + 0.1 * (high - low))
    for axes, level in zip(panels, levels, strict=True):
        reference = at_noise(results, level) if gains else ()
        labels[level] += _upper_curve(axes, results, level, reference, quality)
    panels[0].set_ylabel(quality.gain if gains else quality.axis)
    keys = {
        result.arm: ", ".join(key for key, _ in result.setting.thresholds) for result in measured(results)
    }
    legend = [f"{arm}: {keys[arm]}" for arm in arms if keys[arm]]
    panels[0].set_xlabel("\n".join([panels[0].get_xlabel(), *legend]))
    for axes, level in zip(panels, levels, strict=True):
        # The names of the arms come first and get the best places.
        place_labels(axes, sorted(labels[level], key=lambda label: not label.is_name))
    return figure


def _frontier_curve(axes: Axes, points: Sequence[FrontierPoint], look: Look) -> list[Label]:
    """Draw one arm and return its labels: its name, and the thresholds of its settings.

    With one threshold the curve is a line through all settings; with more it is the hull of their results.
    """
    places = [(point.count.median, point.gain.median) for point in points]
    is_line = len(points[0].setting.thresholds) == 1
    curve = places if is_line else [(10**x, y) for x, y in Hull(places).corners]
    if len(points) > 1:
        axes.plot(*zip(*curve, strict=True), color=look.color, lw=1.6, zorder=3)
    for point, place in zip(points, places, strict=True):
        _bars(axes, point, look)
        is_main = point.is_standard or len(points) == 1
        is_whole = point.cells == max(other.cells for other in points)
        axes.plot(
            *place,
            marker=look.marker,
            ms=7.5 if is_main else 4.5,
            color=look.color,
            mfc=look.color if is_whole else PAPER,
            mec=INK if is_main and is_whole else look.color,
            mew=1.1 if is_main or not is_whole else 0.5,
            zorder=5 if is_main else 4,
        )
    named = next((at for point, at in zip(points, places, strict=True) if point.is_standard), places[-1])
    pairs = list(zip(points, places, strict=True))
    # A curve of several thresholds has too many settings to label each, so only its ends are labelled.
    shown = pairs if is_line else [pairs[0], pairs[-1]] if len(pairs) > 1 else []
    values = [
        Label(point.setting.values + EARLY * (point.early > 0), place, look.color) for point, place in shown
    ]
    return [Label(points[0].setting.arm, named, look.color, is_name=True), *values]


def _bars(axes: Axes, point: FrontierPoint, look: Look) -> None:
    """Draw the spread over cells as thin pale bars and the standard deviation over seeds as thick ones."""
    x, y = point.count.median, point.gain.median
    pale = {"color": look.color, "alpha": 0.35, "lw": 0.9, "zorder": 2}
    axes.plot([point.count.low, point.count.high], [y, y], **pale)
    axes.plot([x, x], [point.gain.low, point.gain.high], **pale)
    thick = {"color": look.color, "alpha": 0.9, "lw": 2.2, "solid_capstyle": "butt", "zorder": 3}
    if point.gain_over_seeds is not None:
        axes.plot([x, x], [y - point.gain_over_seeds, y + point.gain_over_seeds], **thick)
    if point.count_over_seeds is not None:
        factor = 10**point.count_over_seeds
        axes.plot([x / factor, x * factor], [y, y], **thick)


def _upper_curve(
    axes: Axes, results: Sequence[JobResult], level: str, reference: Sequence[JobResult], quality: Compared
) -> list[Label]:
    """Draw what any arm reaches with the same seeds without noise: how much growth could help at all.

    Return the label of the curve, if there is one.
    """
    clean = next((each for each in levels_of(results) if each == NO_NOISE), None)
    if clean is None or clean == level:
        return []
    there = at_noise(results, clean)
    points = [point for arm in arms_of(there) for point in frontier(there, arm, reference, quality)]
    if len(points) < 2:
        return []
    corners = Hull((point.count.median, point.gain.median) for point in points).corners
    x, y = [10**a for a, _ in corners], [b for _, b in corners]
    bottom, top = axes.get_ylim()
    line = {"color": SOFT, "lw": 1.1, "ls": (0, (4, 3)), "zorder": 1}
    if min(y) < top:
        axes.plot(x, y, scaley=False, **line)
    ends = [f"{value:.{quality.digits - 1}f}" for value in (y[0], y[-1])]
    text = "without noise" if y[-1] < top else f"without noise: {' to '.join(ends)} {quality.unit}".strip()
    return [Label(text, (min(x[-1], axes.get_xlim()[1]), min(y[-1], bottom + 0.92 * (top - bottom))))]


def growth_figure(results: Sequence[JobResult]) -> Figure | None:
    """Draw the count over time of each arm at its standard setting, a panel per noise level."""
    levels, arms = levels_of(results), arms_of(results)
    chosen = {arm: setting for arm in arms if (setting := standard_setting(results, arm)) is not None}
    histories = {
        (level, arm): paths
        for level in levels
        for arm, setting in chosen.items()
        if (paths := _histories(at_noise(results, level), setting))
    }
    if not histories:
        return None
    figure, style = new_figure(len(levels), height=3.2), looks(arms)
    panels = figure.subplots(1, len(levels), squeeze=False, sharey=True)[0]
    ends = Spread.of({result.cell: 0.0 for result in results}).ends
    for axes, level in zip(panels, levels, strict=True):
        axes.set_yscale("log")
        places = {}
        for arm in chosen:
            if paths := histories.get((level, arm)):
                steps, low, middle, high = over_time(paths, ends)
                axes.fill_between(steps, low, high, step="post", color=style[arm].color, alpha=0.16, lw=0)
                axes.step(steps, middle, where="post", color=style[arm].color, lw=1.8)
                places[arm] = (steps[-1], middle[-1])
        _label_ends(axes, places, style)
        axes.set_title(level_title(level))
        axes.set_xlabel("step")
    label_log_axis(panels[0].yaxis)
    panels[0].set_ylabel("Gaussians")
    return figure


def _histories(results: Sequence[JobResult], setting: ArmSetting) -> list[list[tuple[float, float]]]:
    found = [counts(result) for result in by_cell(results, setting).values()]
    return [history for history in found if history]


def over_time(
    histories: Sequence[Sequence[tuple[float, float]]], ends: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the steps and, of the counts there, the low end, the median and the high end.

    ``ends`` are the probabilities of the quantiles at the two ends.

    A job keeps its count between records and after its end. Of two records at one step, before and after a
    refinement, the later one counts.
    """
    steps = np.array(sorted({step for history in histories for step, _ in history}))
    values = []
    for history in histories:
        last = dict(history)
        at = np.searchsorted(np.array(sorted(last)), steps, side="right") - 1
        ordered = np.array([last[step] for step in sorted(last)])
        values.append(ordered[at.clip(0)])
    low, middle, high = np.quantile(np.array(values), (ends[0], 0.5, ends[1]), axis=0)
    return steps, low, middle, high


def _label_ends(axes: Axes, ends: dict[str, tuple[float, float]], style: dict[str, Look]) -> None:
    if not ends:
        return
    axes.autoscale_view()
    low, high = (math.log10(limit) for limit in axes.get_ylim())
    heights = spread_labels({arm: math.log10(y) for arm, (_, y) in ends.items()}, ROOM * (high - low))
    right = max(x for x, _ in ends.values())
    axes.set_xlim(0, right * 1.28)
    label_ticks(axes.xaxis, round_ticks(0, right))
    for arm, height in heights.items():
        axes.text(
            right * 1.02, 10**height, arm, color=style[arm].color, va="center", fontsize=8, weight="bold"
        )


def thresholds_figure(results: Sequence[JobResult]) -> Figure | None:
    """Draw the median count and quality of an arm over two of its thresholds (paper fig. 8)."""
    found = _two_thresholds(results)
    if found is None:
        return None
    arm, (across, down) = found
    levels = [level for level in levels_of(results) if len(frontier(at_noise(results, level), arm)) > 2]
    if not levels:
        return None
    figure = new_figure(2, len(levels), width=8.2, height=2.7)
    panels = figure.subplots(len(levels), 2, squeeze=False)
    for pair, level in zip(panels, levels, strict=True):
        here = at_noise(results, level)
        points = frontier(here, arm)
        quality = PSNR.gain if has_no_growth(here) else PSNR.axis
        kinds: tuple[tuple[str, Callable[[FrontierPoint], float], Callable[[float], str]], ...] = (
            (
                "Gaussians",
                lambda point: math.log10(point.count.median),
                lambda value: f"{10**value:,.0f}",
            ),
            (quality, lambda point: point.gain.median, lambda value: f"{value:.2f}"),
        )
        for axes, (title, value, text) in zip(pair, kinds, strict=True):
            _heat(axes, points, (across, down), value, text)
            axes.set_title(", ".join(part for part in (title, level_title(level)) if part))
            axes.set_xlabel(across)
            axes.set_ylabel(down)
    return figure


def arm_of_two_thresholds(results: Sequence[JobResult]) -> str | None:
    """Return the arm with most settings among those in which two thresholds vary."""
    found = _two_thresholds(results)
    return found[0] if found else None


def _two_thresholds(results: Sequence[JobResult]) -> tuple[str, tuple[str, str]] | None:
    """Return the arm with most settings among those in which two thresholds vary, and their names."""
    best: dict[str, set[ArmSetting]] = {}
    for result in measured(results):
        numeric = [key for key, value in result.setting.thresholds if isinstance(value, float)]
        if len(numeric) == len(result.setting.thresholds) == 2:
            best.setdefault(result.arm, set()).add(result.setting)
    if not best:
        return None
    arm = max(sorted(best), key=lambda each: len(best[each]))
    first, second = (key for key, _ in next(iter(best[arm])).thresholds)
    return arm, (first, second)


def _heat(
    axes: Axes,
    points: Sequence[FrontierPoint],
    keys: tuple[str, str],
    value: Callable[[FrontierPoint], float],
    text: Callable[[float], str],
) -> None:
    across, down = (sorted({dict(point.setting.thresholds)[key] for point in points}) for key in keys)
    table = np.full((len(down), len(across)), np.nan)
    for point in points:
        thresholds = dict(point.setting.thresholds)
        table[down.index(thresholds[keys[1]]), across.index(thresholds[keys[0]])] = value(point)
    axes.imshow(table, cmap="viridis", origin="lower", aspect="auto", interpolation="nearest")
    middle = (np.nanmin(table) + np.nanmax(table)) / 2
    for point in points:
        thresholds = dict(point.setting.thresholds)
        x, y = across.index(thresholds[keys[0]]), down.index(thresholds[keys[1]])
        color = "#fefefe" if table[y, x] < middle else "#111111"
        weight = "bold" if point.is_standard else "normal"
        axes.text(x, y, text(table[y, x]), ha="center", va="center", color=color, fontsize=8.5, weight=weight)
    axes.set_xticks(range(len(across)), [f"{each:g}" for each in across])
    axes.set_yticks(range(len(down)), [f"{each:g}" for each in down])
    axes.grid(visible=False)
