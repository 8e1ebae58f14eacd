"""Laws of the charts that densifiers declare: each number that they log is drawn, and no other."""

import pytest
import torch

from cadam3d.build import component
from cadam3d.densifier.base import GradientSignal
from cadam3d.settings.compose import compose
from cadam3d.settings.options import config_dir

CPU = torch.device("cpu")
OPTIONS = sorted(path.stem for path in (config_dir() / "densifier").glob("*.yaml"))


def build(name: str):
    lines = ["densifier.tau_m=1e-4"] if name == "cadam_momentum" else []
    return component(compose(["prompt=a red cube", f"densifier={name}", *lines]).densifier)


def statistics(name: str) -> dict[str, float]:
    """Return the statistics of 50 Gaussians after 30 steps of noise."""
    draw, densifier = torch.Generator().manual_seed(0), build(name)
    state = densifier.init_state(50, CPU)
    for _ in range(30):
        signal = GradientSignal(
            means=torch.randn(50, 3, generator=draw),
            means2d=torch.randn(2, 50, 2, generator=draw),
            radii=torch.ones(2, 50),
            height=8,
            width=8,
            absgrad=torch.rand(2, 50, 2, generator=draw),
        )
        state = densifier.observe(state, signal)
    return densifier.statistics(state, step=30)


@pytest.mark.parametrize("name", OPTIONS)
def test_the_charts_show_all_statistics_and_nothing_else(name):
    drawn = set()
    for chart in build(name).charts():
        drawn |= {curve.key for curve in chart.curves} | set(chart.band or ())
    assert drawn == set(statistics(name))


@pytest.mark.parametrize("name", OPTIONS)
def test_a_chart_has_a_title_a_caption_and_labels_if_it_has_several_curves(name):
    charts = build(name).charts()
    assert len({chart.title for chart in charts}) == len(charts)
    for chart in charts:
        assert chart.title
        assert chart.caption.endswith(".")
        assert len(chart.curves) == 1 or all(curve.label for curve in chart.curves)
        assert (chart.band is None) == (chart.band_label == "")
