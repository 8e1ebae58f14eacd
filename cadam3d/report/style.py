"""The one style of everything that matplotlib draws, and how a drawing becomes part of a page."""

import io
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FixedFormatter, FixedLocator, NullLocator

from cadam3d.io.atomic import replacing
from cadam3d.report.formatting import short
from cadam3d.report.palette import INK, LINE, PAPER, SOFT, VARIABLES

KNOWN = {  # arm -> colour, marker
    "none": ("#767676", "X"),
    "baseline": ("#d55e00", "o"),
    "cadam": ("#0072b2", "s"),
    "cadam_calibrated": ("#009e73", "D"),
    "cadam_annealed": ("#cc79a7", "^"),
    "cadam_selective": ("#8c1c46", "P"),
    "random": ("#8a5a44", "v"),
}
SPARE_COLORS = ("#56b4e9", "#b07d00", "#6a5acd", "#5c7a00", "#00838f", "#1f2d6b", "#b5179e", "#5b2c6f")
# With eight colours, a pair repeats after 24 arms.
SPARE_MARKERS = ("<", ">", "p", "*", "d", "h")
INCH = 2.9  # height of a panel
LEAST_TEXT = 10.0  # CSS pixels; no text of a figure on a page is smaller, on whatever screen
TICKS = 5  # approximate number per axis
# The type is Any, because matplotlib types the names of its settings one by one.
RC: Any = {
    "font.family": "sans-serif",
    "font.size": 9,
    # Text stays text in a drawing, and a dollar sign in a prompt does not begin a formula.
    "svg.fonttype": "none",
    "text.parse_math": False,
    "axes.edgecolor": SOFT,
    "axes.labelcolor": SOFT,
    "axes.titlesize": 10,
    "axes.titleweight": "bold",
    "axes.titlecolor": INK,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": LINE,
    "grid.linewidth": 0.8,
    "text.color": INK,
    "xtick.color": SOFT,
    "ytick.color": SOFT,
    "figure.facecolor": PAPER,
    "axes.facecolor": PAPER,
    "savefig.facecolor": PAPER,
}


@dataclass(frozen=True)
class Look:
    """Colour and marker of an arm in every figure."""

    color: str
    marker: str


def looks(arms: Iterable[str]) -> dict[str, Look]:
    """Return the look of each arm: fixed for the common ones, in alphabetical order for others.

    Pass all arms of a sweep at once. Otherwise two arms without a fixed look may get the same one.
    """
    arms = list(arms)
    others = sorted(set(arms) - set(KNOWN))
    spare = {
        arm: (SPARE_COLORS[i % len(SPARE_COLORS)], SPARE_MARKERS[i % len(SPARE_MARKERS)])
        for i, arm in enumerate(others)
    }
    return {arm: Look(*(KNOWN.get(arm) or spare[arm])) for arm in arms}


def new_figure(columns: int, lines: int = 1, *, width: float = 0.0, height: float = INCH) -> Figure:
    """Return an empty figure for ``columns`` times ``lines`` panels; sizes in inches.

    The figure belongs to no global state of matplotlib. Call this inside :func:`styled`.
    """
    return Figure(figsize=(width or min(1.0 + 3.1 * columns, 10.4), height * lines), layout="constrained")


def styled(more: Any = None):
    """Return the context in which figures are drawn and written; ``more`` holds further settings."""
    return rc_context(RC | (more or {}))


def hide_axes(axes: Axes) -> None:
    """Remove the ticks, the grid and the frame of a panel that holds a picture."""
    axes.set_xticks([])
    axes.set_yticks([])
    axes.grid(visible=False)
    for spine in axes.spines.values():
        spine.set_visible(False)


def spread_labels(places: Mapping[str, float], least: float) -> dict[str, float]:
    """Return heights for labels, lowest first, at least ``least`` apart and on average where they were."""
    moved: dict[str, float] = {}
    for name, height in sorted(places.items(), key=lambda item: item[1]):
        moved[name] = max(height, max(moved.values(), default=-float("inf")) + least)
    excess = sum(moved[name] - places[name] for name in places) / max(len(places), 1)
    return {name: height - excess for name, height in moved.items()}


# Ticks: round numbers, written short.


def round_ticks(low: float, high: float) -> list[float]:
    """Return round numbers in [low, high] that are 1, 2 or 5 times a power of ten apart."""
    rough = (high - low) / TICKS
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(factor * power for factor in (1, 2, 5, 10) if factor * power >= rough * 0.999)
    first, last = math.ceil(low / step - 1e-6), math.floor(high / step + 1e-6)
    return [i * step for i in range(first, last + 1)]


def log_ticks(low: float, high: float) -> list[float]:
    """Return round numbers between ``10**low`` and ``10**high``.

    A wide range has powers of ten only, perhaps not all of them. A narrower one has 1, 2 and 5 times those,
    and the narrowest has round numbers at equal distances.
    """
    if high - low < 0.8:
        return round_ticks(10.0**low, 10.0**high)
    factors = (1.0,) if high - low >= 2 else (1.0, 2.0, 5.0)
    every = max(1, math.ceil((high - low) / TICKS))
    exponents = range(math.floor(low), math.ceil(high) + 1)
    ticks = [factor * 10.0**e for e in exponents if e % every == 0 for factor in factors]
    return [tick for tick in ticks if low - 1e-9 <= math.log10(tick) <= high + 1e-9]


def label_ticks(axis: Axis, ticks: Sequence[float], unit: str = "") -> None:
    """Put ticks on an axis, labelled with short numbers such as 500, 1k or 20k, and the unit."""
    axis.set_major_locator(FixedLocator(list(ticks)))
    axis.set_major_formatter(FixedFormatter([short(tick) + unit for tick in ticks]))
    axis.set_minor_locator(NullLocator())


def label_log_axis(axis: Axis, *, room: float = 1.0) -> None:
    """Label a logarithmic axis with short numbers, not powers of ten; ``room`` widens it by a factor."""
    low, high = axis.get_view_interval()
    low, high = low / room, high * room
    label_ticks(axis, log_ticks(math.log10(low), math.log10(high)))
    axis.axes.set(**{f"{axis.axis_name}lim": (low, high)})  # pyright: ignore[reportAttributeAccessIssue]


# From a figure to files and to a part of a page.


def write_figure(figure: Figure, folder: Path, name: str) -> str:
    """Write ``name.svg`` and ``name.png`` into ``folder`` and return the text of the SVG file."""
    with replacing(folder / f"{name}.png") as temporary, styled():
        figure.savefig(temporary, format="png", dpi=160)
    text = svg_of(figure, name, dpi=200)
    with replacing(folder / f"{name}.svg") as temporary:
        temporary.write_text(text, encoding="utf-8")
    return text


def svg_of(figure: Figure, name: str, dpi: float) -> str:
    """Return a figure as the text of an SVG file.

    The same figure always gives the same text. ``name`` must be unique in a page: identifiers inside the
    drawing are derived from it. ``dpi`` is the resolution of parts that are pixels.
    """
    buffer = io.StringIO()
    with styled({"svg.hashsalt": name}):
        figure.savefig(buffer, format="svg", dpi=dpi, metadata={"Date": None})
    return buffer.getvalue()


def inline(svg: str) -> str:
    """Return an SVG file as a part of an HTML page.

    Left out is what a page does not need: the prolog, metadata, namespaces, names of groups, fonts (those of
    the page are used) and decimals beyond a hundredth of a point. Colours become variables of the page. The
    variable ``--least`` holds the smallest width at which the text of the drawing is legible.
    """
    text = svg[svg.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>|<style.*?</style>", "", text, flags=re.DOTALL)
    least = least_width(text)
    text = re.sub(
        r'(<svg[^>]*?) width="([\d.]+)pt"',
        rf'\1 style="max-width: \2pt; --least: {least:.0f}px"',
        text,
        count=1,
    )
    text = re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", text, count=1)
    text = re.sub(r' xmlns(:\w+)?="[^"]*"| version="1.1"', "", text, count=3)
    text = re.sub(r'<g id="[^"]*"', "<g", text)
    text = re.sub(r" font-family: [^;\"]*;", "", text)
    text = re.sub(r"<defs>\s*</defs>", "", text)
    text = re.sub(r' transform="rotate\(-0 [^"]*"', "", text)
    text = re.sub(r'(?<= d=")[^"]*', lambda found: _compact(found.group()), text)
    text = re.sub(r">\s+<", "><", text)
    for color, variable in VARIABLES.items():
        text = text.replace(color, f"var(--{variable}, {color})")
    return text.strip()


def least_width(svg: str) -> float:
    """Return the width in CSS pixels at which a drawing's smallest text has ``LEAST_TEXT``; 0 without text.

    Sizes inside the drawing are in units of its view box, which has as many of them as the width has points.
    """
    sizes = [float(size) for size in re.findall(r"font(?:-size)?: (?:[\w ]+ )?([\d.]+)px", svg)]
    width = re.search(r'<svg[^>]*? width="([\d.]+)pt"', svg)
    return float(width.group(1)) * LEAST_TEXT / min(sizes) if sizes and width else 0.0


def _compact(path: str) -> str:
    """Return the data of an SVG path with at most two decimals and without line breaks."""
    return " ".join(re.sub(r"(\d+\.\d\d)\d+", r"\1", path).split())
