"""Plots put the numbers where the axes say."""

import math
import re
import xml.etree.ElementTree as ET

import pytest

from cadam3d.report.plot import (
    BOTTOM,
    HEIGHT,
    LEFT,
    RIGHT,
    TOP,
    WIDTH,
    Band,
    Bar,
    Chart,
    Curve,
    short,
    smooth,
)


def chart(points, **settings) -> Chart:
    return Chart(title="t", caption="c", curves=[Curve("a", points, 1)], **settings)


def polyline(svg: str) -> list[tuple[float, float]]:
    data = re.search(r'class="curve [^"]*" d="M([^"]*)"', svg)
    assert data is not None
    return [tuple(map(float, pair.split())) for pair in data.group(1).split("L")]


def ticks(svg: str) -> list[tuple[str, float]]:
    """Text and height of the labels of the y axis."""
    return [(text, float(y) - 4) for y, text in re.findall(r'y="([\d.]+)" text-anchor="end">([^<]+)<', svg)][
        :-1
    ]


@pytest.mark.parametrize("log_y", [False, True])
@pytest.mark.parametrize("points", [[(0, 1), (5, 30)], [(1, 2.0)], [(0, 7), (9, 7)], [(3, 1e-7), (4, 1e9)]])
def test_every_point_lies_inside_the_axes(points, log_y):
    for x, y in polyline(chart(points, log_y=log_y).svg()):
        assert LEFT - 0.1 <= x <= WIDTH - RIGHT + 0.1
        assert TOP - 0.1 <= y <= HEIGHT - BOTTOM + 0.1


@pytest.mark.parametrize("log_y", [False, True])
def test_a_point_at_a_tick_lies_at_its_label(log_y):
    svg = chart([(0, 1), (1, 10), (2, 100), (3, 1000)], log_y=log_y).svg()
    heights = {float(text.replace("k", "e3")): y for text, y in ticks(svg)}
    assert heights[1000.0] == pytest.approx(polyline(svg)[3][1], abs=0.11)
    if log_y:
        assert heights[100.0] == pytest.approx(polyline(svg)[2][1], abs=0.11)


def test_larger_is_higher_and_later_is_further_right():
    svg = chart([(x, x * x) for x in range(1, 6)]).svg()
    xs, ys = zip(*polyline(svg), strict=True)
    assert list(xs) == sorted(xs)
    assert list(ys) == sorted(ys, reverse=True)


@pytest.mark.parametrize("high", [1e-6, 0.3, 1.0, 7.0, 999.0, 3.3e6])
def test_there_are_a_few_round_ticks_whatever_the_range(high):
    labels = [text for text, _ in ticks(chart([(0, 0.0), (1, high)]).svg())]
    assert 3 <= len(labels) <= 8
    assert len(set(labels)) == len(labels)


@pytest.mark.parametrize("decades", [0.1, 0.5, 0.9, 1.5, 3, 9, 30])
def test_logarithmic_axes_have_ticks_whatever_the_range(decades):
    labels = [text for text, _ in ticks(chart([(0, 1e-3), (1, 1e-3 * 10**decades)], log_y=True).svg())]
    assert 2 <= len(labels) <= 8


def test_a_logarithm_leaves_out_what_it_cannot_show():
    assert len(polyline(chart([(0, 0.0), (1, -3.0), (2, 1.0), (3, 10.0)], log_y=True).svg())) == 2


def test_zero_is_on_the_axis_where_asked():
    assert "0" in [text for text, _ in ticks(chart([(0, 90), (1, 100)], zero=True).svg())]
    assert "0" not in [text for text, _ in ticks(chart([(0, 90), (1, 100)]).svg())]


def test_a_chart_without_points_is_empty():
    assert chart([]).is_empty()
    assert chart([(0, -1.0)], log_y=True).is_empty()
    assert not chart([(0, 1.0)]).is_empty()
    assert not Chart(title="", caption="", bars=[Bar(1, 0, 2, 1, "")]).is_empty()


def test_bars_stand_on_their_value_and_do_not_overlap():
    bars = [Bar(10.0 * i, 0, i, 1, f"bar {i}") for i in range(1, 5)]
    svg = Chart(title="", caption="", bars=bars, x_range=(0, 50), zero=True).svg()
    boxes = re.findall(r'<rect [^>]*x="([\d.]+)" y="([\d.]+)" width="([\d.]+)" height="([\d.]+)"', svg)
    lefts, _, widths, heights = (list(map(float, column)) for column in zip(*boxes, strict=True))
    assert all(left + width < right for left, width, right in zip(lefts, widths, lefts[1:], strict=False))
    assert heights[3] == pytest.approx(4 * heights[0], rel=0.02)


def test_the_legend_names_what_is_drawn_and_only_that():
    curves = [Curve("seen", [(0, 1)], 1), Curve("absent", [], 2)]
    both = Chart(title="", caption="", curves=curves, bands=[Band("area", [(0, 1)], [(0, 2)], 1)]).legend()
    assert "seen" in both
    assert "area" in both
    assert "absent" not in both
    assert Chart(title="", caption="", curves=curves).legend() == ""


def test_names_are_escaped_and_the_picture_is_well_formed():
    nasty = "<b>&\"'"
    made = Chart(
        title=nasty,
        caption=nasty,
        curves=[Curve(nasty, [(0, 1), (1, 2)], 1)],
        bars=[Bar(0, 0, 1, 1, nasty)],
        bands=[Band(nasty, [(0, 1)], [(0, 2)], 1)],
        ticks_at=[0.5],
    )
    ET.fromstring(made.svg())
    ET.fromstring(made.legend())


@pytest.mark.parametrize(
    ("value", "text"),
    [(0, "0"), (1e-17, "0"), (12300, "12.3k"), (-50, "-50"), (2e6, "2M"), (1.2e-4, "1.2e-4"), (0.25, "0.25")],
)
def test_numbers_are_written_short(value, text):
    assert short(value) == text


def test_smoothing_ignores_a_spike_and_keeps_a_line():
    line = [(float(x), float(x)) for x in range(20)]
    spiked = [(x, 1e6 if x == 10 else y) for x, y in line]
    assert max(y for _, y in smooth(spiked, 5)) < 20
    assert smooth(line, 5)[2:-2] == line[2:-2]
    assert smooth(line, 1) == line
    assert not math.isnan(smooth(line[:1], 5)[0][1])
