"""The one style of everything that matplotlib draws, and how a drawing becomes part of a page."""

import io
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator

from cadam3d.core.palette import ARMS, INK, LINE, PAPER, SOFT, VARIABLES
from cadam3d.io.atomic import replacing
from cadam3d.report.formatting import short

COLORS = tuple(ARMS)
MARKERS = ("o", "s", "D", "^", "X", "P", "v", "<", ">", "p", "*", "d", "h")
INCH = 2.9  # height of a panel
TICKS = 6  # at most, on a linear axis
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
    """Return the look of each arm, by its position. Pass all arms of a sweep in the order of the sweep.

    There are 15 colours and 13 markers, so a pair repeats after 195 arms.
    """
    return {
        arm: Look(COLORS[i % len(COLORS)], MARKERS[i % len(MARKERS)])
        for i, arm in enumerate(dict.fromkeys(arms))
    }


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


def label_axis(axis: Axis, unit: str = "") -> None:
    """Put round numbers on an axis, written short such as 500, 1k or 20k, with ``unit`` behind each.

    Call this when the axis has its scale and its limits.
    """
    if axis.get_scale() == "log":
        low, high = axis.get_view_interval()
        # An axis over few decades has 1, 2 and 5 times the powers of ten.
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < 1e3 * low else (1.0,)))
        axis.set_minor_locator(NullLocator())
    else:
        axis.set_major_locator(MaxNLocator(TICKS, steps=[1, 2, 5, 10]))
    axis.set_major_formatter(lambda value, _: f"{short(value)}{unit}")


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

    The prolog, metadata, names of groups, fonts (the page's own are used) and decimals beyond a hundredth
    of a point are left out, and colours become variables of the page. The variable ``--width`` holds the
    width of the drawing.
    """
    text = svg[svg.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>|<style.*?</style>", "", text, flags=re.DOTALL)
    size = r'(<svg[^>]*?) width="([\d.]+pt)" height="[^"]*"'
    text = re.sub(size, r'\1 style="--width: \2"', text, count=1)
    text = re.sub(r' xmlns(:\w+)?="[^"]*"| version="1.1"', "", text, count=3)
    text = re.sub(r'<g id="[^"]*"', "<g", text)
    text = re.sub(r" font-family: [^;\"]*;", "", text)
    text = re.sub(r'(?<= d=")[^"]*', lambda path: re.sub(r"(\.\d\d)\d+", r"\1", path.group()), text)
    text = re.sub(r">\s+<", "><", text)
    for color, variable in VARIABLES.items():
        text = text.replace(color, f"var(--{variable}, {color})")
    return text.strip()
