"""Scenes for the native rasterizers, and comparisons with the reference.

The image formation model has steps: a contribution below ALPHA_MIN is skipped, one above ALPHA_MAX is capped,
and a pixel stops before TRANSMITTANCE_MIN. If a number is within rounding of a step, float32 and float64 may
decide differently, and both are right. ``undecided`` finds such pixels. Comparisons leave them out and
require that there are few of them.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch

from cadam3d.core.cameras import Cameras, orbit
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.rendering import RenderOutput
from cadam3d.rasterizer.base import ALPHA_MAX, ALPHA_MIN, BLUR, FRUSTUM_MARGIN, NEAR, TRANSMITTANCE_MIN
from cadam3d.rasterizer.reference import ReferenceRasterizer

IMAGES = ("rgb", "alpha", "depth")
POISON = (math.nan, math.inf, -math.inf, 1e38, -1e38, 1e20, 100.0, 46.0, 41.0, 40.0, -100.0, 1e-45, 0.0)


def make_gaussians(n, *, seed=0, degree=0, spread=0.6, log_scale=-2.0, opacity=0.0) -> Gaussians:
    generator = torch.Generator().manual_seed(seed)

    def noise(*size):
        return torch.randn(*size, generator=generator)

    return Gaussians(
        means=spread * noise(n, 3),
        log_scales=log_scale + 0.5 * noise(n, 3),
        quats=noise(n, 4),
        opacity_logits=opacity + noise(n),
        sh=0.5 * noise(n, (degree + 1) ** 2, 3),
    )


def make_cameras(v, height, width, *, distance=3.0, seed=0) -> Cameras:
    generator = torch.Generator().manual_seed(seed)
    cameras = orbit(
        torch.rand(v, generator=generator) * 360,
        torch.rand(v, generator=generator) * 120 - 60,
        torch.full((v,), distance),
        torch.full((v,), 50.0),
        height,
        width,
    )
    # Symmetry could hide mistakes, so the focal lengths differ and the principal point is not at the centre.
    off = torch.tensor([[1.1, 0.0, 0.04 * width], [0.0, 0.9, -0.03 * height], [0.0, 0.0, 0.0]])
    cameras.intrinsics.mul_(torch.where(off.eq(1.1) | off.eq(0.9), off, 1.0)).add_(
        torch.where(off.eq(1.1) | off.eq(0.9), 0.0, off)
    )
    return cameras


def backgrounds(v):
    return torch.rand(v, 3, generator=torch.Generator().manual_seed(5))


@dataclass(frozen=True)
class Ellipses:
    """The projected Gaussians of one view, in float64, computed with plain matrices."""

    centres: torch.Tensor  # [n 2]; pixels
    covariances: torch.Tensor  # [n 2 2]; pixels^2, blurred
    depths: torch.Tensor  # [n]; camera z, world units

    def exponents(self, height: int, width: int) -> torch.Tensor:
        """Return half the squared distance of all pixels from the centres, in standard deviations [n h w]."""
        y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
        offset = torch.stack([x, y], dim=-1)[None] + 0.5 - self.centres[:, None, None]
        return 0.5 * torch.einsum("nhwi,nij,nhwj->nhw", offset, torch.linalg.inv(self.covariances), offset)


def ellipses(gaussians: Gaussians, cameras: Cameras, view: int) -> Ellipses:
    g = gaussians.detach().to(torch.float64)
    size = torch.tensor([cameras.width, cameras.height], dtype=torch.float64)
    matrix = cameras.world_to_camera[view].double()
    focal = cameras.intrinsics[view].double().diagonal()[:2]
    principal = cameras.intrinsics[view, :2, 2].double()
    centre = g.means @ matrix[:3, :3].T + matrix[:3, 3]
    z = centre[:, 2]
    slope = centre[:, :2] / z[:, None]
    held = slope.clamp(
        (-FRUSTUM_MARGIN * size - principal) / focal, ((1 + FRUSTUM_MARGIN) * size - principal) / focal
    )
    axes = matrix[:3, :3] @ g.rotations * g.scales[:, None]
    rows = (focal / z[:, None])[..., None] * (axes[:, :2] - held[..., None] * axes[:, 2:])
    return Ellipses(
        centres=slope * focal + principal,
        covariances=rows @ rows.mT + BLUR * torch.eye(2, dtype=torch.float64),
        depths=z,
    )


def undecided(gaussians: Gaussians, cameras: Cameras, within: float = 1e-3) -> torch.Tensor:
    """Return the mask [v h w] of pixels where a number is within a share of a step, densely in float64."""
    pixels = []
    for view in range(len(cameras)):
        depths = ellipses(gaussians, cameras, view).depths
        order = depths.argsort(stable=True)
        seen = gaussians.detach().index(order[depths[order] > NEAR])
        exponents = ellipses(seen, cameras, view).exponents(cameras.height, cameras.width)
        raw = seen.to(torch.float64).opacities[:, None, None] * (-exponents).exp()
        alpha = torch.where(raw < ALPHA_MIN, 0.0, raw.clamp_max(ALPHA_MAX))
        after = (1 - alpha).cumprod(dim=0)
        is_close = [
            (numbers / step - 1).abs() < within
            for numbers, step in ((raw, ALPHA_MIN), (raw, ALPHA_MAX), (after, TRANSMITTANCE_MIN))
        ]
        pixels.append(torch.stack(is_close).flatten(0, 1).any(dim=0))
    return torch.stack(pixels)


def make_weights(v, height, width, seed=3):
    generator = torch.Generator().manual_seed(seed)
    return [torch.randn(v, height, width, *channels, generator=generator) for channels in ((3,), (), ())]


def render_and_differentiate(
    render, gaussians, cameras, background, weights, dtype=torch.float32, device="cpu", *, absgrad=False
):
    """Return the output and the gradients of ``sum(weights * images)``, on the CPU.

    There is a gradient for every tensor and for means2d, and at the end for absgrad if that is requested. An
    image with the weight ``None`` is not part of the loss: it gets no gradient, not even zeros.
    """
    leaves = gaussians.map(lambda tensor: tensor.detach().to(device, dtype, copy=True).requires_grad_())
    output = render(leaves, cameras, background.to(device, dtype), *([True] if absgrad else []))
    terms = [
        (getattr(output, name) * weight.to(device, dtype)).sum()
        for name, weight in zip(IMAGES, weights, strict=True)
        if weight is not None
    ]
    torch.stack(terms).sum().backward()
    grads = {name: tensor.grad for name, tensor in leaves.tensors().items()} | {
        "means2d": output.means2d.grad
    }
    grads |= {"absgrad": output.absgrad.grad} if absgrad else {}
    fields = ("rgb", "alpha", "depth", "means2d", "radii")
    output = RenderOutput(**{name: getattr(output, name).detach().cpu() for name in fields})
    return output, {name: grad.cpu() for name, grad in grads.items()}


def bits(output, grads):
    return [getattr(output, name) for name in (*IMAGES, "means2d", "radii")] + list(grads.values())


def assert_same_bits(first, second):
    for a, b in zip(first, second, strict=True):
        assert torch.equal(a, b)


def assert_close(name, got, want, tolerance):
    assert got.isfinite().all(), f"{name} is not finite"
    largest = want.abs().max().item() if want.numel() else 0.0
    error = (got - want).abs().max().item() / max(largest, 1e-20) if want.numel() else 0.0
    assert error <= tolerance, f"{name}: {error:.1e} of its largest"


def assert_agrees(
    render,
    gaussians,
    cameras,
    *,
    most=0.9,
    images=IMAGES,
    tolerance=2e-5,
    gradient_tolerance=1e-4,
    device="cpu",
    absgrad=False,
):
    """Check that ``render`` agrees with the reference in float64, in all images and gradients."""
    v, height, width = len(cameras), cameras.height, cameras.width
    decided = ~undecided(gaussians, cameras)
    assert decided.double().mean() > most, "too many pixels are on a step, so the test would prove little"
    weights = [
        weight * decided.view(*decided.shape, *[1] * (weight.ndim - 3)) if name in images else None
        for name, weight in zip(IMAGES, make_weights(v, height, width), strict=True)
    ]
    scene = gaussians, cameras, backgrounds(v), weights
    got, got_grads = render_and_differentiate(render, *scene, device=device, absgrad=absgrad)
    want, want_grads = render_and_differentiate(
        ReferenceRasterizer().render, *scene, dtype=torch.float64, absgrad=absgrad
    )
    for name in IMAGES:
        assert_close(name, getattr(got, name)[decided], getattr(want, name)[decided], tolerance)
    for name in ("means2d", "radii"):
        assert_close(name, getattr(got, name), getattr(want, name), tolerance)
    assert torch.equal(got.visible, want.visible)
    for name, want_grad in want_grads.items():
        assert_close(f"gradient of {name}", got_grads[name], want_grad, gradient_tolerance)
        cosine = torch.cosine_similarity(got_grads[name].double().flatten(), want_grad.flatten(), dim=0)
        assert cosine > 1 - gradient_tolerance**2 * 10 or want_grad.abs().max() == 0, (
            f"direction of {name}: {cosine}"
        )
    return got, got_grads


@dataclass(frozen=True)
class Backend:
    """A rasterizer, with the device and the dtype of its tests."""

    name: str
    render: Callable[[Gaussians, Cameras, torch.Tensor], RenderOutput]
    device: str = "cpu"
    dtype: torch.dtype = torch.float32
    rounding: float = 2e-5  # error on hard scenes, relative to the largest number
    order_of_sums: float = 0.0  # deviation of a sum in another order, likewise

    def agrees(self, gaussians, cameras, **kwargs):
        """See :func:`assert_agrees`."""
        return assert_agrees(self.render, gaussians, cameras, device=self.device, **kwargs)

    def differentiate(self, gaussians, cameras, weights=None, background=None, absgrad=False):
        """See :func:`render_and_differentiate`; without ``weights``, all numbers of all images have one."""
        v, size = len(cameras), (cameras.height, cameras.width)
        return render_and_differentiate(
            self.render,
            gaussians,
            cameras,
            backgrounds(v) if background is None else background,
            make_weights(v, *size) if weights is None else weights,
            self.dtype,
            self.device,
            absgrad=absgrad,
        )

    def show(self, gaussians, cameras):
        """Return the output without gradients, on the CPU."""
        with torch.no_grad():
            output = self.render(self.put(gaussians), cameras, self.put(backgrounds(len(cameras))))
        return replace(
            output, **{name: getattr(output, name).cpu() for name in (*IMAGES, "means2d", "radii")}
        )

    def put(self, tensors):
        """Return a tensor or Gaussians on the device and in the dtype of this backend."""
        return tensors.to(self.device).to(self.dtype)


def needles(n):
    gaussians = make_gaussians(n, seed=7)
    gaussians.log_scales += torch.tensor([2.0, -5.0, -5.0])
    return gaussians


def flat_discs(n):
    gaussians = make_gaussians(n, seed=8)
    gaussians.log_scales += torch.tensor([0.5, 0.5, -12.0])
    return gaussians


def saturated(n):
    gaussians = make_gaussians(n, seed=9, opacity=9.0, log_scale=-1.0)
    gaussians.opacity_logits[::3] = 40.0  # a sigmoid of exactly 1
    return gaussians


def duplicated(n):
    return make_gaussians(n // 3, seed=10).index(torch.arange(n // 3).repeat(3))


def multiply_quats(p: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
    """Return the products of one quaternion ``p`` with each row of ``q``."""
    w = p[0] * q[:, 0] - q[:, 1:] @ p[1:]
    xyz = p[0] * q[:, 1:] + q[:, :1] * p[1:] + torch.linalg.cross(p[1:].expand_as(q[:, 1:]), q[:, 1:], dim=-1)
    return torch.cat([w[:, None], xyz], dim=1)


def facing_camera(height, width) -> Cameras:
    """Return one camera at the origin that looks along +z, with its principal point at the image centre."""
    return replace(
        make_cameras(1, height, width),
        world_to_camera=torch.eye(4)[None],
        intrinsics=torch.tensor([[[20.0, 0.0, width / 2], [0.0, 20.0, height / 2], [0.0, 0.0, 1.0]]]),
    )


def stack(*opacity_logits, first=2.0) -> Gaussians:
    """Return grey balls in front of ``facing_camera``, nearest first; each fills a small image."""
    n = len(opacity_logits)
    return Gaussians(
        means=torch.stack([torch.tensor([0.0, 0.0, first + i / 10]) for i in range(n)]),
        log_scales=torch.full((n, 3), 2.0),
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1),
        opacity_logits=torch.tensor(opacity_logits),
        sh=torch.full((n, 1, 3), 0.5),
    )


def at_tile_corners(log_scales, margin=1e-3) -> tuple[Gaussians, Cameras]:
    """Return one Gaussian, and views in which its ellipse ends ``margin`` pixels from a pixel centre.

    The pixel is the first one across the borders of 16x16 tiles, and therefore of 8x8 tiles. The ellipse
    reaches it from every side, also with its rightmost, leftmost, topmost and lowest point. In views with odd
    numbers it ends just before the pixel centre, in the others just behind it.
    """
    gaussians = make_gaussians(1, seed=3, spread=0.1)
    gaussians.log_scales[0], gaussians.opacity_logits[0] = torch.tensor(log_scales), 0.5
    camera = make_cameras(1, 32, 32)
    seen = ellipses(gaussians, camera, 0)
    covariance, reach = seen.covariances[0], torch.log(gaussians.opacities[0] / ALPHA_MIN).mul(2).sqrt()
    angles = torch.arange(16, dtype=torch.float64) * math.pi / 8 + 0.1
    round_trip = torch.stack([angles.cos(), angles.sin()], dim=1) @ torch.linalg.cholesky(covariance).T
    tips = (covariance / covariance.diagonal().sqrt()).T
    edge = reach.double() * torch.cat([round_trip, tips, -tips])
    normal = torch.nn.functional.normalize(torch.linalg.solve(covariance, edge.T).T, dim=1)
    target = torch.where(normal > 0, 16.5, 15.5)
    centres = torch.stack([target - edge + side * margin * normal for side in (1, -1)], dim=1).flatten(0, 1)
    cameras = camera.index(torch.zeros(len(centres), dtype=torch.long))
    intrinsics = cameras.intrinsics.clone()
    intrinsics[:, :2, 2] += (centres - seen.centres).float()
    return gaussians, replace(cameras, intrinsics=intrinsics)
