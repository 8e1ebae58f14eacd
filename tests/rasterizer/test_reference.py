"""The reference rasterizer: agreement with the textbook, invariances, and inputs that break rasterizers."""

import math

import pytest
import torch
from torch import Tensor

from cadam3d.core.cameras import Cameras, orbit, turntable
from cadam3d.core.gaussians import FIELDS, Gaussians
from cadam3d.core.rendering import RenderOutput
from cadam3d.core.sh import rgb_to_sh0, sh_basis
from cadam3d.rasterizer import reference
from cadam3d.rasterizer.cpu import CpuRasterizer
from cadam3d.rasterizer.reference import ReferenceRasterizer

RASTERIZER = ReferenceRasterizer()


def scene(n: int = 80, degree: int = 1, seed: int = 0, dtype: torch.dtype = torch.float64) -> Gaussians:
    """Return splats of all sizes, faint to nearly opaque, some with negative colours; the first is hidden."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    means = 0.4 * normal(n, 3)
    means[:1] = torch.tensor([3.0, 0.5, 1.5])  # behind all of ``cameras``
    return Gaussians(
        means=means,
        log_scales=-2.2 + 0.6 * normal(n, 3),
        quats=normal(n, 4),
        opacity_logits=3 * normal(n) + 1,
        sh=0.8 * normal(n, (degree + 1) ** 2, 3),
    ).to(dtype)


def cameras(views: int = 2, height: int = 29, width: int = 37, distance: float = 1.6) -> Cameras:
    """Return cameras so close that some of ``scene`` crosses the border of the frustum."""
    azimuth = torch.arange(views, dtype=torch.float64) * 50 - 20
    full = torch.ones_like(azimuth)
    return orbit(azimuth, 25 * full, distance * full, 60 * full, height, width)


def facing(size: int = 9, distance: float = 2.0) -> Cameras:
    """Return one camera on +x with a focal length of ``size`` pixels, looking along -x."""
    fov_y_deg = math.degrees(2 * math.atan(0.5))
    return turntable(1, elevation_deg=0.0, distance=distance, fov_y_deg=fov_y_deg, size=size).to(
        torch.float64
    )


def balls(*, x: list[float], radius: float, opacity: list[float], rgb: list[list[float]]) -> Gaussians:
    """Return round Gaussians of one colour each on the x axis, all at the image centre of ``facing``."""
    n = len(x)
    means = torch.zeros(n, 3, dtype=torch.float64)
    means[:, 0] = torch.tensor(x)
    return Gaussians(
        means=means,
        log_scales=torch.full((n, 3), math.log(radius), dtype=torch.float64),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64).repeat(n, 1),
        opacity_logits=torch.tensor(opacity, dtype=torch.float64).logit(),
        sh=rgb_to_sh0(torch.tensor(rgb, dtype=torch.float64))[:, None],
    )


def backgrounds(views: int) -> Tensor:
    return torch.linspace(0.1, 0.9, 3 * views, dtype=torch.float64).reshape(views, 3)


def render(gaussians: Gaussians, views: Cameras, background: Tensor | None = None) -> RenderOutput:
    return RASTERIZER.render(gaussians, views, backgrounds(len(views)) if background is None else background)


def as_parameters(gaussians: Gaussians) -> Gaussians:
    return gaussians.map(lambda tensor: tensor.detach().clone().requires_grad_())


def images(output: RenderOutput) -> tuple[Tensor, Tensor, Tensor]:
    return output.rgb, output.alpha, output.depth


def score(pictures: tuple[Tensor, ...]) -> Tensor:
    """Return a loss in which every pixel of every output has its own weight."""
    generator = torch.Generator().manual_seed(5)
    weights = [torch.rand(p.shape, generator=generator, dtype=torch.float64).to(p) - 0.4 for p in pictures]
    return torch.stack([(p * weight).sum() for p, weight in zip(pictures, weights, strict=True)]).sum()


def gradients(gaussians: Gaussians, views: Cameras) -> dict[str, Tensor]:
    leaves = as_parameters(gaussians)
    output = render(leaves, views)
    score(images(output)).backward()
    assert output.means2d.grad is not None
    return {name: tensor.grad for name, tensor in leaves.tensors().items()} | {"means2d": output.means2d.grad}


def textbook(gaussians: Gaussians, views: Cameras, background: Tensor) -> tuple[Tensor, ...]:
    """Return rgb, alpha and depth of EWA splatting as in the papers: matrices, one splat after another."""
    pictures = []
    for view in range(len(views)):
        matrix, intrinsics = views.world_to_camera[view], views.intrinsics[view]
        in_camera = gaussians.means @ matrix[:3, :3].T + matrix[:3, 3]
        x, y, z = in_camera.unbind(-1)
        fx, fy, cx, cy = intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2], intrinsics[1, 2]
        size_x, size_y = views.width, views.height
        slope_x = (x / z).clamp((-0.15 * size_x - cx) / fx, (1.15 * size_x - cx) / fx)
        slope_y = (y / z).clamp((-0.15 * size_y - cy) / fy, (1.15 * size_y - cy) / fy)
        zero = torch.zeros_like(z)
        jacobian = torch.stack([fx / z, zero, -fx * slope_x / z, zero, fy / z, -fy * slope_y / z], -1)
        transform = (
            jacobian.view(-1, 2, 3) @ matrix[:3, :3] @ gaussians.rotations @ gaussians.scales.diag_embed()
        )
        covariance = transform @ transform.transpose(1, 2) + 0.3 * torch.eye(2, dtype=z.dtype)
        precision = torch.linalg.inv(covariance)
        direction = torch.nn.functional.normalize(gaussians.means - views.positions[view], dim=-1)
        basis = sh_basis(direction, gaussians.sh_degree)
        color = (torch.einsum("nk,nkc->nc", basis, gaussians.sh) + 0.5).clamp_min(0)
        pixels = torch.cartesian_prod(torch.arange(size_y), torch.arange(size_x)).flip(1).to(z) + 0.5
        left = torch.ones(size_y * size_x, dtype=z.dtype)
        stopped = torch.zeros_like(left, dtype=torch.bool)
        sums = torch.zeros(size_y * size_x, 5, dtype=z.dtype)
        for i in z.argsort(stable=True).tolist():
            if z[i] <= 0.01:
                continue
            offset = pixels - torch.stack([fx * x[i] / z[i] + cx, fy * y[i] / z[i] + cy])
            raw = gaussians.opacities[i] * torch.exp(-0.5 * ((offset @ precision[i]) * offset).sum(-1))
            alpha = torch.where(raw < 1 / 255, 0, raw.clamp_max(0.99))
            stopped = stopped | (left * (1 - alpha) <= 1e-4)
            weight = torch.where(stopped, 0, left * alpha)
            left = torch.where(stopped, left, left * (1 - alpha))
            sums = sums + weight[:, None] * torch.cat([color[i], z[i : i + 1], torch.ones_like(z[:1])])
        rgb, depth, alpha = sums.split([3, 1, 1], dim=1)
        rgb = rgb + left[:, None] * background[view]
        depth = torch.where(alpha > 0, depth / alpha.clamp_min(1e-9), 0)
        pictures.append([picture.view(size_y, size_x, -1) for picture in (rgb, alpha, depth)])
    rgb, alpha, depth = (torch.stack(each) for each in zip(*pictures, strict=True))
    return rgb, alpha[..., 0], depth[..., 0]


# --- the textbook


@pytest.mark.parametrize(
    ("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 1e-5)], ids=["float64", "float32"]
)
@pytest.mark.parametrize(("height", "width", "degree"), [(29, 37, 3), (16, 8, 0), (1, 1, 1), (3, 50, 2)])
def test_images_and_gradients_agree_with_the_textbook(height, width, degree, dtype, tolerance):
    views = cameras(2, height, width).to(dtype)
    background = backgrounds(2).to(dtype)
    leaves, textbook_leaves = (as_parameters(scene(60, degree, dtype=dtype)) for _ in range(2))
    pictures = images(render(leaves, views, background))
    wanted = textbook(textbook_leaves, views, background)
    for got, want in zip(pictures, wanted, strict=True):
        assert got.dtype == dtype
        torch.testing.assert_close(got, want, rtol=0, atol=tolerance * float(want.detach().abs().max() + 1))
    score(pictures).backward()
    score(wanted).backward()
    for name in FIELDS:
        got, want = getattr(leaves, name).grad, getattr(textbook_leaves, name).grad
        torch.testing.assert_close(
            got, want, rtol=0, atol=tolerance * float(want.abs().max() + 1e-3), msg=name
        )


def test_the_textbook_scene_exercises_every_branch():
    gaussians, views = scene(60, 3), cameras(2)
    output = render(gaussians, views)
    in_camera = gaussians.means @ views.world_to_camera[0, :3, :3].T + views.world_to_camera[0, :3, 3]
    assert (in_camera[:, 2] < 0.01).any(), "a splat is behind the camera"
    assert (gaussians.opacities > 0.99).any(), "a splat is capped"
    assert (gaussians.opacities < 1 / 255).any(), "a splat is too faint"
    assert (output.alpha == 0).any(), "some pixel is empty"
    assert (output.alpha > 0.9995).any(), "some pixel stops early"
    outside = (output.means2d[0] < -6) | (output.means2d[0] > 44)
    reaches_in = outside.any(dim=1) & output.visible[0]
    assert reaches_in.any(), "a splat with a clamped Jacobian extends into the image"
    direction = torch.nn.functional.normalize(gaussians.means - views.positions[0], dim=-1)
    colors = torch.einsum("nk,nkc->nc", sh_basis(direction, 3), gaussians.sh) + 0.5
    assert (colors < 0).any(), "some colour is clamped at zero"


# --- results in closed form


def test_a_ball_appears_as_a_gaussian_of_its_projected_size_plus_blur():
    output = render(
        balls(x=[0.0], radius=0.2, opacity=[0.8], rgb=[[1, 0.5, 0]]), facing(9), torch.zeros(1, 3)
    )
    variance = (9 * 0.2 / 2) ** 2 + 0.3
    offset = torch.arange(9, dtype=torch.float64) - 4
    blot = 0.8 * torch.exp(-(offset[:, None] ** 2 + offset**2) / (2 * variance))
    blot = torch.where(blot < 1 / 255, 0, blot)
    torch.testing.assert_close(output.alpha[0], blot)
    torch.testing.assert_close(output.rgb[0], blot[..., None] * torch.tensor([1, 0.5, 0]))
    torch.testing.assert_close(output.depth[0], torch.where(blot > 0, 2.0, 0.0).double())
    torch.testing.assert_close(output.means2d, torch.tensor([[[4.5, 4.5]]], dtype=torch.float64))
    assert output.radii.item() == pytest.approx(math.sqrt(2 * math.log(255 * 0.8) * variance))


def test_the_near_splat_hides_the_far_one_in_any_order_of_rows():
    red_near = balls(x=[0.5, -0.5], radius=0.2, opacity=[0.6, 0.5], rgb=[[1, 0, 0], [0, 0, 1]])
    for rows in ([0, 1], [1, 0]):
        output = render(red_near.index(torch.tensor(rows)), facing(9), torch.ones(1, 3))
        rgb = output.rgb[0, 4, 4]
        torch.testing.assert_close(rgb, torch.tensor([0.6 + 0.2, 0.2, 0.2 + 0.2], dtype=torch.float64))
        assert output.alpha[0, 4, 4].item() == pytest.approx(0.8)
        assert output.depth[0, 4, 4].item() == pytest.approx((0.6 * 1.5 + 0.2 * 2.5) / 0.8)


def test_equally_distant_splats_blend_in_row_order():
    pair = balls(x=[0.0, 0.0], radius=0.2, opacity=[0.6, 0.5], rgb=[[1, 0, 0], [0, 0, 1]])
    rgb = render(pair, facing(9), torch.zeros(1, 3)).rgb[0, 4, 4]
    torch.testing.assert_close(rgb, torch.tensor([0.6, 0, 0.4 * 0.5], dtype=torch.float64))


def test_exactly_the_pixels_within_the_radius_are_drawn():
    for opacity in (0.005, 0.1, 0.97):
        for x_offset in (0.0, 0.3, 0.8):
            ball = balls(x=[0.0], radius=0.3, opacity=[opacity], rgb=[[1, 1, 1]])
            ball.means[0, 1] = x_offset
            output = render(ball, facing(33))
            offset = (
                torch.cartesian_prod(torch.arange(33), torch.arange(33)).flip(1) + 0.5 - output.means2d[0, 0]
            )
            is_drawn = output.alpha[0].flatten() > 0
            distance = offset.abs().amax(dim=1)
            assert not is_drawn[distance > output.radii[0, 0]].any()
            assert distance[is_drawn].max() > output.radii[0, 0] - 1, "the box touches the ellipse"


# --- invariances


@pytest.mark.parametrize(("tile", "block"), [(2, 1), (4, 1), (8, 100), (16, 2**17), (64, 2**30)])
def test_the_result_does_not_depend_on_tile_and_block_sizes(monkeypatch, tile, block):
    gaussians, views = scene(40), cameras()
    wanted, wanted_grads = images(render(gaussians, views)), gradients(gaussians, views)
    monkeypatch.setattr(reference, "TILE", tile)
    monkeypatch.setattr(reference, "BLOCK", block)
    for got, want in zip(images(render(gaussians, views)), wanted, strict=True):
        torch.testing.assert_close(got, want, rtol=1e-12, atol=1e-12)
    grads = gradients(gaussians, views)
    for name, want in wanted_grads.items():
        torch.testing.assert_close(grads[name], want, rtol=1e-10, atol=1e-10)


# --- inputs that break other rasterizers


EXTREMES = [
    0.0,
    -0.0,
    1e-45,
    1e-38,
    1e-20,
    1e-7,
    1.0,
    46.0,
    -46.0,
    88.0,
    -88.0,
    100.0,
    1e10,
    -1e10,
    1e20,
    3e38,
    -3e38,
]


# --- determinism, autograd, dtypes and memory


def test_the_bits_do_not_depend_on_the_run_or_the_number_of_threads():
    gaussians, views = scene(150, dtype=torch.float32), cameras(2, 65, 70).to(torch.float32)
    threads = torch.get_num_threads()

    def everything() -> list[Tensor]:
        output = render(gaussians, views)
        return [*images(output), output.means2d, output.radii, *gradients(gaussians, views).values()]

    try:
        runs = []
        for count in (1, 2, 2):
            torch.set_num_threads(count)
            runs.append(everything())
    finally:
        torch.set_num_threads(threads)
    for run in runs[1:]:
        assert all(torch.equal(a, b) for a, b in zip(run, runs[0], strict=True))


def test_means2d_retains_its_gradient_only_while_gradients_are_on():
    gaussians, views = scene(20), cameras()
    with torch.no_grad():
        assert not render(as_parameters(gaussians), views).means2d.requires_grad
    gaussians.opacity_logits.requires_grad_()  # means2d does not depend on it
    output = render(gaussians, views)
    output.rgb.sum().backward()
    assert output.means2d.grad is not None
    assert output.means2d.grad.shape == (2, 20, 2)
    assert (output.means2d.grad.any(dim=-1) <= output.visible).all()


def test_a_render_stores_little_for_the_backward_pass():
    # 60 splats fill the image, so one float32 array of their 60 x 64 x 64 pairs would have a megabyte.
    gaussians = scene(60, dtype=torch.float32).map(lambda tensor: tensor.clone())
    gaussians.log_scales[:] = 0.0
    kept: dict[int, int] = {}

    def pack(tensor: Tensor) -> Tensor:
        kept[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage().nbytes()
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor):
        output = render(as_parameters(gaussians), facing(64).to(torch.float32))
    assert output.visible.sum() > 50
    assert sum(kept.values()) < 60 * 64 * 64 * 4 / 2


def test_second_derivatives_are_refused():
    leaves = as_parameters(scene(5))
    (grad,) = torch.autograd.grad(
        render(leaves, cameras()).rgb.square().sum(), leaves.means, create_graph=True
    )
    with pytest.raises(RuntimeError, match="once_differentiable"):
        grad.sum().backward()


EXTREMES = {
    "means": (1e3, 1e10, 1e30, -3e38, 0.0),
    "log_scales": (5.0, 40.0, 90.0, 1e30, -90.0, -1e30),
    "quats": (0.0, 1e-40, 3e38),
    "opacity_logits": (90.0, 1e30, -1e30),
    "sh": (1e10, 3e38, -3e38),
}


@pytest.mark.parametrize("make", [ReferenceRasterizer, lambda: CpuRasterizer(cache_dir=None)])
@pytest.mark.parametrize(("name", "value"), [(name, v) for name, values in EXTREMES.items() for v in values])
def test_any_finite_gaussians_give_finite_images(make, name, value):
    draw = torch.Generator().manual_seed(0)
    gaussians = Gaussians(
        means=torch.randn(20, 3, generator=draw) * 0.3,
        log_scales=torch.full((20, 3), -1.5),
        quats=torch.randn(20, 4, generator=draw),
        opacity_logits=torch.randn(20, generator=draw),
        sh=torch.randn(20, 4, 3, generator=draw),
    )
    gaussians.tensors()[name][::2] = value
    cameras = turntable(2, elevation_deg=15.0, distance=3.0, fov_y_deg=40.0, size=16)
    image = make().render(gaussians, cameras, torch.zeros(2, 3))
    assert image.rgb.isfinite().all()
    assert image.alpha.isfinite().all()
