"""The reference rasterizer agrees with gsplat's CPU projection, spherical harmonics and ``accumulate``.

``pip install -e .[dev]`` installs gsplat; without it these tests are skipped. gsplat needs two small
functions of ``nerfacc``, which are defined here, and a list of (Gaussian, pixel) hits, which its CUDA code
would make.
"""

import sys
from types import ModuleType

import pytest
import torch
from torch import Tensor

from cadam3d.core.cameras import Cameras, orbit
from cadam3d.core.gaussians import FIELDS, Gaussians
from cadam3d.core.sh import sh_basis
from cadam3d.rasterizer.reference import ReferenceRasterizer

pytestmark = pytest.mark.oracle
pytest.importorskip("gsplat", reason="pip install -e .[dev]")

from gsplat.cuda import _torch_impl as gsplat  # noqa: E402


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


@pytest.fixture
def _nerfacc(monkeypatch):
    """Define the two functions of nerfacc that ``accumulate`` imports, for hits sorted by ray."""

    def render_weight_from_alpha(alphas: Tensor, ray_indices: Tensor, n_rays: int) -> tuple[Tensor, Tensor]:
        through = torch.cat([alphas.new_zeros(1), torch.log1p(-alphas).cumsum(0)])
        first = torch.searchsorted(ray_indices, ray_indices)  # first hit of the same ray
        transmittance = (through[:-1] - through[first]).exp()
        return transmittance * alphas, transmittance

    def accumulate_along_rays(
        weights: Tensor, values: Tensor | None, ray_indices: Tensor, n_rays: int
    ) -> Tensor:
        each = weights[:, None] if values is None else weights[:, None] * values
        return each.new_zeros(n_rays, each.shape[1]).index_add(0, ray_indices, each)

    module = ModuleType("nerfacc")
    module.render_weight_from_alpha = render_weight_from_alpha
    module.accumulate_along_rays = accumulate_along_rays
    monkeypatch.setitem(sys.modules, "nerfacc", module)


@torch.no_grad()
def hits(
    means2d: Tensor, conics: Tensor, opacities: Tensor, depths: Tensor, height: int, width: int
) -> tuple[Tensor, Tensor]:
    """Return all (Gaussian, pixel) pairs that one view blends, by pixel and then depth, by brute force."""
    pixels = torch.cartesian_prod(torch.arange(height), torch.arange(width)).flip(1) + 0.5
    dx, dy = (pixels[:, None] - means2d).unbind(-1)
    sigma = 0.5 * (conics[:, 0] * dx**2 + conics[:, 2] * dy**2) + conics[:, 1] * dx * dy
    alpha = opacities * torch.exp(-sigma)
    order = depths.argsort()
    alpha = torch.where((alpha >= 1 / 255) & (depths > 0.01), alpha, 0)[:, order]
    is_reached = (1 - alpha).cumprod(dim=1) > 1e-4
    pixel, rank = ((alpha > 0) & is_reached).nonzero().unbind(dim=1)
    return order[rank], pixel


def oracle(gaussians: Gaussians, views: Cameras, background: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    covariances, _ = gsplat._quat_scale_to_covar_preci(gaussians.quats, gaussians.scales, compute_preci=False)
    size = (views.width, views.height)
    _, means2d, depths, conics, _ = gsplat._fully_fused_projection(
        gaussians.means, covariances, views.world_to_camera, views.intrinsics, *size
    )
    means2d.retain_grad()
    pictures = []
    for view in range(len(views)):
        directions = gaussians.means - views.positions[view]
        colors = gsplat._spherical_harmonics(gaussians.sh_degree, directions, gaussians.sh)
        features = torch.cat([(colors + 0.5).clamp_min(0), depths[view][:, None]], dim=1)
        rows, pixels = hits(
            means2d[view], conics[view], gaussians.opacities, depths[view], views.height, views.width
        )
        sums, alpha = gsplat.accumulate(
            means2d[view : view + 1],
            conics[view : view + 1],
            gaussians.opacities[None],
            features[None],
            rows,
            pixels,
            torch.zeros_like(rows),
            *size,
        )
        rgb = sums[0, ..., :3] + (1 - alpha[0]) * background[view]
        pictures.append((rgb, alpha[0, ..., 0], sums[0, ..., 3] / alpha[0, ..., 0].clamp_min(1e-10)))
    rgb, alpha, depth = (torch.stack(each) for each in zip(*pictures, strict=True))
    return rgb, alpha, depth, means2d


@pytest.mark.usefixtures("_nerfacc")
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
    torch.testing.assert_close(sh_basis(directions, 3), gsplat._eval_sh_bases_fast(16, directions))
