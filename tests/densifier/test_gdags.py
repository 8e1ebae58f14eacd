"""Laws of GDAGS: conflict between pixels leads to splits, agreement to clones."""

from dataclasses import replace

import pytest
import torch
from splats import make_gaussians

from cadam3d.build import component
from cadam3d.densifier.base import GradientSignal
from cadam3d.densifier.gdags import Gdags
from cadam3d.settings.compose import compose

CPU = torch.device("cpu")
STEP = 100  # of a refinement; only schedules depend on it


def gdags(**changes) -> Gdags:
    return replace(component(compose(["prompt=a red cube", "densifier=gdags"]).densifier), **changes)


def observed(densifier: Gdags, pixels: torch.Tensor):
    """Return the state after one step in which Gaussians have these gradients in pixels: p n 2."""
    signal = GradientSignal(
        means=torch.zeros(pixels.shape[1], 3),
        means2d=pixels.sum(dim=0)[None],
        radii=torch.ones(1, pixels.shape[1]),
        height=2,  # one pixel is one NDC unit
        width=2,
        absgrad=pixels.abs().sum(dim=0)[None],
    )
    return densifier.observe(densifier.init_state(pixels.shape[1], CPU), signal)


def coherence(pixels: torch.Tensor) -> torch.Tensor:
    return gdags().scores(observed(gdags(), pixels))["coherence"]


def noise(p: int, n: int) -> torch.Tensor:
    return torch.randn(p, n, 2, generator=torch.Generator().manual_seed(0))


def test_coherence_is_one_if_pixels_agree_and_zero_if_they_cancel():
    agree = noise(1, 9).expand(4, 9, 2)
    torch.testing.assert_close(coherence(agree), torch.ones(9))
    assert coherence(torch.cat([agree, -agree])).tolist() == [0] * 9
    assert coherence(torch.zeros(4, 1, 2)).tolist() == [0]


def test_coherence_is_at_most_a_factor_of_root_two_above_the_ratio_of_the_paper():
    pixels = noise(5, 1000)
    ratio = coherence(pixels) / (pixels.sum(dim=0).norm(dim=-1) / pixels.norm(dim=-1).sum(dim=0))
    assert ratio.min() > 0.999
    assert ratio.max() < 1.415


@pytest.mark.parametrize("pull", [0.5, 1.5])
def test_conflict_splits_large_gaussians_and_agreement_clones_small_ones(pull):
    """One threshold of 1, and a net gradient just below or above it, in two pixels that agree or conflict."""
    net = torch.tensor([pull, 0.0])
    agree, conflict = torch.stack([net / 2, net / 2]), torch.stack([net * 40, -net * 39])
    pixels = torch.stack([agree, conflict, agree, conflict], dim=1)
    gaussians = make_gaussians(4, log_scale=-9)
    gaussians.log_scales[:2] += 8  # above tau_scale
    densifier = gdags(tau_pos=1.0, tau_clone=1.0)
    refine = component(compose(["prompt=a red cube"]).refine)
    plan = densifier.plan(observed(densifier, pixels), gaussians, STEP, refine, torch.Generator())
    # With a weight of 0.8, agreement needs 1 / 0.8 for a split and 0.8 for a clone.
    assert plan.is_selected.tolist() == [pull * 0.8 >= 1, True, pull / 0.8 >= 1, False]


def test_a_weight_of_one_is_the_baseline():
    pixels, densifier = noise(3, 50), gdags(offset=1.0, scale=0.0, tau_pos=0.9, tau_clone=0.9)
    state = observed(densifier, pixels)
    expected = pixels.sum(dim=0).norm(dim=-1) >= 0.9
    assert torch.equal(densifier.select(state, STEP, torch.Generator()), expected)
