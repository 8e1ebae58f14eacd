"""Laws of the regularizers."""

import math

import pytest
import torch

from cadam3d.core.gaussians import Gaussians
from cadam3d.core.rendering import RenderOutput
from cadam3d.core.schedule import Linear
from cadam3d.regularizer import (
    AlphaEntropy,
    DisparityVariation,
    MeanOpacity,
    MeanScale,
    OutsideBall,
    Sparsity,
    SquaredVariation,
    TotalVariation,
)

EVERY = [
    MeanScale(weight=2.0),
    MeanOpacity(weight=2.0),
    OutsideBall(weight=2.0, radius=1.0),
    AlphaEntropy(weight=2.0),
    Sparsity(weight=2.0),
    TotalVariation(weight=2.0),
    SquaredVariation(weight=2.0),
    DisparityVariation(weight=2.0),
]
NAMES = [type(each).__name__ for each in EVERY]


def gaussians(means: torch.Tensor, scale: float = 0.1) -> Gaussians:
    n = len(means)
    return Gaussians(
        means=means,
        log_scales=torch.full((n, 3), math.log(scale)),
        quats=torch.ones(n, 4),
        opacity_logits=torch.zeros(n),
        sh=torch.zeros(n, 1, 3),
    )


def output(rgb: torch.Tensor | None = None, alpha: torch.Tensor | None = None) -> RenderOutput:
    if rgb is None:
        rgb = torch.zeros(*(alpha.shape if alpha is not None else (1, 4, 4)), 3)
    alpha = torch.zeros(rgb.shape[:3]) if alpha is None else alpha
    views = len(alpha)
    return RenderOutput(
        rgb=rgb, alpha=alpha, depth=2 + alpha, means2d=torch.zeros(views, 0, 2), radii=torch.zeros(views, 0)
    )


def noise(*shape: int) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(0))


def at(regularizer, means=None, rgb=None, alpha=None, step: int = 0) -> float:
    means = torch.zeros(2, 3) if means is None else means
    return float(regularizer(gaussians(means), output(rgb, alpha), step))


@pytest.mark.parametrize("regularizer", EVERY, ids=NAMES)
def test_the_weight_multiplies_and_may_follow_the_step(regularizer):
    scene = gaussians(noise(5, 3) * 4)
    seen = output(noise(2, 6, 6, 3), noise(2, 6, 6))
    fields = {"radius": 1.0} if isinstance(regularizer, OutsideBall) else {}
    fading = type(regularizer)(weight=Linear(start=2.0, end=0.0, steps=10), **fields)
    full = float(regularizer(scene, seen, 0))
    assert full > 0
    assert [float(fading(scene, seen, step)) for step in (0, 5, 10)] == pytest.approx([full, full / 2, 0.0])


@pytest.mark.parametrize("regularizer", EVERY, ids=NAMES)
def test_an_empty_scene_gives_a_finite_penalty(regularizer):
    assert math.isfinite(at(regularizer, means=torch.zeros(0, 3)))


@pytest.mark.parametrize("regularizer", EVERY, ids=NAMES)
@pytest.mark.parametrize("extreme", [0.0, 1.0])
def test_gradients_are_finite_at_the_extremes(regularizer, extreme):
    scene = gaussians(torch.zeros(2, 3)).map(lambda tensor: tensor.requires_grad_())
    rgb = torch.full((1, 4, 4, 3), extreme, requires_grad=True)
    alpha = torch.full((1, 4, 4), extreme, requires_grad=True)
    (regularizer(scene, output(rgb, alpha), 0) + 0 * (rgb.sum() + alpha.sum() + scene.means.sum())).backward()
    assert all(tensor.grad.isfinite().all() for tensor in (rgb, alpha, scene.means))


def test_mean_scale_is_the_mean_standard_deviation():
    scene = gaussians(torch.zeros(2, 3))
    scene.log_scales[1] = math.log(0.3)
    assert float(MeanScale(weight=1.0)(scene, output(), 0)) == pytest.approx(0.2)


def test_the_penalty_is_zero_in_the_ball_and_the_squared_distance_outside():
    ball = OutsideBall(weight=1.0, radius=0.5)
    assert at(ball, means=torch.tensor([[0.5, 0.0, 0.0], [0.0, 0.2, 0.0]])) == 0
    assert at(ball, means=torch.tensor([[0.0, 0.0, 1.5], [0.0, 0.0, 0.0]])) == pytest.approx(0.5)


def test_fog_has_the_largest_entropy_and_a_clean_silhouette_has_none():
    entropy = AlphaEntropy(weight=1.0)
    silhouette = (noise(1, 8, 8) > 0.5).float()
    assert at(entropy, alpha=silhouette) == pytest.approx(0.0, abs=1e-3)
    assert at(entropy, alpha=torch.full((1, 8, 8), 0.5)) == pytest.approx(math.log(2), rel=1e-5)
    assert at(entropy, alpha=torch.full((1, 8, 8), 0.2)) < math.log(2)


def test_total_variation_is_the_mean_step_between_neighbours():
    ramp = torch.linspace(0, 1, 5)[None, None, :, None].expand(2, 5, 5, 3).contiguous()
    variation = TotalVariation(weight=1.0)
    assert at(variation, rgb=torch.ones(2, 5, 5, 3)) == 0
    assert at(variation, rgb=ramp) == pytest.approx(0.25)  # 0 vertically, 1 / 4 horizontally
    assert at(variation, rgb=ramp + 0.5 * ramp.transpose(1, 2)) == pytest.approx(0.375)


def test_squared_variation_is_the_published_formula():
    images = noise(3, 6, 5, 3)
    channels = images.permute(0, 3, 1, 2)
    rows, columns = channels[:, :, 1:] - channels[:, :, :-1], channels[..., 1:] - channels[..., :-1]
    published = 2 * (rows.square().sum() / (3 * 5 * 5) + columns.square().sum() / (3 * 6 * 4)) / 3
    assert at(SquaredVariation(weight=1.0), rgb=images) == pytest.approx(float(published))
    assert at(SquaredVariation(weight=1.0), rgb=torch.ones(2, 5, 5, 3)) == 0


def test_disparity_variation_is_the_squared_variation_of_the_disparity_alone():
    rgb, alpha = noise(2, 6, 6, 3), 0.9 + 0.1 * noise(2, 6, 6)
    grey = output(rgb, alpha).disparity()[..., None].repeat(1, 1, 1, 3)
    variation = at(DisparityVariation(weight=1.0), rgb=rgb, alpha=alpha)
    assert variation == pytest.approx(at(SquaredVariation(weight=1.0), rgb=grey))
    assert variation > 0
    assert at(DisparityVariation(weight=1.0), rgb=0 * rgb, alpha=alpha) == variation
