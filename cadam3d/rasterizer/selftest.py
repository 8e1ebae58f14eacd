"""The self-test of a rasterizer: one small scene, rendered and differentiated, against the reference.

The image formation model has steps (a contribution below ``ALPHA_MIN`` is skipped, one above ``ALPHA_MAX`` is
capped, a pixel stops at ``TRANSMITTANCE_MIN``). A number within rounding of a step may fall on either side of
it, which no tolerance covers honestly. So the scene is fixed, and chosen such that none of its numbers lies
within 1e-4 of a step, hundreds of roundings away; and yet every step is taken somewhere.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from random import Random

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.cameras import Cameras, orbit
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.render import RenderOutput
from cadam3d.rasterizer.base import Rasterizer
from cadam3d.rasterizer.reference import ReferenceRasterizer

# Relative to the largest number of each tensor. Rounding in float32 makes about 1e-6 of images and 2e-6 of
# gradients, which sum over many pixels; one splat missing in one tile makes more than 1e-3.
MOST_IMAGES = 2e-5
MOST_GRADIENTS = 1e-4

COUNT, SH_COEFFICIENTS = 300, 4  # degree 1
HEIGHT, WIDTH = 37, 53  # pixels; no multiple of any tile
SEED = 12  # of the first scene without a number near a step
IMAGES = ("rgb", "alpha", "depth")


@dataclass(frozen=True)
class Agreement:
    """How far a rasterizer is from the reference, and from itself."""

    images: Mapping[
        str, float
    ]  # rgb, alpha, depth, means2d, radii: deviation, relative to the largest number
    gradients: Mapping[str, float]  # of the five tensors and means2d, and absgrad, likewise
    repeats: bool  # whether a second run gave the same bits

    @property
    def worst_image(self) -> float:
        """Largest deviation of what is seen; infinite if something is not finite."""
        return max(self.images.values())

    @property
    def worst_gradient(self) -> float:
        """Largest deviation of a gradient; infinite if something is not finite."""
        return max(self.gradients.values())

    @property
    def holds(self) -> bool:
        """Whether nothing deviates more than rounding explains."""
        return self.worst_image <= MOST_IMAGES and self.worst_gradient <= MOST_GRADIENTS

    def __str__(self) -> str:
        verb = "agrees" if self.holds else "disagrees"
        bits = "same bits twice" if self.repeats else "other bits the second time"
        deviations = f"images {_short(self.worst_image)}, gradients {_short(self.worst_gradient)}"
        return f"{verb} with the reference: {deviations}; {bits}"


@dataclass(frozen=True)
class Scene:
    """What is rendered, and the weights of the pixels in the loss."""

    gaussians: Gaussians
    cameras: Cameras
    background: Float[Tensor, "v 3"]
    weights: Mapping[str, Tensor]  # by image, of its size


def self_test(rasterizer: Rasterizer, device: torch.device) -> Agreement:
    """Render the scene three times on ``device``, and once with the reference on the CPU in float64.

    Takes about a tenth of a second, nearly all of it for the reference. Raises what the rasterizer raises.
    """
    scene = make_scene()
    images, gradients = _render(rasterizer, scene, device, torch.float32)
    again = _render(rasterizer, scene, device, torch.float32)
    truth = ReferenceRasterizer(), scene, torch.device("cpu"), torch.float64
    want_images, want_gradients = _render(*truth, absgrad=True)
    repeats = all(
        torch.equal(first[name], second[name])
        for first, second in zip((images, gradients), again, strict=True)
        for name in first
    )
    # By kernels of its own, which nobody else calls.
    gradients["absgrad"] = _render(rasterizer, scene, device, torch.float32, absgrad=True)[1]["absgrad"]
    return Agreement(
        images={name: _deviation(images[name], want) for name, want in want_images.items()},
        gradients={name: _deviation(gradients[name], want) for name, want in want_gradients.items()},
        repeats=repeats,
    )


def make_scene() -> Scene:
    """The same scene on every machine: Python promises the numbers of its generator, torch does not.

    Thin and thick, faint and opaque, on the screen, across its border, beside it and behind the camera.
    """
    draw = Random(SEED).random

    def noise(*size: int) -> Tensor:
        return torch.tensor([2 * draw() - 1 for _ in range(math.prod(size))], dtype=torch.float64).view(size)

    gaussians = Gaussians(
        means=1.1 * noise(COUNT, 3),
        log_scales=-2.6 + 1.2 * noise(COUNT, 3),
        quats=noise(COUNT, 4),
        opacity_logits=1.0 + 5.0 * noise(COUNT),
        sh=0.8 * noise(COUNT, SH_COEFFICIENTS, 3),
    )
    azimuth, elevation = torch.tensor([20.0, 200.0]), torch.tensor([-15.0, 40.0])
    distance, fov_y = torch.tensor([2.0, 1.1]), torch.tensor([50.0, 70.0])
    views = len(azimuth)
    background = (noise(views, 3) + 1) / 2
    weights = (noise(views, HEIGHT, WIDTH, 3), noise(views, HEIGHT, WIDTH), noise(views, HEIGHT, WIDTH))
    return Scene(
        gaussians=gaussians.to(torch.float32),
        cameras=orbit(azimuth, elevation, distance, fov_y, HEIGHT, WIDTH),
        background=background.float(),
        weights={name: weight.float() for name, weight in zip(IMAGES, weights, strict=True)},
    )


def _render(
    rasterizer: Rasterizer, scene: Scene, device: torch.device, dtype: torch.dtype, absgrad: bool = False
) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """What is seen, and the gradients of the weighted sum of the images and ``means2d``; on the CPU."""
    leaves = scene.gaussians.map(lambda tensor: tensor.to(device, dtype, copy=True).requires_grad_())
    background = scene.background.to(device, dtype)
    with torch.enable_grad():
        output = rasterizer.render(leaves, scene.cameras.to(device), background, absgrad)
        loss = sum(
            (getattr(output, name) * weight.to(device, dtype)).sum() for name, weight in scene.weights.items()
        )
        assert isinstance(loss, Tensor)
        loss.backward()
    gradients = {name: tensor.grad for name, tensor in leaves.tensors().items()}
    gradients["means2d"] = output.means2d.grad
    if absgrad:
        gradients["absgrad"] = None if output.absgrad is None else output.absgrad.grad
    return _on_cpu(_seen(output)), _on_cpu(gradients)


def _seen(output: RenderOutput) -> dict[str, Tensor]:
    return {name: getattr(output, name) for name in (*IMAGES, "means2d", "radii")}


def _on_cpu(tensors: Mapping[str, Tensor | None]) -> dict[str, Tensor]:
    missing = torch.tensor(math.nan)  # no gradient at all is as wrong as one that is not a number
    return {name: (missing if tensor is None else tensor.detach()).cpu() for name, tensor in tensors.items()}


def _deviation(got: Tensor, want: Tensor) -> float:
    """Largest difference, relative to the largest number; infinite if anything is not finite."""
    if got.shape != want.shape or not got.isfinite().all():
        return math.inf
    return float((got - want).abs().max() / want.abs().max())


def _short(number: float) -> str:
    return f"{number:.0e}".replace("e-0", "e-").replace("e+0", "e+")
