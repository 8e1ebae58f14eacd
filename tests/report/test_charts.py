"""Charts draw every number at its place on the axes."""

import re

import pytest

from cadam3d.core.chart import Chart, Curve
from cadam3d.core.palette import SERIES
from cadam3d.io.records import counts
from cadam3d.report.charts import BOTTOM, HEIGHT, LEFT, RIGHT, TOP, WIDTH, draw


def chart(**settings) -> Chart:
    return Chart(title="t", caption="", curves=(Curve(key="a"),), **settings)


def lines_of(points) -> list[dict]:
    return [{"step": step, "a": value} for step, value in points]


def curve(svg: str) -> list[tuple[float, float]]:
    """Return the points of the first curve as it is drawn."""
    variable = SERIES["#2a6fdb"][0]
    data = re.search(rf'<path d="([^"]*)"[^>]*style="fill: none; stroke: var\(--{variable}', svg)
    assert data is not None
    return [(float(x), float(y)) for x, y in re.findall(r"([\d.]+) ([\d.]+)", data.group(1))]


def labels(svg: str) -> list[str]:
    return [text for text in re.findall(r"<text[^>]*>([^<]+)<", svg) if text != "step"]


@pytest.mark.parametrize("log_y", [False, True])
@pytest.mark.parametrize("points", [[(0, 1), (5, 30)], [(0, 7), (9, 7)], [(3, 1e-7), (4, 1e9)]])
def test_every_point_is_inside_the_axes_and_axes_have_labels(points, log_y):
    drawn = draw(chart(log_y=log_y), lines_of(points), 10)
    assert drawn is not None
    for x, y in curve(drawn.svg):
        assert LEFT - 0.1 <= x <= WIDTH - RIGHT + 0.1
        assert TOP - 0.1 <= y <= HEIGHT - BOTTOM + 0.1
    assert len(labels(drawn.svg)) >= 5


def test_larger_is_higher_and_later_is_further_right():
    drawn = draw(chart(), lines_of([(0, 1), (10, 2), (20, 5)]), 20)
    assert drawn is not None
    (x0, y0), (x1, y1), (x2, y2) = curve(drawn.svg)
    assert x1 - x0 == pytest.approx(x2 - x1, abs=0.1)
    assert y0 - y1 == pytest.approx((y1 - y2) / 3, abs=0.1)
    assert x0 == pytest.approx(LEFT, abs=0.1)


def test_a_logarithmic_axis_leaves_out_numbers_that_are_not_positive():
    drawn = draw(chart(log_y=True), lines_of([(0, 1), (1, 0), (2, -1), (3, 10)]), 3)
    assert drawn is not None
    assert len(curve(drawn.svg)) == 2
    assert draw(chart(log_y=True), lines_of([(0, 0)]), 3) is None


@pytest.mark.parametrize("lines", [[], [{}], [{"step": 1}], [{"step": 1, "a": "much"}], [{"a": 2}]])
def test_without_numbers_there_is_no_chart(lines):
    assert draw(chart(), lines, 1) is None


def test_the_legend_names_what_is_drawn_and_nothing_else():
    curves = (Curve(key="a", label="first"), Curve(key="b"), Curve(key="t", label="gate", is_threshold=True))
    several = Chart(title="t", caption="", curves=curves, band=("low", "high"), band_label="range")
    line = {"step": 1, "a": 1.0, "t": 2.0, "low": 0.5, "high": 1.5}
    drawn = draw(several, [line, {**line, "step": 2}], 2)
    assert drawn is not None
    assert drawn.legend == [("first", "plain", 1), ("gate", "dashed", 4), ("range", "area", 1)]
    alone = draw(chart(), lines_of([(1, 2.0)]), 2)
    assert alone is not None
    assert alone.legend == []


def test_a_refinement_is_a_jump_of_the_count_at_its_step():
    metrics = [
        {"kind": "step", "step": 50, "num_gaussians": 2000},
        {"kind": "refine", "step": 100, "before": 2000, "after": 2080},
        {"kind": "step", "step": 100, "num_gaussians": 2000},
        {"kind": "step", "step": 150, "num_gaussians": 2080},
    ]
    assert counts(metrics) == [*((50, 2000), (100, 2000), (100, 2000), (100, 2080), (150, 2080))]
