"""The reference rasterizer agrees with gsplat's CPU projection, spherical harmonics and ``accumulate``.

``pip install -e .[dev]`` installs gsplat; without it these tests are skipped.
"""

import pytest
import torch
from torch import Tensor

from cadam3d.core.cameras import Cameras, orbit
from cadam3d.core.gaussians import FIELDS, Gaussians
from cadam3d.core.sh import sh_basis
from cadam3d.rasterizer.reference import ReferenceRasterizer

pytestmark = pytest.mark.oracle
pytest.importorskip("gsplat", reason="pip install -e .[dev]")

import gsplat_on_cpu  # noqa: E402
from gsplat.cuda import _torch_impl  # noqa: E402


def scene(degree: int) -> Gaussians:
    """Return Gaussians with opacities below the caps, which are 0.999 in gsplat 1.5.3 and 0.99 here."""
    generator = torch.Generator().manual_seed(degree)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    return Gaussians(
        means=0.4 * normal(90, 3),
        log_scales=-2.2 + 0.6 * normal(90, 3),
        quats=normal(90, 4),
        opacity_logits=torch.logit(0.97 * torch.rand(90, generator=generator, dtype=torch.float64)),
        sh=0.8 * normal(90, (degree + 1) ** 2, 3),
    )


def cameras(height: int, width: int) -> Cameras:
    azimuth = torch.tensor([-20.0, 30.0], dtype=torch.float64)
    full = torch.ones_like(azimuth)
    return orbit(azimuth, 25 * full, 1.6 * full, 60 * full, height, width)


def oracle(gaussians: Gaussians, views: Cameras, background: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    images, alphas, info = gsplat_on_cpu.rasterization(
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities,
        gaussians.sh,
        views.world_to_camera,
        views.intrinsics,
        views.width,
        views.height,
        sh_degree=gaussians.sh_degree,
        packed=False,
        backgrounds=background,
        render_mode="RGB+ED",
    )
    info["means2d"].retain_grad()
    return images[..., :3], alphas[..., 0], images[..., 3], info["means2d"]


@pytest.mark.parametrize(("height", "width", "degree"), [(61, 45, 3), (96, 96, 0), (1, 1, 1), (17, 8, 2)])
def test_images_and_gradients_agree_with_gsplat(height, width, degree):
    views, background = (
        cameras(height, width),
        torch.tensor([[0.1, 0.5, 0.9], [1, 1, 0]], dtype=torch.float64),
    )
    ours, theirs = (scene(degree).map(lambda tensor: tensor.requires_grad_()) for _ in range(2))
    output = ReferenceRasterizer().render(ours, views, background)
    *wanted, means2d = oracle(theirs, views, background)
    generator = torch.Generator().manual_seed(1)
    losses = [torch.zeros((), dtype=torch.float64), torch.zeros((), dtype=torch.float64)]
    for got, want in zip((output.rgb, output.alpha, output.depth), wanted, strict=True):
        torch.testing.assert_close(got, want, rtol=0, atol=1e-8)
        weight = torch.rand(got.shape, generator=generator, dtype=torch.float64) - 0.4
        losses = [losses[0] + (got * weight).sum(), losses[1] + (want * weight).sum()]
    for loss in losses:
        loss.backward()
    for name in FIELDS:
        assert_close_to_largest(getattr(ours, name).grad, getattr(theirs, name).grad)
    torch.testing.assert_close(output.means2d[output.visible], means2d[output.visible])
    assert_close_to_largest(output.means2d.grad, means2d.grad)


def assert_close_to_largest(got: Tensor | None, want: Tensor | None) -> None:
    assert got is not None
    assert want is not None
    torch.testing.assert_close(got, want, rtol=0, atol=1e-8 * float(want.abs().max() + 1e-3))


def test_spherical_harmonics_agree_with_gsplat():
    directions = torch.nn.functional.normalize(torch.randn(50, 3, dtype=torch.float64), dim=-1)
    torch.testing.assert_close(sh_basis(directions, 3), _torch_impl._eval_sh_bases_fast(16, directions))
