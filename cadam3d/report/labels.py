"""Labels: write text next to the marks of a panel so that no two texts overlap and no text covers a mark.

The placement is greedy. Each label takes the free place that is nearest to its mark; a label that ends up far
away gets a thin line to its mark.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Annotation
from matplotlib.transforms import Bbox, BboxBase

from cadam3d.report.palette import SOFT

# All lengths are in points.
GAP = 1.0  # between two labels
MARK = 5.0  # half the side of the square that a mark covers
STEP = 5.0  # between two rings of places around a mark
RINGS = 40
FAR = 14.0  # from the mark to the label; from here on there is a line between them
# Directions in degrees from the right, the best first.
ABOVE = (90, 270, 45, 135, 315, 225, 0, 180, 67, 113, 247, 293, 22, 158, 202, 338)
BELOW = (270, 315, 225, 0, 180, 90, 45, 135, 247, 293, 67, 113, 22, 158, 202, 338)


@dataclass(frozen=True)
class Label:
    """A text next to the mark at a place, in coordinates of the data."""

    text: str
    place: tuple[float, float]
    color: str = SOFT
    is_name: bool = False  # of an arm: larger, bold, and above its mark if there is room


def place_labels(axes: Axes, labels: Sequence[Label]) -> None:
    """Write the labels into a panel that is otherwise complete; the first ones get the best places.

    A label for which there is no room in the panel is left out.
    """
    figure = axes.get_figure()
    assert isinstance(figure, Figure)
    renderer = FigureCanvasAgg(figure).get_renderer()
    figure.draw_without_rendering()  # computes the final places
    point = figure.dpi / 72  # pixels
    frame = axes.get_window_extent(renderer)
    taken = [_grown(text.get_window_extent(renderer), GAP * point) for text in axes.texts if text.get_text()]
    for line in axes.lines:
        if line.get_marker() not in ("", "None", None):
            marks = axes.transData.transform(np.column_stack(line.get_data()))
            taken += [_grown(Bbox([mark, mark]), MARK * point) for mark in marks]
    for label in labels:
        written = _write(axes, label)
        box = written.get_window_extent(renderer)
        width, height = box.width / point, box.height / point
        center = axes.transData.transform(label.place)
        for x, y, distance in _offsets(width, height, ABOVE if label.is_name else BELOW):
            middle = center + np.array([x, y]) * point
            half = np.array([width, height]) * point / 2
            found = _grown(Bbox([middle - half, middle + half]), GAP * point / 2)
            is_inside = (
                frame.x0 <= found.x0 <= found.x1 <= frame.x1 and frame.y0 <= found.y0 <= found.y1 <= frame.y1
            )
            if is_inside and not found.count_overlaps(taken):
                written.set_position((x, y))
                taken.append(found)
                if distance > FAR:
                    _join(axes, label, (x, y))
                break
        else:
            written.remove()


def _offsets(width: float, height: float, directions: Sequence[int]) -> Iterator[tuple[float, float, float]]:
    """Yield offsets of a label's middle from its mark, the nearest ring first, with the ring's distance."""
    for ring in range(RINGS):
        distance = MARK + GAP + ring * STEP
        for direction in directions:
            x, y = math.cos(math.radians(direction)), math.sin(math.radians(direction))
            yield x * (distance + width / 2), y * (distance + height / 2), distance


def _write(axes: Axes, label: Label) -> Annotation:
    return axes.annotate(
        label.text,
        label.place,
        (0, 0),
        textcoords="offset points",
        ha="center",
        va="center",
        color=label.color,
        fontsize=8.5 if label.is_name else 7.5,
        weight="bold" if label.is_name else "normal",
        zorder=6,
        in_layout=False,
    )


def _join(axes: Axes, label: Label, offset: tuple[float, float]) -> None:
    """Draw a thin line from a mark to its label."""
    axes.annotate(
        "",
        label.place,
        offset,
        textcoords="offset points",
        arrowprops={"arrowstyle": "-", "color": label.color, "lw": 0.5, "alpha": 0.6, "shrinkB": MARK},
        zorder=2,
        in_layout=False,
    )


def _is_inside(inner: Bbox, outer: BboxBase) -> bool:
    return all(outer.contains(*corner) for corner in inner.corners())


def _grown(box: BboxBase, by: float) -> Bbox:
    return Bbox.from_extents(box.x0 - by, box.y0 - by, box.x1 + by, box.y1 + by)
