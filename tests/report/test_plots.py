"""Plots draw every number at its place on the axes."""

import math
import re
import xml.etree.ElementTree as ET
from itertools import pairwise

import pytest

from cadam3d.report.palette import SERIES
from cadam3d.report.plots import (
    BOTTOM,
    HEIGHT,
    HINTS,
    LEFT,
    RIGHT,
    TOP,
    WIDTH,
    Band,
    Bar,
    Plot,
    Series,
    smooth,
)


def plot(points, **settings) -> Plot:
    return Plot(title="t", series=[Series(label="a", points=points, color=1)], **settings)


def places(made: Plot) -> list[tuple[float, float]]:
    """Return the places of the tooltips of the points: x, and y from the top."""
    return [(hint.x, hint.y) for hint in made.draw().hints]


def curve(svg: str) -> list[tuple[float, float]]:
    """Return the points of the first curve as it is drawn."""
    variable = SERIES["#2a6fdb"][0]
    data = re.search(rf'<path d="([^"]*)"[^>]*style="fill: none; stroke: var\(--{variable}', svg)
    assert data is not None
    return [(float(x), float(y)) for x, y in re.findall(r"([\d.]+) ([\d.]+)", data.group(1))]


def ticks(made: Plot) -> dict[str, float]:
    """Return the labels of the y axis and their heights."""
    found = re.findall(
        r'text-anchor: end[^>]* y="([\d.]+)"[^>]*>([^<]+)<|text-anchor: end[^>]*>([^<]+)<', made.draw().svg
    )
    return {text: float(y) for y, text, _ in found if text != "step"}


@pytest.mark.parametrize("log_y", [False, True])
@pytest.mark.parametrize("points", [[(0, 1), (5, 30)], [(1, 2.0)], [(0, 7), (9, 7)], [(3, 1e-7), (4, 1e9)]])
def test_every_point_is_inside_the_axes(points, log_y):
    for x, y in places(plot(points, log_y=log_y)):
        assert LEFT - 0.1 <= x <= WIDTH - RIGHT + 0.1
        assert TOP - 0.1 <= y <= HEIGHT - BOTTOM + 0.1


@pytest.mark.parametrize("log_y", [False, True])
def test_tooltips_are_where_the_curve_is(log_y):
    made = plot([(0, 1), (1, 10), (2, 700), (3, 1000)], log_y=log_y)
    for drawn, hint in zip(curve(made.draw().svg), places(made), strict=True):
        assert drawn == pytest.approx(hint, abs=0.02)


@pytest.mark.parametrize("log_y", [False, True])
def test_a_point_at_a_tick_is_at_the_height_of_its_label(log_y):
    made = plot([(0, 1), (1, 10), (2, 100), (3, 1000)], log_y=log_y)
    heights, points = ticks(made), places(made)
    shift = heights["1k"] - points[3][1]  # from the middle of a letter to its foot
    assert 0 < shift < 8
    if log_y:
        assert heights["100"] - points[2][1] == pytest.approx(shift, abs=0.5)


def test_larger_is_higher_and_later_is_further_right():
    xs, ys = zip(*places(plot([(x, x * x) for x in range(1, 6)])), strict=True)
    assert list(xs) == sorted(xs)
    assert list(ys) == sorted(ys, reverse=True)


@pytest.mark.parametrize("high", [1e-6, 0.3, 1.0, 7.0, 999.0, 3.3e6])
def test_there_are_a_few_round_ticks_whatever_the_range(high):
    assert 3 <= len(ticks(plot([(0, 0.0), (1, high)]))) <= 8


@pytest.mark.parametrize("decades", [0.1, 0.5, 0.9, 1.5, 3, 9, 30])
def test_logarithmic_axes_have_ticks_whatever_the_range(decades):
    assert 2 <= len(ticks(plot([(0, 1e-3), (1, 1e-3 * 10**decades)], log_y=True))) <= 8


def test_a_logarithmic_axis_leaves_out_numbers_that_are_not_positive():
    assert len(places(plot([(0, 0.0), (1, -3.0), (2, 1.0), (3, 10.0)], log_y=True))) == 2


def test_zero_is_on_the_axis_on_request():
    assert "0" in ticks(plot([(0, 90), (1, 100)], from_zero=True))
    assert "0" not in ticks(plot([(0, 90), (1, 100)]))


def test_a_plot_without_points_is_empty():
    assert plot([]).is_empty
    assert plot([(0, -1.0)], log_y=True).is_empty
    assert not plot([(0, 1.0)]).is_empty
    assert not Plot(title="", bars=[Bar(x=1, start=0, stop=2, color=1, hint="")]).is_empty


def test_bars_have_the_height_of_their_value_and_do_not_overlap():
    bars = [Bar(x=10.0 * i, start=0, stop=i, color=1, hint=f"bar {i}") for i in range(1, 5)]
    boxes = Plot(title="", bars=bars, x_range=(0, 50), from_zero=True).draw().hints
    for one, other in pairwise(boxes):
        assert one.x + one.width < other.x
    assert boxes[3].height == pytest.approx(4 * boxes[0].height)
    assert boxes[3].y + boxes[3].height == pytest.approx(HEIGHT - BOTTOM)


def test_bars_are_drawn_where_their_tooltips_are():
    bars = [Bar(x=1, start=0, stop=2, color=2, hint=""), Bar(x=2, start=-1, stop=0, color=2, hint="")]
    drawing = Plot(title="", bars=bars, from_zero=True).draw()
    variable = SERIES["#d9731a"][0]
    data = re.search(rf'<path d="([^"]*)"[^>]*style="fill: var\(--{variable}', drawing.svg)
    assert data is not None
    corners = [(float(x), float(y)) for x, y in re.findall(r"([\d.]+) ([\d.]+)", data.group(1))]
    for hint in drawing.hints:
        assert any(corner == pytest.approx((hint.x, hint.y), abs=0.02) for corner in corners)


def test_the_legend_names_what_is_drawn_and_nothing_else():
    series = [Series(label="seen", points=[(0, 1)], color=1), Series(label="absent", points=[], color=2)]
    band = Band(label="area", low=[(0, 1)], high=[(0, 2)], color=1)
    assert [label for label, _, _ in Plot(title="", series=series, bands=[band]).legend] == ["seen", "area"]
    assert Plot(title="", series=series).legend == []


def test_the_picture_is_well_formed_and_escapes_names():
    nasty = "<b>&\"'$x$"
    made = Plot(
        title=nasty,
        caption=nasty,
        series=[Series(label=nasty, points=[(0, 1), (1, 2)], color=1)],
        bars=[Bar(x=0, start=0, stop=1, color=1, hint=nasty)],
        bands=[Band(label=nasty, low=[(0, 1)], high=[(0, 2)], color=1)],
        marks=[0.5],
    )
    svg = made.draw().svg.replace("xlink:href", "href") + "</svg>"
    ET.fromstring(svg)
    assert "<b>" not in svg


def test_a_long_curve_has_tooltips_on_some_of_its_points():
    assert HINTS / 2 <= len(places(plot([(x, x) for x in range(5000)]))) <= HINTS


def test_the_same_plot_gives_the_same_picture():
    assert plot([(0, 1), (1, 2)]).draw().svg == plot([(0, 1), (1, 2)]).draw().svg


def test_smoothing_ignores_a_spike_and_keeps_a_line():
    line = [(float(x), float(x)) for x in range(20)]
    spiked = [(x, 1e6 if x == 10 else y) for x, y in line]
    assert max(y for _, y in smooth(spiked, 5)) < 20
    assert smooth(line, 5)[2:-2] == line[2:-2]
    assert smooth(line, 1) == line
    assert not math.isnan(smooth(line[:1], 5)[0][1])
