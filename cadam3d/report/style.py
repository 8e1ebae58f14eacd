"""The style of the figures: one colour and one marker per arm in all of them, text as text, light and dark.

Colours are those of Okabe and Ito (told apart by everyone); markers differ too, for print in grey.
A figure is drawn for light paper. On a page its colours become CSS variables, so that the page decides.
"""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cadam3d.io.atomic import replacing

PAPER, INK, SOFT, LINE = "#ffffff", "#1b1c1e", "#5d6167", "#e2e2de"
PAGE_VARIABLES = {PAPER: "card", INK: "ink", SOFT: "soft", LINE: "line"}  # of report.css
KNOWN = {  # arm -> light, marker
    "none": ("#767676", "X"),
    "baseline": ("#d55e00", "o"),
    "cadam": ("#0072b2", "s"),
    "cadam_calibrated": ("#009e73", "D"),
    "cadam_annealed": ("#cc79a7", "^"),
    "cadam_selective": ("#8c1c46", "P"),
    "random": ("#8a5a44", "v"),
}
SPARE_COLORS = ("#56b4e9", "#b07d00", "#6a5acd", "#5c7a00", "#00838f", "#1f2d6b", "#b5179e", "#5b2c6f")
SPARE_MARKERS = ("<", ">", "p", "*", "d", "h")  # beside eight colours: a pair comes again after 24 arms
DARK = {
    **{"#767676": "#a3a7ad", "#d55e00": "#ff9150", "#0072b2": "#62b3f0", "#009e73": "#3fcfa4"},
    **{"#cc79a7": "#e5a0c8", "#8c1c46": "#e2607f", "#8a5a44": "#c99a84"},
    **{"#56b4e9": "#8fd0f7", "#b07d00": "#e3b04b", "#6a5acd": "#a99ff0", "#5c7a00": "#a9c94f"},
    **{"#00838f": "#4fc3cd", "#1f2d6b": "#8ea0e8", "#b5179e": "#ee6fd8", "#5b2c6f": "#c9a0dc"},
}
INCH = 2.9  # height of a panel
RC: Any = {  # Any: matplotlib has a type for the names of its settings
    "font.family": "sans-serif",
    "font.size": 9,
    "svg.fonttype": "none",  # text stays text
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
    """How an arm is drawn."""

    color: str
    marker: str


def looks(arms: Iterable[str]) -> dict[str, Look]:
    """The look of each arm: fixed for the common ones, in the order of names for others.

    Give all arms of a sweep at once, or those without a fixed look get that of another.
    """
    arms = list(arms)
    others = sorted(set(arms) - set(KNOWN))
    spare = {
        arm: (SPARE_COLORS[i % len(SPARE_COLORS)], SPARE_MARKERS[i % len(SPARE_MARKERS)])
        for i, arm in enumerate(others)
    }
    return {arm: Look(*(KNOWN.get(arm) or spare[arm])) for arm in arms}


def new_figure(columns: int, rows: int = 1, *, width: float = 0.0, height: float = INCH) -> Figure:
    """An empty figure for so many panels, without any global state; call it inside :func:`styled`."""
    return Figure(figsize=(width or min(1.0 + 3.1 * columns, 10.4), height * rows), layout="constrained")


def styled():
    """The context in which figures are drawn and written."""
    return rc_context(RC)


def pictures_only(axes: Axes) -> None:
    """Panels that hold a picture: no ticks, no frame."""
    axes.set_xticks([])
    axes.set_yticks([])
    axes.grid(visible=False)
    for spine in axes.spines.values():
        spine.set_visible(False)


def spread_labels(places: Mapping[str, float], least: float) -> dict[str, float]:
    """The same labels, lowest first, at heights at least ``least`` apart, and on average where they were."""
    moved: dict[str, float] = {}
    for name, height in sorted(places.items(), key=lambda item: item[1]):
        moved[name] = max(height, max(moved.values(), default=-float("inf")) + least)
    excess = sum(moved[name] - places[name] for name in places) / max(len(places), 1)
    return {name: height - excess for name, height in moved.items()}


def write_figure(figure: Figure, folder: Path, name: str) -> str:
    """Write ``name.svg`` and ``name.png`` into ``folder``; the SVG text comes back for a page."""
    with rc_context({**RC, "svg.hashsalt": name}):  # same figure, same bytes; no ids shared between figures
        with replacing(folder / f"{name}.png") as temporary:
            figure.savefig(temporary, format="png", dpi=160)
        with replacing(folder / f"{name}.svg") as temporary:
            figure.savefig(temporary, format="svg", dpi=200, metadata={"Date": None})
    return (folder / f"{name}.svg").read_text(encoding="utf-8")


def inline(svg: str) -> str:
    """An SVG file as part of a page: without its prolog, its colours left to the page."""
    text = svg[svg.index("<svg") :]
    text = re.sub(r'(<svg[^>]*?) width="([\d.]+)pt"', r'\1 style="max-width: \2pt"', text, count=1)
    text = re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", text, count=1)
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    for color, variable in {**PAGE_VARIABLES, **{color: _variable(color) for color in DARK}}.items():
        text = text.replace(color, f"var(--{variable}, {color})")
    return text


def css() -> str:
    """The variables that :func:`inline` refers to, for light and dark."""
    light = "".join(f"--{_variable(color)}: {color}; " for color in DARK)
    dark = "".join(f"--{_variable(color)}: {shade}; " for color, shade in DARK.items())
    return f":root {{ {light}}}\n@media (prefers-color-scheme: dark) {{ :root {{ {dark}}} }}\n"


def _variable(color: str) -> str:
    return f"arm-{color[1:]}"
