"""Laws of the baseline, 3DGS adaptive density control (paper eq. 1)."""

import math

import pytest
import torch

from cadam3d.build import component
from cadam3d.core.edit import RowEdit
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.schedule import Linear, as_schedule
from cadam3d.densifier.base import GradientSignal
from cadam3d.densifier.baseline import VIEWS, Baseline
from cadam3d.settings.compose import compose

CPU = torch.device("cpu")
STEP = 100  # of a refinement; only schedules depend on it
DRAWS = torch.Generator()  # nothing here draws from it


def baseline(**changes) -> Baseline:
    return Baseline(
        **{"tau_pos": 2e-4, "views": "sum_norm", "grad_multiplier": 1.0, "screen_px": None, **changes}
    )


def signal(means2d: torch.Tensor, visible: torch.Tensor | None = None, height=2, width=2) -> GradientSignal:
    """Return a signal; at 2 x 2 pixels one pixel is one NDC unit."""
    visible = torch.ones(means2d.shape[:2], dtype=torch.bool) if visible is None else visible
    return GradientSignal(
        means=torch.zeros(means2d.shape[1], 3),
        means2d=means2d,
        radii=visible.float(),
        height=height,
        width=width,
    )


def mean_norms(densifier: Baseline, *signals: GradientSignal) -> torch.Tensor:
    state = densifier.init_state(signals[0].means.shape[0], CPU)
    for one in signals:
        state = densifier.observe(state, one)
    return densifier.scores(state)["mean_norm"]


def gradients(views: int, n: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(views, n, 2, generator=torch.Generator().manual_seed(seed))


def test_the_criterion_is_the_mean_norm_over_steps():
    steps = [gradients(1, 5, seed) for seed in range(4)]
    expected = torch.stack([step[0].norm(dim=-1) for step in steps]).mean(dim=0)
    torch.testing.assert_close(mean_norms(baseline(), *map(signal, steps)), expected)


def test_steps_that_do_not_see_a_gaussian_do_not_dilute_its_mean():
    seen, unseen = torch.tensor([[True]]), torch.tensor([[False]])
    once = signal(torch.full((1, 1, 2), 1.0), seen)
    never = signal(torch.full((1, 1, 2), 1.0), unseen)
    torch.testing.assert_close(mean_norms(baseline(), once, never, never), mean_norms(baseline(), once))


@pytest.mark.parametrize("views", VIEWS)
def test_the_criterion_does_not_depend_on_the_image_size(views):
    densifier, pixel = baseline(views=views), gradients(2, 6)
    small = mean_norms(densifier, signal(pixel, height=50, width=40))
    # The same scene with finer pixels.
    large = mean_norms(densifier, signal(pixel / 4, height=200, width=160))
    torch.testing.assert_close(small, large)


@pytest.mark.parametrize("views", ["sum_norm", "sum_vector"])
def test_the_order_of_the_views_in_a_batch_is_irrelevant(views):
    pixel, visible = gradients(4, 9), torch.rand(4, 9, generator=torch.Generator().manual_seed(1)) > 0.4
    order = torch.tensor([2, 0, 3, 1])
    straight = mean_norms(baseline(views=views), signal(pixel, visible))
    shuffled = mean_norms(baseline(views=views), signal(pixel[order], visible[order]))
    torch.testing.assert_close(straight, shuffled)


def test_the_views_of_a_batch_combine_as_chosen():
    pixel = torch.tensor([[[3.0, 0.0]], [[0.0, 4.0]], [[-6.0, 0.0]]])
    visible = torch.tensor([[True], [True], [True]])
    expected = {"sum_norm": 13 / 3, "sum_vector": 5.0, "last": 6.0}
    for views, norm in expected.items():
        assert float(mean_norms(baseline(views=views), signal(pixel, visible))) == pytest.approx(norm)


def test_a_schedule_of_the_threshold_is_followed():
    norms = torch.tensor([[[0.5, 0.0], [0.25, 0.0], [0.125, 0.0]]])
    densifier = baseline(tau_pos=Linear(start=0.125, end=0.5, begin=100, steps=150))
    state = densifier.observe(densifier.init_state(3, CPU), signal(norms))
    for step, selected in ((1, 3), (100, 3), (150, 2), (250, 1), (10_000, 1)):
        assert int(densifier.select(state, step, DRAWS).sum()) == selected
        numbers = densifier.statistics(state, step)
        assert numbers["share_above_tau_pos"] == pytest.approx(selected / 3)
        assert numbers["tau_pos"] == as_schedule(densifier.tau_pos)(step)


def test_the_accumulators_are_cleared_by_every_refinement():
    state = baseline().observe(baseline().init_state(4, CPU), signal(gradients(1, 4)))
    child = Gaussians(
        means=torch.zeros(1, 3),
        log_scales=torch.zeros(1, 3),
        quats=torch.ones(1, 4),
        opacity_logits=torch.zeros(1),
        sh=torch.zeros(1, 1, 3),
    )
    after = state.carry(RowEdit(keep=torch.tensor([0, 1, 3]), children=child, parents=torch.tensor([2])))
    assert after.norm_sum.tolist() == [0.0] * 4
    assert after.sightings.tolist() == [0] * 4


@pytest.mark.parametrize("bad", [math.nan, math.inf])
@pytest.mark.parametrize("views", VIEWS)
def test_a_gradient_that_is_not_finite_counts_as_not_seen(views, bad):
    pixel, visible = gradients(2, 3), torch.ones(2, 3, dtype=torch.bool)
    broken, hidden = pixel.clone(), visible.clone()
    broken[1, 2, 0], hidden[1, 2] = bad, False
    densifier = baseline(views=views)
    torch.testing.assert_close(
        mean_norms(densifier, signal(broken, visible)), mean_norms(densifier, signal(pixel, hidden))
    )


def test_a_gaussian_too_large_on_screen_in_any_view_is_unwanted_until_the_next_refinement():
    first, second = torch.tensor([[30.0, 3.0, 20.0], [0.0, 9.0, 1.0]]), torch.tensor([[2.0, 25.0, 0.0]])
    shipped, intended = baseline(), baseline(screen_px=20.0)
    state = intended.init_state(3, CPU)
    for radii in (first, second):
        signal = GradientSignal(
            means=torch.zeros(3, 3),
            means2d=torch.zeros(len(radii), 3, 2),
            radii=radii,
            height=64,
            width=64,
        )
        state = intended.observe(state, signal)
    assert intended.unwanted(state).tolist() == [True, True, False]  # 20 itself is not too large
    assert shipped.unwanted(state) is None
    nothing = Gaussians(
        means=torch.zeros(0, 3),
        log_scales=torch.zeros(0, 3),
        quats=torch.ones(0, 4),
        opacity_logits=torch.zeros(0),
        sh=torch.zeros(0, 1, 3),
    )
    after = state.carry(RowEdit(keep=torch.tensor([0, 1]), children=nothing, parents=torch.arange(0)))
    assert intended.unwanted(after).tolist() == [False, False]


def test_statistics_are_computed_from_the_mean_norms():
    pixel = torch.zeros(1, 11, 2)
    pixel[0, :, 0] = torch.arange(11) * 1e-4
    numbers = baseline(tau_pos=4.5e-4).statistics(
        baseline().observe(baseline().init_state(11, CPU), signal(pixel)), STEP
    )
    assert numbers["gradient_p10"] == pytest.approx(1e-4)
    assert numbers["gradient_p50"] == pytest.approx(5e-4)
    assert numbers["gradient_p90"] == pytest.approx(9e-4)
    assert numbers["share_above_tau_pos"] == pytest.approx(6 / 11)


@pytest.mark.parametrize("experiment", ["bench", "objects", "luciddreamer"])
def test_the_annealed_threshold_is_the_standard_one_when_cadams_quantile_is_half_way(experiment):
    threshold, quantile = (
        component(compose(["prompt=a cube", f"experiment={experiment}", f"densifier={name}"]).densifier)
        for name in ("baseline_annealed", "cadam_annealed")
    )
    begin, steps = quantile.tau_Q.begin, quantile.tau_Q.steps
    found = [threshold.tau_pos(begin + steps * share) for share in (-1, 0, 0.5, 1, 2)]
    assert found == pytest.approx([1e-4, 1e-4, 2e-4, 4e-4, 4e-4])
