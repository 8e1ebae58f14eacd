"""Curves: the numbers of ``metrics.jsonl`` over the steps, as the page of a run draws them."""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from cadam3d.core.chart import Chart
from cadam3d.io.declarations import GAUSSIANS, LOSS
from cadam3d.io.jsonl import is_number

MOST_SENT = 500  # points of a curve
Points = list[tuple[int, float]]  # steps, ascending, and values


def curves_of(lines: Iterable[Mapping[str, Any]]) -> dict[str, Points]:
    """Return the points of every number in the lines of a log."""
    found: dict[str, Points] = defaultdict(list)
    for line in lines:
        values = {**line, **line.get("statistics", {})}
        if line["kind"] == "refine":
            values = {**line.get("statistics", {}), "num_gaussians": line.get("after")}
        for key, value in values.items():
            # A step counts the Gaussians before its refinement, whose line comes first.
            is_later = not found[key] or found[key][-1][0] < line["step"]
            if is_number(value) and is_later:
                found[key].append((line["step"], value))
    return found


def drawn(curves: Mapping[str, Points], charts: Sequence[Chart]) -> list[dict[str, Any]]:
    """Return the common charts and ``charts``, with their numbers so far, as plain data."""
    found = []
    for chart in (GAUSSIANS, LOSS, *charts):
        facts = {
            name: getattr(chart, name) for name in ("title", "caption", "log_y", "percent", "band_label")
        }
        facts["band"] = [{"key": key, "points": _sent(curves.get(key, []))} for key in chart.band or ()]
        facts["curves"] = [
            {**vars(curve), "points": _sent(curves.get(curve.key, []))} for curve in chart.curves
        ]
        found.append(facts)
    return found


def _sent(points: Points) -> Points:
    """Return a curve with few enough points for a chart, the last one included."""
    every = -(-len(points) // MOST_SENT) or 1
    return points[:-1:every] + points[-1:]
