"""Scenes for the native rasterizers, and how one is compared with the reference.

The image formation model has steps: a contribution below ALPHA_MIN is skipped, one above ALPHA_MAX is capped,
and a pixel stops before TRANSMITTANCE_MIN. Where a number lies within rounding of a step, float32 and float64
may decide differently, and both are right. ``undecided`` finds those pixels; comparisons leave them out, and
demand that they are few.
"""

import math

import torch

from cadam3d.core.cameras import Cameras, orbit
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.render import RenderOutput
from cadam3d.rasterizer.base import ALPHA_MAX, ALPHA_MIN, BLUR, FRUSTUM_MARGIN, NEAR, TRANSMITTANCE_MIN
from cadam3d.rasterizer.reference import ReferenceRasterizer

IMAGES = ("rgb", "alpha", "depth")
POISON = (math.nan, math.inf, -math.inf, 1e38, -1e38, 1e20, 100.0, 41.0, 40.0, -100.0, 1e-45, 0.0)


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
    # No symmetry to hide behind: another focal length along y, a principal point off the centre.
    off = torch.tensor([[1.1, 0.0, 0.04 * width], [0.0, 0.9, -0.03 * height], [0.0, 0.0, 0.0]])
    cameras.intrinsics.mul_(torch.where(off.eq(1.1) | off.eq(0.9), off, 1.0)).add_(
        torch.where(off.eq(1.1) | off.eq(0.9), 0.0, off)
    )
    return cameras


def backgrounds(v):
    return torch.rand(v, 3, generator=torch.Generator().manual_seed(5))


def undecided(gaussians: Gaussians, cameras: Cameras, within: float = 1e-3) -> torch.Tensor:
    """[v h w]: pixels where some number is ``within`` so much of a step. A dense twin, in float64."""
    g, pixels = gaussians.detach().to(torch.float64), []
    y, x = torch.meshgrid(torch.arange(cameras.height), torch.arange(cameras.width), indexing="ij")
    size = torch.tensor([cameras.width, cameras.height], dtype=torch.float64)
    for view in range(len(cameras)):
        matrix = cameras.world_to_camera[view].double()
        focal = cameras.intrinsics[view].double().diagonal()[:2]
        center = cameras.intrinsics[view, :2, 2].double()
        centre = g.means @ matrix[:3, :3].T + matrix[:3, 3]
        order = centre[:, 2].argsort(stable=True)
        order = order[centre[order, 2] > NEAR]
        centre, z = centre[order], centre[order, 2]
        slope = centre[:, :2] / z[:, None]
        held = slope.clamp(
            (-FRUSTUM_MARGIN * size - center) / focal, ((1 + FRUSTUM_MARGIN) * size - center) / focal
        )
        axes = matrix[:3, :3] @ g.rotations[order] * g.scales[order][:, None]
        rows = (focal / z[:, None])[..., None] * (axes[:, :2] - held[..., None] * axes[:, 2:])
        precision = torch.linalg.inv(rows @ rows.mT + BLUR * torch.eye(2, dtype=torch.float64))
        offset = torch.stack([x, y], dim=-1)[None] + 0.5 - (slope * focal + center)[:, None, None]
        exponent = -0.5 * torch.einsum("nhwi,nij,nhwj->nhw", offset, precision, offset)
        raw = g.opacities[order][:, None, None] * exponent.exp()
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
    render, gaussians, cameras, background, weights, dtype=torch.float32, device="cpu"
):
    """The output, and the gradient of ``sum(weights * images)`` in every tensor and means2d, on the CPU."""
    leaves = gaussians.map(lambda tensor: tensor.detach().to(device, dtype, copy=True).requires_grad_())
    output = render(leaves, cameras, background.to(device, dtype))
    loss = sum(
        (getattr(output, name) * w.to(device, dtype)).sum() for name, w in zip(IMAGES, weights, strict=True)
    )
    loss.backward()
    grads = {name: tensor.grad for name, tensor in leaves.tensors().items()} | {
        "means2d": output.means2d.grad
    }
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
    error = (got - want).abs().max().item() / max(want.abs().max().item(), 1e-20)
    assert error < tolerance, f"{name}: {error:.1e} of its largest"


def assert_agrees(render, gaussians, cameras, *, most=0.9, images=IMAGES, tolerance=2e-5, device="cpu"):
    """``render`` shows what the reference shows in float64, in value and in every gradient."""
    v, height, width = len(cameras), cameras.height, cameras.width
    decided = ~undecided(gaussians, cameras)
    assert decided.double().mean() > most, "too many pixels lie on a step: the test would say little"
    weights = [
        w * decided.view(*decided.shape, *[1] * (w.ndim - 3)) * (name in images)
        for name, w in zip(IMAGES, make_weights(v, height, width), strict=True)
    ]
    scene = gaussians, cameras, backgrounds(v), weights
    got, got_grads = render_and_differentiate(render, *scene, device=device)
    want, want_grads = render_and_differentiate(ReferenceRasterizer().render, *scene, dtype=torch.float64)
    for name in IMAGES:
        assert_close(name, getattr(got, name)[decided], getattr(want, name)[decided], tolerance)
    for name in ("means2d", "radii"):
        assert_close(name, getattr(got, name), getattr(want, name), tolerance)
    assert torch.equal(got.visible, want.visible)
    for name, want_grad in want_grads.items():
        assert_close(f"gradient of {name}", got_grads[name], want_grad, 1e-4)
        cosine = torch.cosine_similarity(got_grads[name].double().flatten(), want_grad.flatten(), dim=0)
        assert cosine > 1 - 1e-7 or want_grad.abs().max() == 0, f"direction of {name}: {cosine}"
    return got, got_grads


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
