"""Laws of the disparity of a render output."""

import pytest
import torch
from splats import make_gaussians

from cadam3d.core.cameras import turntable
from cadam3d.core.rendering import RenderOutput
from cadam3d.rasterizer.reference import ReferenceRasterizer


def output(alpha: torch.Tensor, depth: torch.Tensor) -> RenderOutput:
    views = len(alpha)
    rgb = torch.zeros(*alpha.shape, 3)
    return RenderOutput(
        rgb=rgb, alpha=alpha, depth=depth, means2d=torch.zeros(views, 0, 2), radii=torch.zeros(views, 0)
    )


def scene() -> tuple[torch.Tensor, torch.Tensor]:
    """Return two views of a solid object at depths 2 to 4, with a faint rim and empty corners."""
    generator = torch.Generator().manual_seed(0)
    depth = 2 + 2 * torch.rand(2, 8, 8, generator=generator)
    alpha = torch.full((2, 8, 8), 0.95)
    alpha[:, 0], alpha[:, :, 0] = 0.0, 0.3
    depth[alpha == 0] = 0.0
    return alpha, depth


def test_disparity_is_one_at_the_nearest_and_zero_at_the_farthest_and_at_the_background():
    alpha, depth = scene()
    seen = output(alpha, depth).disparity()
    assert seen.amin() == 0
    assert torch.equal(seen.amax(dim=(1, 2)), torch.ones(2))
    assert not seen[alpha < 0.9].any()  # fainter than the farthest solid pixel
    for view in range(2):
        solid = alpha[view] >= 0.9
        order = depth[view][solid].argsort()
        assert (seen[view][solid][order].diff() <= 0).all()  # nearer pixels are brighter
        assert seen[view][solid].min() == 0


def test_disparity_does_not_depend_on_the_unit_of_length():
    alpha, depth = scene()
    torch.testing.assert_close(output(alpha, 7 * depth).disparity(), output(alpha, depth).disparity())


@pytest.mark.parametrize(("solid", "largest"), [(1.0, 1e-5), (0.99, 0.03)])
def test_disparity_of_an_opaque_object_is_luciddreamers(solid, largest):
    """Its background is at a depth of 10 of its units, which are 2 of ours; its cameras are at 5 of them."""
    alpha, depth = scene()
    alpha[alpha < 0.9], alpha[alpha >= 0.9] = 0.0, solid
    depth = 7 + depth  # 9 to 11
    inverse = 1 / (alpha * depth + 20 * (1 - alpha))
    farthest = inverse.masked_fill(alpha < 0.9, torch.inf).amin(dim=(1, 2), keepdim=True)
    theirs = ((inverse - farthest) / (inverse.amax(dim=(1, 2), keepdim=True) - farthest)).clamp(0, 1)
    assert (output(alpha, depth).disparity() - theirs).abs().max() < largest


@pytest.mark.parametrize("alpha", [0.0, 0.5, 1.0])
def test_the_disparity_of_nothing_or_of_a_wall_is_finite_with_finite_gradients(alpha):
    alphas = torch.full((1, 4, 4), alpha, requires_grad=True)
    depth = (3 * (alphas.detach() > 0).float()).requires_grad_()
    seen = output(alphas, depth).disparity()
    assert ((seen >= 0) & (seen <= 1)).all()
    seen.sum().backward()
    assert alphas.grad.isfinite().all()
    assert depth.grad.isfinite().all()
    if alpha == 0:
        assert not seen.any()


def test_gradients_of_disparity_reach_the_gaussians():
    gaussians = make_gaussians(40, opacity=4.0, spread=0.3).map(lambda tensor: tensor.requires_grad_())
    camera = turntable(1, elevation_deg=20.0, distance=3.0, fov_y_deg=40.0, size=16)
    seen = ReferenceRasterizer().render(gaussians, camera, torch.ones(1, 3)).disparity()
    (seen * torch.linspace(0, 1, 16)).sum().backward()
    for name in ("means", "log_scales", "opacity_logits"):
        gradient = gaussians.tensors()[name].grad
        assert gradient.isfinite().all()
        assert gradient.abs().max() > 0
