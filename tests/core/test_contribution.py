"""Laws of contributions and ghosts: what shows counts, what is alone in empty space is a ghost."""

import torch

from cadam3d.core.contribution import around, contributions, ghosts
from cadam3d.core.gaussians import Gaussians, concatenate
from cadam3d.rasterizer.reference import ReferenceRasterizer

RENDER = ReferenceRasterizer().render


def at(means: torch.Tensor, opacity: float, scale: float = 0.06) -> Gaussians:
    n = len(means)
    return Gaussians(
        means=means,
        log_scales=torch.full((n, 3), scale).log(),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(n, 1),
        opacity_logits=torch.full((n,), opacity).logit(),
        sh=torch.zeros(n, 1, 3),
    )


def ball(opacity: float, count: int = 150, radius: float = 0.3) -> Gaussians:
    direction = torch.nn.functional.normalize(
        torch.randn(count, 3, generator=torch.Generator().manual_seed(0)), dim=1
    )
    return at(radius * direction, opacity)


def test_faint_gaussians_beside_a_solid_object_are_ghosts_and_the_object_is_none():
    faint = at(torch.tensor([[0.7, 0.0, 0.0], [0.0, -0.6, 0.2], [0.0, 0.0, 0.65]]), 0.1)
    marked = ghosts(concatenate([ball(0.8), faint]), RENDER, 0.3)
    assert marked.nonzero()[:, 0].tolist() == [150, 151, 152]


def test_a_small_solid_part_beside_the_object_is_no_ghost():
    solid = at(torch.tensor([[0.7, 0.0, 0.0]]), 0.95)
    assert not ghosts(concatenate([ball(0.8), solid]), RENDER, 0.3).any()


def test_a_transparent_object_is_no_ghost():
    assert not ghosts(ball(0.02), RENDER, 0.3).any()


def test_a_gaussian_that_no_view_shows_is_no_ghost():
    hidden = at(torch.tensor([[0.0, 0.0, 50.0]]), 0.5)
    assert not ghosts(concatenate([ball(0.8), hidden]), RENDER, 0.3).any()
    assert ghosts(at(torch.zeros(0, 3), 0.5), RENDER, 0.3).shape == (0,)


def test_contributions_add_up_to_the_alpha_of_the_pictures_and_hidden_gaussians_have_none():
    hidden = at(torch.zeros(1, 3), 0.9)
    scene = concatenate([at(0.05 * torch.eye(3), 0.99, scale=0.2), hidden, ball(0.5)])
    found = contributions(scene, RENDER)
    assert found[3] < 0.01 * found[:3].mean()
    alpha = [RENDER(scene, cameras, torch.zeros(len(cameras), 3)).alpha.sum() for cameras in around(4)]
    torch.testing.assert_close(found.sum(), sum(alpha), rtol=1e-4, atol=0)
