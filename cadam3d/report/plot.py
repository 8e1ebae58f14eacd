"""Plots as SVG text: a few lines of geometry instead of a plotting library in every report.

Colours are CSS variables (``--series-1`` ...), so that the page decides between light and dark.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from html import escape
from itertools import pairwise

Point = tuple[float, float]

WIDTH, HEIGHT = 560, 250  # user units; the picture scales with the page
LEFT, RIGHT, TOP, BOTTOM = 54, 12, 12, 38  # margins around the plotting area
TICKS = 5  # about so many per axis
HOVER_POINTS = 200  # a curve of more points gets hover targets on an even selection of them
SUFFIXES = ((1e9, "G"), (1e6, "M"), (1e3, "k"))


@dataclass(frozen=True)
class Curve:
    """A line through points, in the order given."""

    label: str
    points: Sequence[Point]
    color: int  # 1 to 4: the CSS variable --series-N
    faint: bool = False  # thin and pale: raw data behind a smoothed curve
    dashed: bool = False

    @property
    def kind(self) -> str:
        """The CSS class of the curve and of its legend entry."""
        return "dashed" if self.dashed else "faint" if self.faint else "plain"


@dataclass(frozen=True)
class Band:
    """The area between two curves over the same x."""

    label: str
    low: Sequence[Point]
    high: Sequence[Point]
    color: int


@dataclass(frozen=True)
class Bar:
    """One bar from ``start`` to ``stop`` on the y axis."""

    x: float
    start: float
    stop: float
    color: int
    hint: str


@dataclass(frozen=True, kw_only=True)
class Chart:
    """One plot and its legend."""

    title: str
    caption: str  # what is on the y axis, in words
    curves: Sequence[Curve] = ()
    bands: Sequence[Band] = ()
    bars: Sequence[Bar] = ()
    bar_labels: Sequence[tuple[str, int]] = ()  # legend entries of the bars: text, color
    ticks_at: Sequence[float] = ()  # small marks on the x axis
    log_y: bool = False
    x_range: Point | None = None  # None = fit the data
    zero: bool = False  # the y axis includes 0

    def __post_init__(self) -> None:
        if self.log_y:  # a logarithm shows positive numbers only
            curves = [replace(curve, points=_positive(curve.points)) for curve in self.curves]
            bands = [replace(band, low=_positive(band.low), high=_positive(band.high)) for band in self.bands]
            object.__setattr__(self, "curves", curves)
            object.__setattr__(self, "bands", bands)

    def is_empty(self) -> bool:
        """Whether there is nothing to draw."""
        return not self._points()

    def _points(self) -> list[Point]:
        points = [point for curve in self.curves for point in curve.points]
        points += [point for band in self.bands for point in (*band.low, *band.high)]
        return points + [(bar.x, y) for bar in self.bars for y in (bar.start, bar.stop)]

    def svg(self) -> str:
        """The plot itself. There must be something to draw."""
        points = self._points()
        xs = [x for x, _ in points]
        x_axis = _Axis.fit(self.x_range or (min(xs), max(xs)), (LEFT, WIDTH - RIGHT), log=False, tight=True)
        ys = [y for _, y in points] + ([0.0] if self.zero and not self.log_y else [])
        y_axis = _Axis.fit((min(ys), max(ys)), (HEIGHT - BOTTOM, TOP), log=self.log_y, tight=False)
        parts = [
            _grid(x_axis, y_axis),
            *(_band(band, x_axis, y_axis) for band in self.bands),
            *(self._bar(bar, x_axis, y_axis) for bar in self.bars),
            *(_curve(curve, x_axis, y_axis) for curve in self.curves),
            *(_mark(x, x_axis) for x in self.ticks_at),
            *(_hover(curve, x_axis, y_axis) for curve in self.curves if not curve.faint),
        ]
        return (
            f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(self.title)}">'
            + "".join(parts)
            + "</svg>"
        )

    def legend(self) -> str:
        """Coloured keys; empty for a single curve, which the title names."""
        keys = [(curve.label, curve.color, curve.kind) for curve in self.curves if curve.points]
        keys += [(band.label, band.color, "area") for band in self.bands if band.low]
        keys += [(label, color, "bar") for label, color in self.bar_labels]
        if len(keys) < 2:
            return ""
        return (
            '<ul class="legend">'
            + "".join(
                f'<li><i class="{kind} s{color}"></i>{escape(label)}</li>' for label, color, kind in keys
            )
            + "</ul>"
        )

    def _bar(self, bar: Bar, x_axis: "_Axis", y_axis: "_Axis") -> str:
        distances = sorted({one.x for one in self.bars})
        gaps = [b - a for a, b in pairwise(distances)]
        share = min(gaps, default=math.inf) * abs(x_axis.scale)
        width = max(min(0.6 * share, 22.0), 1.5)
        top, bottom = sorted((y_axis(bar.start), y_axis(bar.stop)))
        return (
            f'<rect class="fill s{bar.color}" x="{x_axis(bar.x) - width / 2:.1f}" y="{top:.1f}" '
            f'width="{width:.1f}" height="{bottom - top:.1f}"><title>{escape(bar.hint)}</title></rect>'
        )


def _positive(points: Sequence[Point]) -> list[Point]:
    return [(x, y) for x, y in points if y > 0]


def smooth(points: Sequence[Point], window: int) -> list[Point]:
    """The median of each point and its neighbours, ``window`` in all: robust to single spikes."""
    half = window // 2
    smoothed = []
    for i, (x, _) in enumerate(points):
        near = sorted(y for _, y in points[max(i - half, 0) : i + half + 1])
        smoothed.append((x, near[len(near) // 2]))
    return smoothed


def short(value: float) -> str:
    """A number for an axis or a hint: 12300 -> 12.3k, 0.00012 -> 1.2e-4."""
    size = abs(value)
    if size < 1e-12:
        return "0"
    for factor, suffix in SUFFIXES:
        if size >= factor:
            return f"{value / factor:.4g}{suffix}"
    if size < 1e-3:
        mantissa, exponent = f"{value:.2e}".split("e")
        return f"{float(mantissa):g}e{int(exponent)}"
    return f"{value:.4g}"


@dataclass(frozen=True)
class _Axis:
    """From data to user units, straight or logarithmic."""

    low: float  # in data units, or their decimal logarithm
    scale: float
    start: float
    log: bool
    ticks: tuple[float, ...]  # data units

    @classmethod
    def fit(cls, data: Point, pixels: Point, *, log: bool, tight: bool) -> "_Axis":
        low, high = (math.log10(data[0]), math.log10(data[1])) if log else data
        if high - low < 1e-9 * max(abs(high), 1e-9):  # one value: give it room
            room = 0.5 if log else (abs(high) * 0.1 or 1.0)
            low, high = low - room, high + room
        if log:
            ticks = log_ticks(low, high)
        else:
            ticks = _ticks(low, high)
            if not tight:  # to the next round number outside the data
                step = ticks[1] - ticks[0]
                low = min(low, ticks[0] - step * (low < ticks[0] - 1e-9 * step))
                high = max(high, ticks[-1] + step * (high > ticks[-1] + 1e-9 * step))
                ticks = _ticks(low, high)
        if log and not tight:
            low, high = low - 0.04 * (high - low), high + 0.04 * (high - low)
        return cls(low, (pixels[1] - pixels[0]) / (high - low), pixels[0], log, tuple(ticks))

    def __call__(self, value: float) -> float:
        position = math.log10(value) if self.log else value
        return self.start + (position - self.low) * self.scale


def _ticks(low: float, high: float) -> list[float]:
    """Round numbers in [low, high]: 1, 2 or 5 times a power of ten apart."""
    rough = (high - low) / TICKS
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(factor * power for factor in (1, 2, 5, 10) if factor * power >= rough * 0.999)
    first, last = math.ceil(low / step - 1e-6), math.floor(high / step + 1e-6)
    return [i * step for i in range(first, last + 1)]


def log_ticks(low: float, high: float) -> list[float]:
    """Round numbers between ``10**low`` and ``10**high``: as the range shrinks, every so many powers of
    ten, then 1, 2 and 5 times those, then equal distances.
    """
    if high - low < 0.8:
        return _ticks(10.0**low, 10.0**high)
    factors = (1.0,) if high - low >= 2 else (1.0, 2.0, 5.0)
    every = max(1, math.ceil((high - low) / TICKS))
    exponents = range(math.floor(low), math.ceil(high) + 1)
    ticks = [factor * 10.0**e for e in exponents if e % every == 0 for factor in factors]
    return [tick for tick in ticks if low - 1e-9 <= math.log10(tick) <= high + 1e-9]


def _grid(x_axis: _Axis, y_axis: _Axis) -> str:
    parts = []
    for tick in y_axis.ticks:
        y = y_axis(tick)
        kind = "axis" if tick == 0 else "grid"
        parts.append(f'<path class="{kind}" d="M{LEFT} {y:.1f}H{WIDTH - RIGHT}"/>')
        parts.append(f'<text x="{LEFT - 7}" y="{y + 4:.1f}" text-anchor="end">{short(tick)}</text>')
    base = HEIGHT - BOTTOM
    parts.append(f'<path class="axis" d="M{LEFT} {base}H{WIDTH - RIGHT}"/>')
    for tick in x_axis.ticks:
        parts.append(
            f'<text x="{x_axis(tick):.1f}" y="{base + 18}" text-anchor="middle">{short(tick)}</text>'
        )
    parts.append(f'<text x="{WIDTH - RIGHT}" y="{HEIGHT - 3}" text-anchor="end">step</text>')
    return "".join(parts)


def _path(points: Sequence[Point], x_axis: _Axis, y_axis: _Axis) -> str:
    return "L".join(f"{x_axis(x):.1f} {y_axis(y):.1f}" for x, y in points)


def _curve(curve: Curve, x_axis: _Axis, y_axis: _Axis) -> str:
    if not curve.points:
        return ""
    path = _path(curve.points, x_axis, y_axis)
    dot = ""
    if len(curve.points) == 1:
        x, y = curve.points[0]
        dot = f'<circle class="fill s{curve.color}" cx="{x_axis(x):.1f}" cy="{y_axis(y):.1f}" r="3"/>'
    return f'<path class="curve {curve.kind} s{curve.color}" d="M{path}"/>{dot}'


def _band(band: Band, x_axis: _Axis, y_axis: _Axis) -> str:
    if not band.low:
        return ""
    path = _path([*band.low, *reversed(band.high)], x_axis, y_axis)
    return f'<path class="band s{band.color}" d="M{path}Z"/>'


def _mark(x: float, x_axis: _Axis) -> str:
    base = HEIGHT - BOTTOM
    return f'<path class="mark" d="M{x_axis(x):.1f} {base}v-6"><title>step {short(x)}</title></path>'


def _hover(curve: Curve, x_axis: _Axis, y_axis: _Axis) -> str:
    every = max(1, math.ceil(len(curve.points) / HOVER_POINTS))
    name = f"{curve.label}: " if curve.label else ""
    return "".join(
        f'<circle class="hover s{curve.color}" cx="{x_axis(x):.1f}" cy="{y_axis(y):.1f}" r="5">'
        f"<title>{escape(name)}{short(y)} at step {x:g}</title></circle>"
        for x, y in curve.points[::every]
    )
