"""Gradients of the reference rasterizer, compared with finite differences in float64.

The image has steps where a contribution crosses 1/255 and where a pixel stops. A finite difference across a
step would be wrong by many orders of magnitude, so a passing test proves that its scene is not near one.
"""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.autograd import gradcheck

from cadam3d.core.cameras import Cameras, orbit
from cadam3d.core.gaussians import FIELDS, Gaussians
from cadam3d.core.rendering import RenderOutput
from cadam3d.rasterizer.reference import ReferenceRasterizer

OUTPUTS: dict[str, Callable[[RenderOutput], Tensor]] = {
    "rgb": lambda output: output.rgb,
    "alpha": lambda output: output.alpha,
    "depth": lambda output: output.depth,
}


def scene() -> Gaussians:
    """Return nine overlapping splats: some are capped, some hide others, one extends into the image."""
    generator = torch.Generator().manual_seed(4)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    gaussians = Gaussians(
        means=0.25 * normal(9, 3),
        log_scales=-1.6 + 0.5 * normal(9, 3),
        quats=normal(9, 4),
        opacity_logits=2 * normal(9) + 1,
        sh=0.5 * normal(9, 16, 3),
    )
    gaussians.opacity_logits[:4] = torch.tensor([6.0, 5.0, 4.0, 3.5])
    gaussians.means[:4] *= 0.2
    gaussians.log_scales[:4] += 0.5
    gaussians.means[8] = torch.tensor([0.3, 1.6, 0.2])
    gaussians.log_scales[8] = -0.9
    return gaussians


def cameras() -> Cameras:
    azimuth = torch.tensor([10.0, 100.0], dtype=torch.float64)
    full = torch.ones_like(azimuth)
    return orbit(azimuth, 20 * full, 2 * full, 50 * full, 11, 13)


def render(gaussians: Gaussians, views: Cameras) -> RenderOutput:
    background = torch.tensor([0.2, 0.5, 0.9], dtype=torch.float64).expand(len(views), 3)
    return ReferenceRasterizer().render(gaussians, views, background)


def score(picture: Tensor) -> Tensor:
    """Return the sum of all numbers, each with a different fixed weight."""
    generator = torch.Generator().manual_seed(5)
    return (picture * torch.randn(picture.shape, generator=generator, dtype=torch.float64)).sum()


@pytest.mark.parametrize("name", FIELDS)
def test_gradients_of_every_output_are_finite_differences(name):
    gaussians, views = scene(), cameras()
    if name == "sh":
        gaussians, views = gaussians.index(slice(3, 5)), views.index(slice(0, 1))  # 96 numbers are enough

    def losses(tensor: Tensor) -> tuple[Tensor, ...]:
        result = render(replace(gaussians, **{name: tensor}), views)
        return tuple(score(output(result)) for output in OUTPUTS.values())

    assert gradcheck(losses, getattr(gaussians, name).requires_grad_(), eps=1e-6, atol=1e-7, rtol=1e-6)


def test_the_gradient_of_the_background_is_a_finite_difference():
    def losses(background: Tensor) -> tuple[Tensor, ...]:
        result = ReferenceRasterizer().render(scene(), cameras(), background)
        return tuple(score(output(result)) for output in OUTPUTS.values())

    assert gradcheck(losses, torch.full((2, 3), 0.4, dtype=torch.float64, requires_grad=True), atol=1e-8)


@pytest.mark.parametrize("output", OUTPUTS)
@pytest.mark.parametrize("axis", [0, 1])
def test_gradients_of_means2d_add_up_to_the_effect_of_shifting_the_image(output, axis):
    # Moving the principal point moves every projected mean by the same number of pixels. It changes nothing
    # else as long as no Jacobian is clamped, because the bounds move too.
    gaussians, views = scene().index(slice(0, 8)), cameras()

    def loss(shift: float) -> tuple[Tensor, RenderOutput]:
        intrinsics = views.intrinsics.clone()
        intrinsics[1, axis, 2] += shift
        result = render(gaussians, replace(views, intrinsics=intrinsics))
        return score(OUTPUTS[output](result)), result

    value, result = loss(0.0)
    value.backward()
    grad = result.means2d.grad
    assert grad is not None
    finite_difference = (loss(1e-5)[0] - loss(-1e-5)[0]).item() / 2e-5
    assert grad[1, :, axis].sum().item() == pytest.approx(finite_difference, rel=1e-6)


def test_the_scene_exercises_the_cap_the_stop_and_the_clamped_jacobian():
    output = render(scene(), cameras())
    assert output.visible.all()
    assert (scene().opacities > 0.99).sum() >= 2
    assert (output.alpha > 0.9995).any(), "some pixel stops early"
    assert (output.means2d[..., 0] > 1.15 * 13).any() or (output.means2d[..., 0] < -0.15 * 13).any()
