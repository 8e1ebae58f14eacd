"""Figures of a sweep that plot numbers. Each is a function of its rows; ``None``: there is nothing to show.

Small multiples run over noise levels, arms are named beside their curves, and colours belong to arms.
"""

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Annotation
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator
from matplotlib.transforms import Bbox, BboxBase

from cadam3d.report.claims import (
    PSNR,
    SSIM,
    FrontierPoint,
    Hull,
    Quality,
    by_cell,
    frontier,
    has_no_growth,
    standard,
)
from cadam3d.report.plot import log_ticks, short
from cadam3d.report.rows import (
    NO_NOISE,
    NOISE,
    Row,
    Setting,
    at_noise,
    config,
    counts,
    histograms,
    in_noise_order,
    measured,
)
from cadam3d.report.style import INK, PAPER, SOFT, Look, looks, new_figure, spread_labels

MAX_HEAT_COLUMNS = 3  # heat maps beside one another, where there are not more noise levels
EARLY = "\u2020"  # a dagger: some of its jobs ended before their last step
ROOM = 0.07  # between labels, in shares of the axis
MARK = 6.0  # half the side of the square that a mark takes, in pixels
SPOTS = (  # where the name of an arm may stand, the best first: alignment, and offset in points
    ("center", 0, 8),
    ("center", 0, -16),
    *((ha, x, y) for y in (8, -16, 19, -27, 30, -38) for ha, x in (("left", -6), ("right", 6))),
    ("left", 9, -3),
    ("right", -9, -3),
)


def arms_of(rows: Sequence[Row]) -> list[str]:
    """The arms that left something to measure: the one without growth first, then by name."""
    found = {row.arm for row in measured(rows)}
    return sorted(found, key=lambda arm: (arm != "none", arm != "baseline", arm))


def levels_of(rows: Sequence[Row]) -> list[str]:
    """The noise levels at which something was measured."""
    return in_noise_order(row.cell[NOISE] for row in measured(rows))


def level_title(level: str) -> str:
    """How a panel is headed; empty where a sweep knows one level only."""
    if level in NO_NOISE:
        return "no noise"
    return f"{level} noise" if level else ""


def frontier_ssim_figure(rows: Sequence[Row]) -> Figure | None:
    """:func:`frontier_figure` of SSIM, which sees structure where PSNR sees brightness."""
    return frontier_figure(rows, SSIM)


def frontier_figure(rows: Sequence[Row], quality: Quality = PSNR) -> Figure | None:
    """Quality over count, a panel per noise level: every setting, each arm's curve, spreads as bars."""
    style = looks(arms_of(rows))
    rows = [row for row in rows if quality.of(row) is not None]
    levels, arms = levels_of(rows), arms_of(rows)
    if not any(len({row.setting for row in measured(at_noise(rows, level))}) > 1 for level in levels):
        return None
    figure = new_figure(len(levels), height=3.5)
    panels = figure.subplots(1, len(levels), squeeze=False, sharey=True)[0]
    gains = all(has_no_growth(at_noise(rows, level)) for level in levels)
    named: dict[str, dict[str, tuple[float, float]]] = {}
    for axes, level in zip(panels, levels, strict=True):
        here = at_noise(rows, level)
        axes.set_xscale("log")
        named[level] = {
            arm: _frontier_curve(axes, points, style[arm])
            for arm in arms
            if (points := frontier(here, arm, here if gains else (), quality))
        }
        axes.set_title(level_title(level))
        axes.set_xlabel("Gaussians at the end")
        _plain_log(axes.xaxis, room=1.25)
        axes.margins(y=0.14)
    low, high = panels[0].get_ylim()
    panels[0].set_ylim(low - 0.06 * (high - low), high + 0.1 * (high - low))
    for axes, level in zip(panels, levels, strict=True):
        _upper_curve(axes, rows, level, at_noise(rows, level) if gains else (), quality)
    panels[0].set_ylabel(quality.gain if gains else quality.axis)
    keys = {row.arm: ", ".join(key for key, _ in row.setting.thresholds) for row in measured(rows)}
    legend = [f"{arm}: {keys[arm]}" for arm in arms if keys[arm]]
    panels[0].text(
        0.98, 0.03, "\n".join(legend), transform=panels[0].transAxes, ha="right", fontsize=7, color=SOFT
    )
    for axes, level in zip(panels, levels, strict=True):
        _name_arms(axes, named[level], style)
    return figure


def _frontier_curve(axes: Axes, points: Sequence[FrontierPoint], look: Look) -> tuple[float, float]:
    """One arm: with one threshold a line through all settings, with more the hull of what they reach.

    Returns the place of the setting that its name belongs to.
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
        if is_line:
            _annotate(axes, point.setting.values + EARLY * (point.early > 0), place, (0, -11))
    if len(points) > 1 and not is_line:  # too many to name each: the ends, and by its ring the standard one
        _annotate(axes, points[0].setting.values, places[0], (-6, -2), ha="right")
        _annotate(axes, points[-1].setting.values, places[-1], (6, -2), ha="left")
    return next((at for point, at in zip(points, places, strict=True) if point.is_standard), places[-1])


def _name_arms(axes: Axes, places: Mapping[str, tuple[float, float]], style: Mapping[str, Look]) -> None:
    """The name of each arm beside its place: at the first spot where it covers no mark and no other words."""
    figure = axes.get_figure()
    assert isinstance(figure, Figure)
    renderer = FigureCanvasAgg(figure).get_renderer()
    figure.draw_without_rendering()  # fixes where everything is
    taken = [text.get_window_extent(renderer) for text in axes.texts if text.get_text()]
    for line in axes.lines:
        if line.get_marker() not in ("", "None", None):
            marks = axes.transData.transform(np.column_stack(line.get_data()))
            taken += [Bbox.from_bounds(x - MARK, y - MARK, 2 * MARK, 2 * MARK) for x, y in marks]
    frame = axes.get_window_extent(renderer)
    for arm, place in places.items():
        texts = [_annotate(axes, arm, place, (x, y), ha=ha, look=style[arm]) for ha, x, y in SPOTS]
        boxes = [text.get_window_extent(renderer) for text in texts]
        covered = [box.count_overlaps(taken) + 9 * (not _contains(frame, box)) for box in boxes]
        best = covered.index(min(covered))
        for text in texts[:best] + texts[best + 1 :]:
            text.remove()
        taken.append(boxes[best])


def _contains(outer: BboxBase, inner: BboxBase) -> bool:
    return all(outer.contains(*corner) for corner in inner.corners())


def _annotate(
    axes: Axes,
    text: str,
    place: tuple[float, float],
    offset: tuple[float, float],
    *,
    ha: str = "center",
    look: Look | None = None,
) -> Annotation:
    """Words beside a mark: small and grey, or in the look of an arm."""
    style = {"fontsize": 6.5, "color": SOFT} if look is None else {"fontsize": 8.5, "color": look.color}
    weight = "normal" if look is None else "bold"
    return axes.annotate(
        text,
        place,
        offset,
        textcoords="offset points",
        ha=ha,
        weight=weight,
        zorder=6,
        in_layout=False,
        **style,
    )


def _bars(axes: Axes, point: FrontierPoint, look: Look) -> None:
    """Quartiles over cells, thin and pale; the standard deviation over seeds, thick."""
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


def _upper_curve(axes: Axes, rows: Sequence[Row], level: str, zero: Sequence[Row], quality: Quality) -> None:
    """What the same Gaussians reach without noise, whatever the arm: how much growth could help at all."""
    clean = next((each for each in levels_of(rows) if each in NO_NOISE), None)
    if clean is None or clean == level:
        return
    there = at_noise(rows, clean)
    points = [point for arm in arms_of(there) for point in frontier(there, arm, zero, quality)]
    if len(points) < 2:
        return
    corners = Hull((point.count.median, point.gain.median) for point in points).corners
    x, y = [10**a for a, _ in corners], [b for _, b in corners]
    top = axes.get_ylim()[1]
    line = {"color": SOFT, "lw": 1.1, "ls": (0, (4, 3)), "zorder": 1}
    if min(y) < top:
        axes.plot(x, y, scaley=False, **line)
    ends = [f"{value:.{quality.digits - 1}f}" for value in (y[0], y[-1])]
    says = "without noise" if y[-1] < top else f"without noise: {' to '.join(ends)} {quality.unit}".strip()
    place = (0.98, min((y[-1] - axes.get_ylim()[0]) / (top - axes.get_ylim()[0]), 0.92))
    axes.annotate(
        says,
        place,
        (0, 3),
        xycoords="axes fraction",
        textcoords="offset points",
        ha="right",
        fontsize=7.5,
        color=SOFT,
    )


def growth_figure(rows: Sequence[Row]) -> Figure | None:
    """Count over time of each arm's standard setting, a panel per noise level."""
    levels, arms = levels_of(rows), arms_of(rows)
    chosen = {arm: setting for arm in arms if (setting := standard(rows, arm)) is not None}
    histories = {
        (level, arm): paths
        for level in levels
        for arm, setting in chosen.items()
        if (paths := _histories(at_noise(rows, level), setting))
    }
    if not histories:
        return None
    figure, style = new_figure(len(levels), height=3.2), looks(arms)
    panels = figure.subplots(1, len(levels), squeeze=False, sharey=True)[0]
    for axes, level in zip(panels, levels, strict=True):
        axes.set_yscale("log")
        ends = {}
        for arm in chosen:
            if paths := histories.get((level, arm)):
                steps, low, middle, high = over_time(paths)
                axes.fill_between(steps, low, high, color=style[arm].color, alpha=0.16, lw=0)
                axes.plot(steps, middle, color=style[arm].color, lw=1.8)
                ends[arm] = (steps[-1], middle[-1])
        _label_ends(axes, ends, style)
        axes.set_title(level_title(level))
        axes.set_xlabel("step")
    _plain_log(panels[0].yaxis)
    panels[0].set_ylabel("Gaussians")
    return figure


def _histories(rows: Sequence[Row], setting: Setting) -> list[list[tuple[float, float]]]:
    found = [counts(row) for row in by_cell(rows, setting).values()]
    return [history for history in found if history]


def over_time(
    histories: Sequence[Sequence[tuple[float, float]]],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Steps and the quartiles of the counts there. A job keeps its count between records and after its end.

    A step with two records, before and after a refinement, counts with the later one.
    """
    steps = np.array(sorted({step for history in histories for step, _ in history}))
    values = []
    for history in histories:
        last = dict(history)
        at = np.searchsorted(np.array(sorted(last)), steps, side="right") - 1
        ordered = np.array([last[step] for step in sorted(last)])
        values.append(ordered[at.clip(0)])
    low, middle, high = np.quantile(np.array(values), (0.25, 0.5, 0.75), axis=0)
    return steps, low, middle, high


def _label_ends(axes: Axes, ends: dict[str, tuple[float, float]], style: dict[str, Look]) -> None:
    if not ends:
        return
    axes.autoscale_view()
    low, high = (math.log10(limit) for limit in axes.get_ylim())
    heights = spread_labels({arm: math.log10(y) for arm, (_, y) in ends.items()}, ROOM * (high - low))
    right = max(x for x, _ in ends.values())
    axes.set_xlim(0, right * 1.28)
    for arm, height in heights.items():
        axes.text(
            right * 1.02, 10**height, arm, color=style[arm].color, va="center", fontsize=8, weight="bold"
        )


def snr_figure(rows: Sequence[Row]) -> Figure | None:
    """Histograms of the SNR over time: every arm that has one, at every noise level.

    A column per level and a row per arm; where there is room, several arms share a row.
    """
    levels = levels_of(rows)
    chosen = {arm: setting for arm in arms_of(rows) if (setting := standard(rows, arm)) is not None}
    maps = {
        (arm, level): heat
        for arm, setting in chosen.items()
        for level in levels
        if (heat := _snr_map(list(by_cell(at_noise(rows, level), setting).values())))
    }
    arms = [arm for arm in chosen if any(key[0] == arm for key in maps)]
    if not maps:
        return None
    in_a_row = min(max(MAX_HEAT_COLUMNS // len(levels), 1), len(arms))
    columns, lines = in_a_row * len(levels), math.ceil(len(arms) / in_a_row)
    figure = new_figure(columns, lines, height=2.7 if lines < 4 else 2.1)
    panels = figure.subplots(lines, columns, squeeze=False, sharex=True, sharey=True)
    places = [(arm, level) for arm in arms for level in levels]
    for axes, (arm, level) in zip(panels.flat, places, strict=False):
        axes.set_title(f"{arm}, {level_title(level)}".removesuffix(", "))
        axes.set_yscale("log")
        if heat := maps.get((arm, level)):
            _draw_snr(axes, heat)
    shown = [heat.shown for heat in maps.values()]
    panels[0, 0].set_ylim(min(low for low, _ in shown) / 1.5, max(high for _, high in shown) * 2)
    _plain_log(panels[0, 0].yaxis)
    sides = [heat.sides for heat in maps.values()]
    panels[0, 0].set_xlim(min(low for low, _ in sides), max(high for _, high in sides))
    for axes in panels[:, 0]:
        axes.set_ylabel("SNR of the gradient")
    for axes in panels.flat[len(places) :]:
        axes.set_visible(False)
    for axes in panels.flat[len(places) - columns : len(places)]:  # the lowest of each column
        axes.set_xlabel("step")
        axes.tick_params(labelbottom=True)
    return figure


class SnrMap:
    """Shares of Gaussians by SNR and refinement, averaged over jobs, and the lines that belong to them."""

    def __init__(self, rows: Sequence[Row]) -> None:
        lines = [line for row in rows for line in histograms(row, "snr")]
        self.steps = sorted({line.step for line in lines})
        self.per_decade = lines[0].bins_per_decade if lines else 1
        lines = [line for line in lines if line.bins_per_decade == self.per_decade]
        self.first = min((line.first for line in lines), default=0)
        last = max((line.first + len(line.counts) for line in lines), default=0)
        shares = np.zeros((last - self.first, len(self.steps)))
        for line in lines:
            at, total = line.first - self.first, sum(line.counts)
            jobs = sum(other.step == line.step for other in lines)
            if total:
                column = self.steps.index(line.step)
                shares[at : at + len(line.counts), column] += np.array(line.counts) / total / jobs
        self.shares = shares
        settings = config(rows[0]).get("densifier") or {} if rows else {}
        self.tau = settings.get("tau_SNR")
        self.floor = noise_floor(settings.get("beta1"), settings.get("beta2"))

    @property
    def edges(self) -> np.ndarray:
        """Of the bins, one more than there are."""
        return 10 ** (np.arange(self.first, self.first + len(self.shares) + 1) / self.per_decade)

    @property
    def half(self) -> float:
        """Half the width of a column, in steps."""
        return float(np.diff(self.steps).min() if len(self.steps) > 1 else 10.0) / 2

    @property
    def sides(self) -> tuple[float, float]:
        """Where the first column begins and the last ends, in steps."""
        return self.steps[0] - self.half, self.steps[-1] + self.half

    @property
    def shown(self) -> tuple[float, float]:
        """The least and the largest SNR worth showing: bins that hold something, and the two lines."""
        held = self.edges[:-1][self.shares.max(axis=1) > 0.002]
        all_of_it = [*held, *(line for line in (self.tau, self.floor) if line)] or list(self.edges)
        return float(min(all_of_it)), float(max(all_of_it))


def _snr_map(rows: Sequence[Row]) -> SnrMap | None:
    heat = SnrMap(rows)
    return heat if heat.shares.size else None


def noise_floor(beta1: float | None, beta2: float | None) -> float | None:
    """RMS SNR of stationary white noise, ``sqrt((1 - beta1) / (1 + beta1))``; needs a long second moment."""
    if beta1 is None or beta2 is None or beta2 < 0.99:
        return None
    return math.sqrt((1 - beta1) / (1 + beta1))


def _draw_snr(axes: Axes, heat: SnrMap) -> None:
    for column, step in enumerate(heat.steps):
        axes.pcolormesh(
            [step - heat.half, step + heat.half],
            heat.edges,
            np.ma.masked_less_equal(heat.shares[:, column : column + 1], 0),
            cmap="Blues",
            vmin=-0.02,
            vmax=max(heat.shares.max(), 1e-9),
            rasterized=True,
        )
    upper = max(heat.tau or 0, heat.floor or 0)
    for value, text, color in ((heat.tau, "tau_SNR", "#d55e00"), (heat.floor, "white noise", INK)):
        if value:
            side = 1 if value == upper else -1  # of two lines that lie close, the words keep apart
            axes.axhline(value, color=color, lw=1.1, ls="--")
            axes.annotate(
                f"{text} {value:.3g}",
                (1, value),
                xycoords=("axes fraction", "data"),
                xytext=(-3, 3 * side),
                textcoords="offset points",
                ha="right",
                va="bottom" if side > 0 else "top",
                fontsize=7.5,
                color=color,
                bbox={"facecolor": PAPER, "alpha": 0.6, "lw": 0, "pad": 0.5},
            )


def thresholds_figure(rows: Sequence[Row]) -> Figure | None:
    """Two thresholds of an arm against each other: median count and median quality (paper fig. 8)."""
    found = _two_thresholds(rows)
    if found is None:
        return None
    arm, (across, down) = found
    levels = [level for level in levels_of(rows) if len(frontier(at_noise(rows, level), arm)) > 2]
    if not levels:
        return None
    figure = new_figure(2, len(levels), width=8.2, height=2.7)
    panels = figure.subplots(len(levels), 2, squeeze=False)
    for pair, level in zip(panels, levels, strict=True):
        here = at_noise(rows, level)
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


def arm_of_two_thresholds(rows: Sequence[Row]) -> str | None:
    """The arm in which two thresholds vary over most settings."""
    found = _two_thresholds(rows)
    return found[0] if found else None


def _two_thresholds(rows: Sequence[Row]) -> tuple[str, tuple[str, str]] | None:
    """The arm in which two thresholds vary over most settings, and their names."""
    best: dict[str, set[Setting]] = {}
    for row in measured(rows):
        numeric = [key for key, value in row.setting.thresholds if isinstance(value, float)]
        if len(numeric) == len(row.setting.thresholds) == 2:
            best.setdefault(row.arm, set()).add(row.setting)
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


def _plain_log(axis: Axis, *, room: float = 1.0) -> None:
    """Numbers such as 500, 1k, 20k along a logarithmic axis, instead of powers of ten."""
    low, high = axis.get_view_interval()
    low, high = low / room, high * room
    axis.set_major_locator(FixedLocator(log_ticks(math.log10(low), math.log10(high))))
    axis.set_major_formatter(FuncFormatter(lambda value, _: short(value)))
    axis.set_minor_locator(NullLocator())
    axis.axes.set(**{f"{axis.axis_name}lim": (low, high)})  # pyright: ignore[reportAttributeAccessIssue]
