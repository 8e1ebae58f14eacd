"""The scene of the benchmark: a bumpy shell of splats whose size is about the distance between neighbours."""

import math
import time
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from cadam3d.core.cameras import Cameras, turntable
from cadam3d.core.gaussians import Gaussians
from cadam3d.rasterizer.base import Rasterizer

RADIUS = 0.6  # world units


@dataclass(frozen=True)
class Scene:
    """The input of a backend and the gradients of its images, which are the same for every backend."""

    gaussians: Gaussians  # leaf tensors
    cameras: Cameras
    background: Tensor  # [v 3]
    gradients: tuple[Tensor, Tensor, Tensor]  # of rgb, alpha and depth

    def render(self, rasterizer: Rasterizer) -> tuple[Tensor, Tensor, Tensor]:
        """Return rgb, alpha and depth."""
        output = rasterizer.render(self.gaussians, self.cameras, self.background)
        return output.rgb, output.alpha, output.depth

    def step(self, rasterizer: Rasterizer) -> float:
        """Render and run the backward pass as a training step does, which may not wait for the device.

        Returns the seconds until both calls have returned. After that, a step finds out whether the reserved
        memory was too small, and if so repeats both.
        """
        begin = time.perf_counter()
        output = rasterizer.render_ahead(self.gaussians, self.cameras, self.background)
        self.backward((output.rgb, output.alpha, output.depth))
        host = time.perf_counter() - begin
        if output.overflowed is not None and output.overflowed.item():
            self.zero_grad()
            self.backward(self.render(rasterizer))
        return host

    def backward(self, images: tuple[Tensor, Tensor, Tensor]) -> None:
        """Run the backward pass from fixed gradients, so that no loss is part of the time."""
        torch.autograd.backward(images, self.gradients)

    def without(self, pixels: Tensor) -> "Scene":
        """Return the scene with zero gradient at some pixels [v h w]; the Gaussians are shared."""
        is_kept = ~pixels.to(self.background.device)
        rgb, alpha, depth = self.gradients
        return replace(self, gradients=(rgb * is_kept[..., None], alpha * is_kept, depth * is_kept))

    def to(self, device: torch.device, dtype: torch.dtype) -> "Scene":
        """Return a copy with new leaf tensors on another device and in another dtype."""
        gaussians = self.gaussians.map(lambda t: t.detach().to(device, dtype, copy=True).requires_grad_())
        rgb, alpha, depth = (gradient.to(device, dtype) for gradient in self.gradients)
        cameras = self.cameras.to(device)
        return Scene(gaussians, cameras, self.background.to(device, dtype), (rgb, alpha, depth))

    def zero_grad(self) -> None:
        """Remove the gradients, as an optimizer does before each step."""
        for tensor in self.gaussians.tensors().values():
            tensor.grad = None


def make_shell(count: int, degree: int, device: torch.device) -> Gaussians:
    """Return ``count`` splats on a bumpy sphere, with colours up to ``degree``."""
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    directions = torch.nn.functional.normalize(normal(count, 3), dim=-1)
    spacing = math.sqrt(4 * math.pi * RADIUS**2 / count)
    gaussians = Gaussians(
        means=directions * (RADIUS + 0.05 * normal(count, 1)),
        log_scales=math.log(0.7 * spacing) + 0.3 * normal(count, 3),
        quats=normal(count, 4),
        opacity_logits=0.4 + normal(count),
        sh=0.5 * normal(count, (degree + 1) ** 2, 3),
    )
    return gaussians.to(device).map(lambda tensor: tensor.requires_grad_())


def make_scene(gaussians: Gaussians, size: int, views: int) -> Scene:
    """Return a scene of the splats from ``views`` sides, in squares of ``size`` pixels on white."""
    generator, device = torch.Generator().manual_seed(1), gaussians.device
    cameras = turntable(views, elevation_deg=20.0, distance=3.0, fov_y_deg=40.0, size=size)
    gradients = [torch.randn(views, size, size, *more, generator=generator) for more in ((3,), (), ())]
    rgb, alpha, depth = (gradient.to(device) for gradient in gradients)
    return Scene(gaussians, cameras.to(device), torch.ones(views, 3, device=device), (rgb, alpha, depth))
