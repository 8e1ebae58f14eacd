"""Laws of every densifier: pure, quiet without Gaussians, and with a chart of each number that it logs."""

from copy import deepcopy
from functools import cache
from math import isfinite

import pytest
import torch

from cadam3d.build import component
from cadam3d.densifier.base import GradientSignal
from cadam3d.settings.compose import compose
from cadam3d.settings.options import config_dir

CPU = torch.device("cpu")
OPTIONS = sorted(path.stem for path in (config_dir() / "densifier").glob("*.yaml"))


@cache
def build(name: str):
    lines = ["densifier.tau_m=1e-4"] if name == "cadam_momentum" else []
    return component(compose(["prompt=a red cube", f"densifier={name}", *lines]).densifier)


def noise(n: int, draw: torch.Generator) -> GradientSignal:
    return GradientSignal(
        means=torch.randn(n, 3, generator=draw),
        means2d=torch.randn(2, n, 2, generator=draw),
        radii=torch.ones(2, n),
        height=8,
        width=8,
        absgrad=torch.rand(2, n, 2, generator=draw),
    )


def observed(name: str, n: int, steps: int = 30):
    """Return the state of ``n`` Gaussians after steps of noise."""
    draw, state = torch.Generator().manual_seed(0), build(name).init_state(n, CPU)
    for _ in range(steps):
        state = build(name).observe(state, noise(n, draw))
    return state


def same(left, right) -> bool:
    pairs = [(value, vars(right)[key]) for key, value in vars(left).items()]
    return all(torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b for a, b in pairs)


@pytest.mark.parametrize("name", OPTIONS)
def test_observe_modifies_neither_the_old_state_nor_the_signal(name):
    state, signal = observed(name, 5, steps=3), noise(5, torch.Generator().manual_seed(1))
    before, evidence = deepcopy(state), deepcopy(signal)
    build(name).observe(state, signal)
    assert same(state, before)
    assert same(signal, evidence)


@pytest.mark.parametrize("name", OPTIONS)
def test_choices_depend_on_the_generator_and_not_on_the_global_state(name):
    state, chosen, rng = observed(name, 50), [], torch.random.get_rng_state()
    for _ in range(2):
        chosen.append(build(name).select(state, 100, torch.Generator().manual_seed(3)))
    assert torch.equal(*chosen)
    assert torch.equal(torch.random.get_rng_state(), rng)


@pytest.mark.parametrize("name", OPTIONS)
def test_an_empty_scene_has_empty_masks_and_finite_statistics(name):
    state, densifier = observed(name, 0), build(name)
    assert densifier.select(state, 100, torch.Generator()).shape == (0,)
    assert densifier.unreliable(state).shape == (0,)
    assert all(isfinite(value) for value in densifier.statistics(state, 100).values())


@pytest.mark.parametrize("name", OPTIONS)
def test_the_charts_show_all_statistics_and_nothing_else(name):
    drawn = set()
    for chart in build(name).charts():
        drawn |= {curve.key for curve in chart.curves} | set(chart.band or ())
    assert drawn == set(build(name).statistics(observed(name, 50), step=30))


@pytest.mark.parametrize("name", OPTIONS)
def test_a_chart_has_a_title_a_caption_and_labels_if_it_has_several_curves(name):
    charts = build(name).charts()
    assert len({chart.title for chart in charts}) == len(charts)
    for chart in charts:
        assert chart.title
        assert chart.caption.endswith(".")
        assert len(chart.curves) == 1 or all(curve.label for curve in chart.curves)
        assert (chart.band is None) == (chart.band_label == "")
