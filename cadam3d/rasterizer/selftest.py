"""The self-test of a rasterizer: renders and differentiates one small scene and compares with the reference.

The image formation model has steps: a contribution below ``ALPHA_MIN`` is skipped, one above ``ALPHA_MAX`` is
capped, and a pixel stops at ``TRANSMITTANCE_MIN``. A number that is within rounding of a step may fall on
either side of it, and no tolerance can cover the difference. So the scene is fixed, and none of its numbers
is within 1e-4 of a step, which is hundreds of rounding errors. Still, the scene exercises every step.

Another library may have other steps and larger rounding errors, so :class:`Demands` belongs to a rasterizer.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from random import Random

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.cameras import Cameras, orbit
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.rendering import RenderOutput
from cadam3d.rasterizer.base import Rasterizer
from cadam3d.rasterizer.reference import ReferenceRasterizer

COUNT, SH_COEFFICIENTS = 300, 4  # degree 1
# Not multiples of the size of any tile.
HEIGHT, WIDTH = 37, 53  # pixels
# The first seed that gives a scene without a number near a step.
SEED = 12
IMAGES = ("rgb", "alpha", "depth")


@dataclass(frozen=True, kw_only=True)
class Demands:
    """Limits that a rasterizer must keep in the self-test.

    The largest accepted deviations are relative to the largest number of each tensor. One splat that is
    missing in one tile causes more than 1e-3.
    """

    images: float  # largest deviation of an image
    gradients: float  # largest deviation of a gradient
    same_bits: bool  # whether a second run must give the same bits
    most_opacity: float = 1.0  # more opaque Gaussians of the scene are reduced to this


# Rounding in float32 causes about 1e-6 in images and 2e-6 in gradients, which are sums over many pixels.
OWN = Demands(images=2e-5, gradients=1e-4, same_bits=True)
# On a GPU, torch adds with atomics, and therefore in any order.
ATOMIC = replace(OWN, same_bits=False)
# gsplat 1.5.3 caps alpha at 0.999, so nothing in its scene comes near our cap of 0.99. It is compiled with
# approximate divisions and exponentials, and stores alpha instead of the transmittance, which loses digits
# where little light is left. Modelled in IEEE float32 on a CPU, that causes 3e-6 in images and 4e-5 in
# gradients.
GSPLAT = Demands(images=1e-4, gradients=5e-4, same_bits=False, most_opacity=0.98)


@dataclass(frozen=True)
class Agreement:
    """Deviations of a rasterizer from the reference, and whether it repeats its own results.

    A deviation is relative to the largest number of its tensor.
    """

    images: Mapping[str, float]  # of rgb, alpha, depth, means2d and radii
    gradients: Mapping[str, float]  # of the five tensors, means2d and absgrad
    repeats: bool  # whether rendering ahead gave the same bits
    demands: Demands = OWN

    @property
    def worst_image(self) -> float:
        """Return the largest deviation of an image; infinite if a number is not finite."""
        return max(self.images.values())

    @property
    def worst_gradient(self) -> float:
        """Return the largest deviation of a gradient; infinite if a number is not finite."""
        return max(self.gradients.values())

    @property
    def holds(self) -> bool:
        """Return whether rounding explains all deviations."""
        return self.worst_image <= self.demands.images and self.worst_gradient <= self.demands.gradients

    @property
    def passes(self) -> bool:
        """Return whether the rasterizer may be used."""
        return self.holds and (self.repeats or not self.demands.same_bits)

    def __str__(self) -> str:
        verb = "agrees" if self.holds else "disagrees"
        bits = "same bits twice" if self.repeats else "different bits the second time"
        deviations = f"images {self.worst_image:.0e}, gradients {self.worst_gradient:.0e}"
        return f"{verb} with the reference: {deviations}; {bits}"


@dataclass(frozen=True)
class ProbeScene:
    """The scene of the self-test, and the weights of the pixels in the loss."""

    gaussians: Gaussians
    cameras: Cameras
    background: Float[Tensor, "v 3"]
    weights: Mapping[str, Tensor]  # one tensor per image, of the size of the image


def self_test(rasterizer: Rasterizer, device: torch.device, demands: Demands = OWN) -> Agreement:
    """Compare renderings on ``device`` with one of the reference, on the CPU in float64.

    This takes about a tenth of a second, nearly all of it for the reference. Errors of the rasterizer are not
    caught.
    """
    scene = make_scene(demands.most_opacity)
    images, gradients = _render(rasterizer.render, scene, device, torch.float32)
    # Training renders ahead, which must give the same bits. The first time, nothing is known yet, so it may
    # do what ``render`` does.
    _render(rasterizer.render_ahead, scene, device, torch.float32)
    again = _render(rasterizer.render_ahead, scene, device, torch.float32)
    truth = ReferenceRasterizer().render, scene, torch.device("cpu"), torch.float64
    want_images, want_gradients = _render(*truth, absgrad=True)
    repeats = all(
        torch.equal(first[name], second[name])
        for first, second in zip((images, gradients), again, strict=True)
        for name in first
    )
    # Separate kernels compute absgrad, so it needs another rendering.
    absolute = _render(rasterizer.render_ahead, scene, device, torch.float32, absgrad=True)
    gradients["absgrad"] = absolute[1]["absgrad"]
    return Agreement(
        images={name: _deviation(images[name], want) for name, want in want_images.items()},
        gradients={name: _deviation(gradients[name], want) for name, want in want_gradients.items()},
        repeats=repeats,
        demands=demands,
    )


def make_scene(most_opacity: float = 1.0) -> ProbeScene:
    """Return a scene that is the same on every machine, with opacities of at most ``most_opacity``.

    Python guarantees the numbers of its random generator, torch does not. The Gaussians are thin and thick,
    faint and opaque, and on the screen, across its border, beside it and behind the camera.
    """
    draw = Random(SEED).random

    def noise(*size: int) -> Tensor:
        return torch.tensor([2 * draw() - 1 for _ in range(math.prod(size))], dtype=torch.float64).view(size)

    gaussians = Gaussians(
        means=1.1 * noise(COUNT, 3),
        log_scales=-2.6 + 1.2 * noise(COUNT, 3),
        quats=noise(COUNT, 4),
        opacity_logits=(1.0 + 5.0 * noise(COUNT)).clamp_max(torch.logit(torch.tensor(most_opacity))),
        sh=0.8 * noise(COUNT, SH_COEFFICIENTS, 3),
    )
    azimuth, elevation = torch.tensor([20.0, 200.0]), torch.tensor([-15.0, 40.0])
    distance, fov_y = torch.tensor([2.0, 1.1]), torch.tensor([50.0, 70.0])
    views = len(azimuth)
    background = (noise(views, 3) + 1) / 2
    weights = (noise(views, HEIGHT, WIDTH, 3), noise(views, HEIGHT, WIDTH), noise(views, HEIGHT, WIDTH))
    return ProbeScene(
        gaussians=gaussians.to(torch.float32),
        cameras=orbit(azimuth, elevation, distance, fov_y, HEIGHT, WIDTH),
        background=background.float(),
        weights={name: weight.float() for name, weight in zip(IMAGES, weights, strict=True)},
    )


def _render(
    render: Callable[..., RenderOutput],
    scene: ProbeScene,
    device: torch.device,
    dtype: torch.dtype,
    absgrad: bool = False,
) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Return the rendered tensors and the gradients of the weighted sum of the images, on the CPU."""
    leaves = scene.gaussians.map(lambda tensor: tensor.to(device, dtype, copy=True).requires_grad_())
    background = scene.background.to(device, dtype)
    with torch.enable_grad():
        output = render(leaves, scene.cameras.to(device), background, absgrad)
        loss = sum(
            (getattr(output, name) * weight.to(device, dtype)).sum() for name, weight in scene.weights.items()
        )
        assert isinstance(loss, Tensor)
        loss.backward()
    gradients = {name: tensor.grad for name, tensor in leaves.tensors().items()}
    gradients["means2d"] = output.means2d.grad
    if absgrad:
        gradients["absgrad"] = None if output.absgrad is None else output.absgrad.grad
    shown = {name: getattr(output, name) for name in (*IMAGES, "radii")}
    # A centre that is not seen is arbitrary.
    shown["means2d"] = torch.where(output.visible[..., None], output.means2d, 0.0)
    return _on_cpu(shown), _on_cpu(gradients)


def _on_cpu(tensors: Mapping[str, Tensor | None]) -> dict[str, Tensor]:
    # A missing gradient counts as a gradient of NaN.
    missing = torch.tensor(math.nan)
    return {name: (missing if tensor is None else tensor.detach()).cpu() for name, tensor in tensors.items()}


def _deviation(got: Tensor, want: Tensor) -> float:
    """Return the largest difference, relative to the largest number; infinite if a number is not finite."""
    if got.shape != want.shape or not got.isfinite().all():
        return math.inf
    return float((got - want).abs().max() / want.abs().max())
