"""Laws of the ball initializer."""

import pytest
import torch

from cadam3d.core.gaussians import Gaussians
from cadam3d.core.sh import SH_C0
from cadam3d.initializer.ball import Ball

CPU = torch.device("cpu")


def ball(**changes) -> Ball:
    usual = {
        "count": 500,
        "radius": 0.5,
        "scale": None,
        "scale_law": "mean",
        "opacity": 0.1,
        "sh_degree": 1,
        "color": [0.5, 0.4, 0.3],
        "color_noise": 0.1,
    }
    return Ball(**{**usual, **changes})


def build(seed: int = 0, **changes) -> Gaussians:
    return ball(**changes).build("anything", torch.Generator().manual_seed(seed), CPU)


def test_points_fill_the_ball_with_equal_density():
    radii = build(count=20_000, scale=0.1).means.norm(dim=-1)
    assert radii.max() <= 0.5 + 1e-6
    for share in (0.1, 0.5, 0.9):
        inside = float((radii < 0.5 * share ** (1 / 3)).float().mean())
        assert inside == pytest.approx(share, abs=0.01)


def test_no_direction_is_preferred():
    means = build(count=20_000, scale=0.1).means
    torch.testing.assert_close(means.mean(dim=0), torch.zeros(3), atol=0.01, rtol=0)
    second = means.T @ means / len(means)
    torch.testing.assert_close(second, torch.eye(3) * 0.25 / 5, atol=2e-3, rtol=0)


def test_colors_scatter_around_the_mean_within_the_noise():
    rgb = 0.5 + SH_C0 * build(count=5000, scale=0.1).sh[:, 0]
    center = torch.tensor([0.5, 0.4, 0.3])
    torch.testing.assert_close(rgb.mean(dim=0), center, atol=0.01, rtol=0)
    assert float((rgb - center).abs().max()) == pytest.approx(0.1, abs=1e-3)


def test_scale_opacity_and_degree_are_as_requested():
    made = build()
    assert len(made) == 500
    assert made.sh_degree == 1
    assert not made.sh[:, 1:].any()
    torch.testing.assert_close(made.opacities, torch.full((500,), 0.1))


def test_neighbouring_gaussians_just_overlap_by_default():
    scales = build(count=4000).scales.mean()
    # The spacing of as many points on a grid in this ball.
    spacing = 0.5 * (4 / 3 * torch.pi / 4000) ** (1 / 3)
    assert 0.5 * spacing < scales < 1.5 * spacing


def test_results_depend_on_the_generator_alone():
    assert torch.equal(build(seed=1).means, build(seed=1).means)
    assert not torch.equal(build(seed=1).means, build(seed=2).means)
