"""Charts of a run: which plots its page has, made from what was logged and from what was declared.

Some plots exist for every run: the count, the loss, the refinements, the resets and the share of selected
Gaussians. The plots of statistics are those that the densifier and the objective declare. Numbers that belong
to neither get a plain plot each, so nothing that was logged is hidden.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from cadam3d.core.chart import Chart
from cadam3d.report.formatting import number
from cadam3d.report.plots import Band, Bar, Plot, Point, Section, Series, smooth

Lines = Sequence[Mapping[str, Any]]

SMOOTHING = 15  # the running median covers one part in 15 of a noisy curve
# Keys that the plots of every run show already, or that are not numbers to plot.
ALWAYS_PLOTTED = ("kind", "step", "loss", "num_gaussians", "seconds")
ALWAYS_PLOTTED += ("before", "after", "selected", "cloned", "split", "pruned", "reset")
CURVE_COLORS = (1, 2, 3)
THRESHOLD_COLOR = 4


def sections(steps: Lines, refinements: Lines, charts: Sequence[Chart]) -> list[Section]:
    """Return the plots of a run under their headings; those without data are left out.

    ``steps`` and ``refinements`` are the two kinds of lines of ``metrics.jsonl``, the statistics of the
    refinements on the same level as their counts. A declared chart is looked up in the refinements first,
    where the densifier logs, and then in the steps, where the objective does.
    """
    x_range = _x_range(steps, refinements)
    by_densifier = [plot_of(chart, refinements, x_range) for chart in charts]
    by_objective = [
        plot_of(chart, steps, x_range)
        for chart, plot in zip(charts, by_densifier, strict=True)
        if plot.is_empty
    ]
    found = [
        Section("Growth", _growth_plots(steps, refinements, x_range)),
        Section("Densifier", [_selected_plot(refinements, x_range), *by_densifier]),
        Section("Objective", by_objective),
    ]
    filled = [Section(each.title, [plot for plot in each.plots if not plot.is_empty]) for each in found]
    return [section for section in filled if section.plots]


def other_plots(steps: Lines, refinements: Lines, charts: Sequence[Chart]) -> list[Plot]:
    """Return one plain plot for each number that was logged and that no other plot of the page shows."""
    declared = {key for chart in charts for key in _keys(chart)}
    x_range = _x_range(steps, refinements)
    plots = []
    for lines in (steps, refinements):
        for key in dict.fromkeys(key for line in lines for key in line):
            if key not in ALWAYS_PLOTTED and key not in declared and (points := _points(lines, key)):
                series = Series(label="", points=points, color=3)
                plots.append(Plot(title=key, series=[series], x_range=x_range))
    return plots


def plot_of(chart: Chart, lines: Lines, x_range: Point) -> Plot:
    """Return what a declared chart shows of ``lines``; empty if these lines have none of its keys."""
    factor = 100 if chart.percent else 1

    def points(key: str) -> list[Point]:
        return [(step, factor * value) for step, value in _points(lines, key)]

    is_alone = len(chart.curves) == 1 and chart.band is None
    colors = iter(CURVE_COLORS * len(chart.curves))
    series = [
        Series(
            label=curve.label or ("" if is_alone else curve.key),
            points=points(curve.key),
            color=THRESHOLD_COLOR if curve.is_threshold else next(colors),
            is_dashed=curve.is_threshold,
        )
        for curve in chart.curves
    ]
    bands = []
    if chart.band is not None:
        low, high = map(points, chart.band)
        bands.append(Band(label=chart.band_label or "range", low=low, high=high, color=1))
    return Plot(
        title=chart.title,
        caption=chart.caption,
        series=series,
        bands=bands,
        x_range=x_range,
        log_y=chart.log_y,
        from_zero=not chart.log_y,
        unit="%" if chart.percent else "",
    )


def _x_range(steps: Lines, refinements: Lines) -> Point:
    """Return the range of the steps of all plots, which is not empty even if nothing was logged."""
    return 0, max((number(line.get("step")) or 0 for line in (*steps, *refinements)), default=0) or 1


def _keys(chart: Chart) -> list[str]:
    return [*(curve.key for curve in chart.curves), *(chart.band or ())]


def _growth_plots(steps: Lines, refinements: Lines, x_range: Point) -> list[Plot]:
    loss = _points(steps, "loss")
    window = len(loss) // SMOOTHING
    smoothed = Series(label="running median", points=smooth(loss, window), color=1)
    logged = Series(label="logged", points=loss, color=1, is_faint=window > 1)
    resets = [(step, count) for step, count in _points(refinements, "reset") if count > 0]
    return [
        Plot(
            title="Gaussians",
            caption="The number of Gaussians; marks on the axis are refinements.",
            series=[Series(label="", points=_counts(steps, refinements), color=1)],
            marks=[step for step, _ in _points(refinements, "after")],
            x_range=x_range,
            from_zero=True,
        ),
        Plot(
            title="Loss",
            caption="Half the squared norm of the guidance gradient plus regularizers.",
            series=[logged, smoothed] if window > 1 else [logged],
            log_y=True,
            x_range=x_range,
        ),
        Plot(
            title="Refinements",
            caption="Gaussians that each refinement cloned and split (up) and pruned (down).",
            bars=_refinement_bars(refinements),
            bar_labels=[("cloned", 1), ("split", 2), ("pruned", 4)],
            x_range=x_range,
            from_zero=True,
        ),
        Plot(
            title="Opacity resets",
            caption="Gaussians whose opacity each reset lowered.",
            bars=[
                Bar(x=step, start=0, stop=count, color=3, hint=f"{count:,.0f} reset at step {step:g}")
                for step, count in resets
            ],
            x_range=x_range,
            from_zero=True,
        ),
    ]


def _selected_plot(refinements: Lines, x_range: Point) -> Plot:
    before = dict(_points(refinements, "before"))
    shares = [
        (step, 100 * count / before[step])
        for step, count in _points(refinements, "selected")
        if before.get(step)
    ]
    return Plot(
        title="Selected Gaussians",
        caption="Share of all Gaussians that each refinement selected for growth.",
        series=[Series(label="", points=shares, color=2)],
        x_range=x_range,
        from_zero=True,
        unit="%",
    )


def _counts(steps: Lines, refinements: Lines) -> list[Point]:
    """Return the count over steps, with a vertical jump at each refinement.

    The line of a step holds the count before the refinement of that step.
    """
    counts = [(step, 0, count) for step, count in _points(steps, "num_gaussians")]
    counts += [(step, 0, count) for step, count in _points(refinements, "before")]
    counts += [(step, 1, count) for step, count in _points(refinements, "after")]
    return [(step, count) for step, _, count in sorted(counts)]


def _refinement_bars(refinements: Lines) -> list[Bar]:
    bars = []
    for line in refinements:
        step = number(line.get("step"))
        cloned, split, pruned = (number(line.get(key)) or 0.0 for key in ("cloned", "split", "pruned"))
        if step is not None and cloned + split + pruned > 0:
            hint = f"step {step:g}: {cloned:,.0f} cloned, {split:,.0f} split, {pruned:,.0f} pruned"
            bars.append(Bar(x=step, start=0, stop=cloned, color=1, hint=hint))
            bars.append(Bar(x=step, start=cloned, stop=cloned + split, color=2, hint=hint))
            bars.append(Bar(x=step, start=0, stop=-pruned, color=4, hint=hint))
    return bars


def _points(lines: Iterable[Mapping[str, Any]], key: str) -> list[Point]:
    pairs = ((number(line.get("step")), number(line.get(key))) for line in lines)
    return [(step, value) for step, value in pairs if step is not None and value is not None]
