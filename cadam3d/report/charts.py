"""Charts of a run: what a run declared and logged, drawn as small SVG pictures.

Every run has charts of its Gaussians, its loss, its refinements and its opacity resets; the others are those
that its densifier and its objective declare. All pictures have the same size and margins, so that they line
up on the page, which writes the title, the caption and the legend of each.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cadam3d.core.chart import Chart, Curve
from cadam3d.core.palette import SERIES_COLORS, SOFT
from cadam3d.io.declarations import GAUSSIANS, LOSS
from cadam3d.io.records import counts
from cadam3d.report.formatting import number
from cadam3d.report.style import inline, label_axis, styled, svg_of

Point = tuple[float, float]
Lines = Sequence[Mapping[str, Any]]

REFINEMENTS = Chart(
    title="Refinements",
    caption="Gaussians that each refinement cloned, split and pruned.",
    curves=tuple(Curve(key=key, label=key) for key in ("cloned", "split", "pruned")),
)
RESETS = Chart(
    title="Opacity resets",
    caption="Gaussians whose opacity each reset lowered.",
    curves=(Curve(key="reset"),),
)

DPI = 72  # one pixel of matplotlib is then one unit of the SVG
WIDTH, HEIGHT = 560, 250  # units; the picture scales with the page
LEFT, RIGHT, TOP, BOTTOM = 58, 12, 12, 40  # margins around the plotting area
FONT = 11.5  # units
THRESHOLD_COLOR = 4


@dataclass(frozen=True)
class DrawnChart:
    """A chart as a part of the page."""

    title: str
    caption: str
    legend: list[tuple[str, str, int]]  # label, kind and number of the colour; empty for a single curve
    svg: str


def sections(metrics: Lines, charts: Sequence[Chart]) -> dict[str, list[DrawnChart]]:
    """Return the charts of a run by heading; those without data are left out.

    ``metrics`` are the lines of ``metrics.jsonl``. A declared chart is looked up in the refinements first,
    where the densifier logs, and then in the steps, where the objective does.
    """
    steps, refinements = lines_of(metrics)
    last = max((number(line.get("step")) or 0 for line in metrics), default=0) or 1
    growth = [
        draw(GAUSSIANS, [{"step": step, "num_gaussians": count} for step, count in counts(metrics)], last),
        draw(LOSS, steps, last),
        draw(REFINEMENTS, refinements, last),
        draw(RESETS, [line for line in refinements if line.get("reset")], last),
    ]
    by_densifier = [draw(chart, refinements, last) for chart in charts]
    by_objective = [
        draw(chart, steps, last) for chart, drawn in zip(charts, by_densifier, strict=True) if drawn is None
    ]
    found = {"Growth": growth, "Densifier": by_densifier, "Objective": by_objective}
    return {title: [each for each in drawn if each] for title, drawn in found.items() if any(drawn)}


def lines_of(metrics: Lines) -> tuple[list[Mapping[str, Any]], list[Mapping[str, Any]]]:
    """Return the lines of steps and of refinements, with their statistics beside their counts."""
    steps = [line for line in metrics if line.get("kind") == "step"]
    refinements = [line for line in metrics if line.get("kind") == "refine"]
    return steps, [
        {key: value for key, value in line.items() if key != "statistics"} | (line.get("statistics") or {})
        for line in refinements
    ]


def draw(chart: Chart, lines: Lines, last_step: float) -> DrawnChart | None:
    """Draw what a chart shows of ``lines``; None if these lines have none of its keys."""
    factor = 100 if chart.percent else 1
    points = {
        key: [(step, factor * value) for step, value in _points(lines, key) if value > 0 or not chart.log_y]
        for key in (*(curve.key for curve in chart.curves), *(chart.band or ()))
    }
    if not any(points.values()):
        return None
    with styled({"font.size": FONT}):
        figure = Figure(figsize=(WIDTH / DPI, HEIGHT / DPI), dpi=DPI)
        axes = figure.add_axes(
            (LEFT / WIDTH, BOTTOM / HEIGHT, 1 - (LEFT + RIGHT) / WIDTH, 1 - (TOP + BOTTOM) / HEIGHT)
        )
        axes.set_yscale("log" if chart.log_y else "linear")
        legend = [
            _draw_curve(axes, curve, color, points[curve.key])
            for curve, color in _colored(chart)
            if points[curve.key]
        ]
        if chart.band is not None and all(points[key] for key in chart.band):
            low, high = (dict(points[key]) for key in chart.band)
            steps = sorted(low.keys() & high.keys())
            ends = [low[step] for step in steps], [high[step] for step in steps]
            axes.fill_between(steps, *ends, color=SERIES_COLORS[0], alpha=0.18, lw=0)
            legend.append((chart.band_label or "range", "area", 1))
        axes.set_xlim(0, last_step)
        if not chart.log_y:
            axes.set_ylim(min(0.0, axes.get_ylim()[0]), max(0.0, axes.get_ylim()[1]))
        _finish(axes, "%" if chart.percent else "")
        svg = inline(svg_of(figure, chart.title, DPI))
    return DrawnChart(chart.title, chart.caption, legend if len(legend) > 1 else [], svg)


def _colored(chart: Chart) -> list[tuple[Curve, int]]:
    """Return the curves with the numbers of their colours; the last colour is for thresholds."""
    others = [curve for curve in chart.curves if not curve.is_threshold]
    colors = {curve: 1 + i % (THRESHOLD_COLOR - 1) for i, curve in enumerate(others)}
    return [(curve, colors.get(curve, THRESHOLD_COLOR)) for curve in chart.curves]


def _draw_curve(axes: Axes, curve: Curve, color: int, points: Sequence[Point]) -> tuple[str, str, int]:
    """Draw a curve that has points, and return its entry in the legend."""
    axes.plot(
        *zip(*points, strict=True),
        color=SERIES_COLORS[color - 1],
        lw=2,
        ls=(0, (2.5, 2)) if curve.is_threshold else "-",
        marker="o" if len(points) == 1 else None,
        clip_on=False,
        zorder=3,
    )
    return curve.label or curve.key, "dashed" if curve.is_threshold else "plain", color


def _finish(axes: Axes, unit: str) -> None:
    """Label both axes of a complete chart."""
    label_axis(axes.xaxis)
    label_axis(axes.yaxis, unit)
    axes.tick_params(length=0, pad=6)
    axes.grid(visible=False, axis="x")
    axes.spines["left"].set_visible(False)
    place = 1 - RIGHT / WIDTH, 3 / HEIGHT
    axes.text(*place, "step", transform=axes.figure.transFigure, ha="right", color=SOFT)


def _points(lines: Lines, key: str) -> list[Point]:
    pairs = ((number(line.get("step")), number(line.get(key))) for line in lines)
    return [(step, value) for step, value in pairs if step is not None and value is not None]
