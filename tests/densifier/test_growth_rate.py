"""Laws of the growth rate: the count follows it up to the cap, whatever the scale of the gradients."""

import pytest
import torch

from cadam3d.build import component
from cadam3d.densifier.base import GradientSignal
from cadam3d.densifier.growth_rate import GrowthRate
from cadam3d.settings.compose import compose

CPU = torch.device("cpu")
STEP = 100  # of a refinement; only schedules depend on it


def selected(pulls: torch.Tensor, rate: float, cap: int = 10**6) -> torch.Tensor:
    densifier = GrowthRate(rate=rate, cap=cap, views="sum_norm", grad_multiplier=1.0, screen_px=None)
    signal = GradientSignal(
        means=torch.zeros(len(pulls), 3),
        means2d=pulls[None],
        radii=torch.ones(1, len(pulls)),
        height=2,
        width=2,
    )
    state = densifier.observe(densifier.init_state(len(pulls), CPU), signal)
    return densifier.select(state, STEP, torch.Generator())


def gradients(n: int) -> torch.Tensor:
    return torch.randn(n, 2, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("rate", [0.0, 0.1, 0.5, 0.999])
@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
def test_the_largest_gradients_grow_as_many_as_the_rate_asks_for(rate, scale):
    pulls = gradients(500)
    largest = pulls.norm(dim=-1).topk(int(rate * 500)).indices
    expected = torch.zeros(500, dtype=torch.bool).index_fill(0, largest, True)
    assert torch.equal(selected(pulls * scale, rate), expected)


@pytest.mark.parametrize(("cap", "expected"), [(100, 0), (500, 0), (501, 1), (600, 100), (10_000, 250)])
def test_the_cap_is_reached_and_not_exceeded(cap, expected):
    assert int(selected(gradients(500), 0.5, cap).sum()) == expected


def test_gaussians_without_a_gradient_do_not_grow():
    pulls = gradients(10).index_fill(0, torch.arange(8), 0.0)
    assert selected(pulls, 0.5).nonzero()[:, 0].tolist() == [8, 9]


def test_the_cap_of_the_package_is_five_times_the_initial_count():
    assert (
        component(compose(["prompt=a cube", "densifier=growth_rate", "experiment=bench"]).densifier).cap
        == 1500
    )
