"""Plots of the page of a run: numbers over training steps, drawn as small SVG pictures.

All plots have the same size and margins, so that they line up on the page. The page writes the title, the
caption and the legend of each, and puts a tooltip on every point and bar.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline

from cadam3d.report.formatting import short
from cadam3d.report.palette import SERIES_COLORS, SOFT
from cadam3d.report.style import inline, label_ticks, log_ticks, round_ticks, styled, svg_of

Point = tuple[float, float]

DPI = 72  # one pixel of matplotlib is then one unit of the SVG
WIDTH, HEIGHT = 560, 250  # units; the picture scales with the page
LEFT, RIGHT, TOP, BOTTOM = 58, 12, 12, 40  # margins around the plotting area
FONT = 11.5  # units
BAR_WIDTHS = (1.5, 22.0)  # units; smallest and largest
# A curve with more points has tooltips on an even selection of them.
HINTS = 200


@dataclass(frozen=True, kw_only=True)
class Series:
    """A line through points, in the order given."""

    label: str
    points: Sequence[Point]
    color: int  # 1 to 4
    is_faint: bool = False  # thin and pale: raw data behind a smoothed curve
    is_dashed: bool = False

    @property
    def kind(self) -> str:
        """Return the CSS class of its entry in the legend."""
        return "dashed" if self.is_dashed else "faint" if self.is_faint else "plain"


@dataclass(frozen=True, kw_only=True)
class Band:
    """The area between two lines over the same steps."""

    label: str
    low: Sequence[Point]
    high: Sequence[Point]
    color: int


@dataclass(frozen=True, kw_only=True)
class Bar:
    """One bar from ``start`` to ``stop`` on the y axis."""

    x: float
    start: float
    stop: float
    color: int
    hint: str  # the tooltip


@dataclass(frozen=True)
class Hint:
    """An invisible shape with a tooltip, in units of the SVG."""

    text: str
    color: int
    x: float
    y: float  # from the top
    width: float = 0.0  # of a bar; 0 for a point
    height: float = 0.0


@dataclass(frozen=True)
class Drawing:
    """A plot as parts of a page. The picture lacks its closing tag, so that the hints fit in."""

    svg: str
    hints: list[Hint]


@dataclass(frozen=True, kw_only=True)
class Plot:
    """The numbers of one plot, with its title, caption and axes."""

    title: str
    caption: str = ""
    series: Sequence[Series] = ()
    bands: Sequence[Band] = ()
    bars: Sequence[Bar] = ()
    bar_labels: Sequence[tuple[str, int]] = ()  # legend entries of the bars: text, colour
    marks: Sequence[float] = ()  # steps with a small mark on the x axis
    log_y: bool = False
    x_range: Point | None = None  # None: the range of the points
    from_zero: bool = False  # the y axis includes 0
    unit: str = ""  # behind the numbers of the y axis

    def __post_init__(self) -> None:
        # A logarithmic axis can show positive numbers only.
        if self.log_y:
            series = [replace(each, points=_positive(each.points)) for each in self.series]
            bands = [replace(band, low=_positive(band.low), high=_positive(band.high)) for band in self.bands]
            object.__setattr__(self, "series", series)
            object.__setattr__(self, "bands", bands)

    @property
    def is_empty(self) -> bool:
        """Return whether there is nothing to draw."""
        return not self._points()

    @property
    def legend(self) -> list[tuple[str, str, int]]:
        """Return label, kind and colour of each entry; none for a single curve, which the title names."""
        entries = [(each.label, each.kind, each.color) for each in self.series if each.points]
        entries += [(band.label, "area", band.color) for band in self.bands if band.low]
        entries += [(label, "bar", color) for label, color in self.bar_labels]
        return entries if len(entries) > 1 else []

    def draw(self) -> Drawing:
        """Draw the plot, which must not be empty."""
        with styled({"font.size": FONT}):
            figure = Figure(figsize=(WIDTH / DPI, HEIGHT / DPI), dpi=DPI)
            axes = figure.add_axes(
                (LEFT / WIDTH, BOTTOM / HEIGHT, 1 - (LEFT + RIGHT) / WIDTH, 1 - (TOP + BOTTOM) / HEIGHT)
            )
            self._draw_axes(axes)
            for band in self.bands:
                _draw_band(axes, band)
            boxes = self._boxes(axes)
            for color in sorted({bar.color for bar in self.bars}):
                _draw_bars(axes, [box for box in boxes if box.color == color], color)
            for each in self.series:
                _draw_series(axes, each)
            _draw_marks(axes, self.marks)
            svg = inline(svg_of(figure, self.title, DPI)).removesuffix("</svg>")
            return Drawing(svg, [*boxes, *self._hints(axes)])

    def _points(self) -> list[Point]:
        points = [point for each in self.series for point in each.points]
        points += [point for band in self.bands for point in (*band.low, *band.high)]
        return points + [(bar.x, y) for bar in self.bars for y in (bar.start, bar.stop)]

    def _draw_axes(self, axes: Axes) -> None:
        points = self._points()
        steps, values = [x for x, _ in points], [y for _, y in points]
        low, high = self.x_range or (min(steps), max(steps))
        low, high = _with_room(low, high)
        axes.set_xlim(low, high)
        label_ticks(axes.xaxis, round_ticks(low, high))
        axes.set_yscale("log" if self.log_y else "linear")
        values += [0.0] if self.from_zero and not self.log_y else []
        low, high, ticks = (_log_range if self.log_y else _range)(min(values), max(values))
        axes.set_ylim(low, high)
        label_ticks(axes.yaxis, ticks, self.unit)
        axes.tick_params(length=0, pad=6)
        axes.grid(visible=False, axis="x")
        axes.spines["left"].set_visible(False)
        place = 1 - RIGHT / WIDTH, 3 / HEIGHT
        axes.text(*place, "step", transform=axes.figure.transFigure, ha="right", color=SOFT)
        if low < 0 < high:
            axes.axhline(0, color=SOFT, lw=0.8)

    def _boxes(self, axes: Axes) -> list[Hint]:
        """Return the bars as shapes with tooltips; all have the same width."""
        steps = sorted({bar.x for bar in self.bars})
        gap = min((b - a for a, b in pairwise(steps)), default=math.inf)
        (left, _), (right, _) = axes.transData.transform([(0, 1), (1, 1)])
        width = max(min(0.6 * gap * (right - left), BAR_WIDTHS[1]), BAR_WIDTHS[0])
        starts = _places(axes, [(bar.x, bar.start) for bar in self.bars])
        stops = _places(axes, [(bar.x, bar.stop) for bar in self.bars])
        return [
            Hint(bar.hint, bar.color, x - width / 2, min(start, stop), width, abs(stop - start))
            for bar, (x, start), (_, stop) in zip(self.bars, starts, stops, strict=True)
        ]

    def _hints(self, axes: Axes) -> list[Hint]:
        """Return a shape with a tooltip for every point of a curve, or for some points of a long one."""
        hints = []
        for each in self.series:
            if each.is_faint:
                continue
            every = max(1, math.ceil(len(each.points) / HINTS))
            name = f"{each.label}: " if each.label else ""
            points = each.points[::every]
            for (step, value), place in zip(points, _places(axes, points), strict=True):
                hints.append(Hint(f"{name}{short(value)}{self.unit} at step {step:g}", each.color, *place))
        return hints


@dataclass(frozen=True)
class Section:
    """Plots under a common heading."""

    title: str
    plots: list[Plot] = field(default_factory=list)


def smooth(points: Sequence[Point], window: int) -> list[Point]:
    """Return the running median over ``window`` points, which single spikes do not move."""
    half = window // 2
    smoothed = []
    for i, (x, _) in enumerate(points):
        near = sorted(y for _, y in points[max(i - half, 0) : i + half + 1])
        smoothed.append((x, near[len(near) // 2]))
    return smoothed


def _positive(points: Sequence[Point]) -> list[Point]:
    return [(x, y) for x, y in points if y > 0]


def _with_room(low: float, high: float) -> Point:
    """Return the same range, or a wider one around a single value."""
    if high - low >= 1e-9 * max(abs(high), 1e-9):
        return low, high
    room = abs(high) * 0.1 or 1.0
    return low - room, high + room


def _range(low: float, high: float) -> tuple[float, float, list[float]]:
    """Return the limits of a linear axis, which are round numbers outside the data, and its ticks."""
    low, high = _with_room(low, high)
    ticks = round_ticks(low, high)
    step = ticks[1] - ticks[0]
    low = min(low, ticks[0] - step * (low < ticks[0] - 1e-9 * step))
    high = max(high, ticks[-1] + step * (high > ticks[-1] + 1e-9 * step))
    return low, high, round_ticks(low, high)


def _log_range(low: float, high: float) -> tuple[float, float, list[float]]:
    """Return the limits of a logarithmic axis, a little outside the data, and its ticks."""
    low, high = math.log10(low), math.log10(high)
    if high - low < 1e-9:
        low, high = low - 0.5, high + 0.5
    room = 0.04 * (high - low)
    return 10 ** (low - room), 10 ** (high + room), log_ticks(low, high)


def _places(axes: Axes, points: Sequence[Point]) -> list[Point]:
    """Return where points are in the picture: units from the left and from the top."""
    if not points:
        return []
    return [(x, HEIGHT - y) for x, y in axes.transData.transform(points).tolist()]


def _draw_series(axes: Axes, series: Series) -> None:
    if not series.points:
        return
    color = SERIES_COLORS[series.color - 1]
    axes.plot(
        *zip(*series.points, strict=True),
        color=color,
        lw=1 if series.is_faint else 2,
        alpha=0.35 if series.is_faint else 1,
        ls=(0, (2.5, 2)) if series.is_dashed else "-",
        solid_capstyle="round",
        marker="o" if len(series.points) == 1 else None,
        clip_on=False,
        zorder=3,
    )


def _draw_band(axes: Axes, band: Band) -> None:
    if band.low:
        corners = [*band.low, *reversed(band.high)]
        axes.fill(*zip(*corners, strict=True), color=SERIES_COLORS[band.color - 1], alpha=0.18, lw=0)


def _draw_bars(axes: Axes, boxes: Sequence[Hint], color: int) -> None:
    """Draw all bars of one colour as one outline, which keeps the page small."""
    outlines = []
    for box in boxes:
        left, right = box.x, box.x + box.width
        top, bottom = HEIGHT - box.y, HEIGHT - box.y - box.height
        if box.height > 0:
            corners = [(left, bottom), (right, bottom), (right, top), (left, top), (left, bottom)]
            outlines.append(Outline(corners, closed=True))
    if outlines:
        outline = Outline.make_compound_path(*outlines)
        fill = SERIES_COLORS[color - 1]
        axes.add_patch(PathPatch(outline, facecolor=fill, lw=0, transform=None, clip_on=False))


def _draw_marks(axes: Axes, steps: Sequence[float]) -> None:
    """Draw a small mark on the x axis at each step, all as one line with gaps."""
    if steps:
        xs = [x for step in steps for x in (step, step, math.nan)]
        ys = [y for _ in steps for y in (0, 0.03, math.nan)]
        axes.plot(xs, ys, color=SOFT, lw=1, transform=axes.get_xaxis_transform(), scaley=False, scalex=False)
