"""The autograd graph around native kernels, shared by the CPU and the CUDA rasterizer.

The graph has two steps: ``means -> means2d``, and ``means2d and everything else -> images``. So ``means2d``
is an ordinary node of the graph: it can retain its gradient, and a loss may use it.
"""

from abc import ABC, abstractmethod

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from cadam3d.core.cameras import Cameras
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.rendering import RenderOutput
from cadam3d.rasterizer.base import absgrad_probe

# The numbers of coefficients of degree 0 to 3.
SH_SIZES = (1, 4, 9, 16)


class RenderPass(ABC):
    """One call of a rasterizer: its cameras, and everything that the kernels keep for the backward pass.

    Tensors are contiguous float32 on the device of the Gaussians. ``parameters`` are the tensors of
    :meth:`Gaussians.tensors`, in that order.
    """

    # Memory that the kernels fill in the forward pass and read in the backward pass. Autograd saves it, so
    # that it is freed after the backward pass even if the images live on.
    kept: tuple[Tensor, ...] = ()
    # Whether reserved memory was too small; see RenderOutput.
    overflowed: Tensor | None = None

    def __init__(self, cameras: Cameras, device: torch.device, absgrad: bool = False) -> None:
        self.height, self.width, self.device = cameras.height, cameras.width, device
        # Whether the backward pass computes absgrad as well.
        self.absgrad = absgrad
        self.matrices = plain(cameras.world_to_camera.detach(), device)
        self.intrinsics = plain(cameras.intrinsics.detach(), device)

    def __enter__(self) -> "RenderPass":
        """Enter the context in which the other methods must be called."""
        return self

    def __exit__(self, *_: object) -> None:
        """Leave that context. From here on, only autograd keeps the memory."""
        self.kept = ()

    @property
    def views(self) -> int:
        """Return the number of views."""
        return self.matrices.shape[0]

    @abstractmethod
    def project(self, parameters: list[Tensor]) -> tuple[Tensor, Tensor]:
        """Return ``means2d`` [v n 2] and ``radii`` [v n]. This is the first call."""

    @abstractmethod
    def blend(
        self, parameters: list[Tensor], background: Tensor, keeps: bool
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return ``rgb`` [v h w 3], ``alpha`` and ``depth`` [v h w].

        With ``keeps``, a backward pass may follow, which needs the intermediate results.
        """

    @abstractmethod
    def blend_backward(
        self, parameters: list[Tensor], background: Tensor, images: list[Tensor | None]
    ) -> list[Tensor | None]:
        """Return the gradients of means2d and the parameters, with absgrad (or ``None``) in second place.

        The gradients of the parameters leave out the path through means2d. ``images`` are alpha, depth, and
        the gradients of rgb, alpha and depth, each of which may be ``None``.
        """

    @abstractmethod
    def centre_backward(self, parameters: list[Tensor], radii: Tensor, grad_means2d: Tensor) -> Tensor:
        """Return the gradient of the means that arrives through means2d."""


def run_pass(kernels: RenderPass, gaussians: Gaussians, background: Float[Tensor, "v 3"]) -> RenderOutput:
    """Render with the kernels of one pass, with autocast off; see ``Rasterizer.render``."""
    # Entering this context takes longer than all of the ordinary checks together.
    if torch.is_autocast_enabled(gaussians.device.type):
        with torch.autocast(gaussians.device.type, enabled=False):
            return run_pass(kernels, gaussians, background)
    dtype, device = gaussians.means.dtype, gaussians.device
    means, *others = (plain(tensor, device) for tensor in gaussians.tensors().values())
    keeps = torch.is_grad_enabled()
    with kernels:
        means2d, radii = _Project.apply(kernels, means, others)
        means2d = means2d.to(dtype)
        if keeps:
            means2d.requires_grad_().retain_grad()
        probe = absgrad_probe(means2d, kernels.absgrad)
        tensors = (means, *others, plain(background, device))
        probed = None if probe is None else plain(probe, device)
        images = _BlendViews.apply(kernels, keeps, plain(means2d, device), probed, *tensors)
    rgb, alpha, depth = (image.to(dtype) for image in images)
    return RenderOutput(
        rgb=rgb,
        alpha=alpha,
        depth=depth,
        means2d=means2d,
        radii=radii.to(dtype),
        absgrad=probe,
        overflowed=kernels.overflowed,
    )


class _Project(torch.autograd.Function):
    """Maps Gaussians to ``means2d`` and ``radii``; projected centres depend on the means alone."""

    @staticmethod
    def forward(ctx, kernels: RenderPass, means: Tensor, others: list[Tensor]) -> tuple[Tensor, Tensor]:
        parameters = [means, *others]
        means2d, radii = kernels.project(parameters)
        ctx.kernels = kernels
        ctx.save_for_backward(*parameters, radii, *kernels.kept)
        ctx.mark_non_differentiable(radii)
        ctx.set_materialize_grads(False)
        return means2d, radii

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_means2d: Tensor | None, _: None) -> tuple[Tensor | None, ...]:
        if grad_means2d is None:
            return None, None, None
        kernels, saved = ctx.kernels, ctx.saved_tensors
        *parameters, radii = saved[:6]
        with kernels:
            kernels.kept = saved[6:]
            grad_means = kernels.centre_backward(parameters, radii, grad_means2d.contiguous())
        return None, grad_means, None


class _BlendViews(torch.autograd.Function):
    """Maps ``means2d``, the probe for ``absgrad``, the raw parameters and the backgrounds to images."""

    @staticmethod
    def forward(
        ctx, kernels: RenderPass, keeps: bool, means2d: Tensor, probe: Tensor | None, *tensors: Tensor
    ) -> tuple[Tensor, ...]:
        *parameters, background = tensors
        rgb, alpha, depth = kernels.blend(parameters, background, keeps)
        ctx.kernels = kernels
        ctx.save_for_backward(*tensors, alpha, depth, *kernels.kept)
        ctx.set_materialize_grads(False)
        return rgb, alpha, depth

    @staticmethod
    @once_differentiable
    def backward(ctx, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        kernels, saved = ctx.kernels, ctx.saved_tensors
        *parameters, background, alpha, depth = saved[:8]
        images = [alpha, depth, *(None if grad is None else grad.contiguous() for grad in grads)]
        with kernels:
            kernels.kept = saved[8:]
            totals = kernels.blend_backward(parameters, background, images)
        grad_background = None
        if ctx.needs_input_grad[-1] and grads[0] is not None:
            grad_background = (grads[0] * (1 - alpha)[..., None]).sum(dim=(1, 2))
        return None, None, *totals, grad_background


def plain(tensor: Tensor, device: torch.device) -> Tensor:
    """Return the tensor as kernels read it: contiguous float32 on ``device``."""
    if tensor.dtype is torch.float32 and tensor.device == device and tensor.is_contiguous():
        return tensor
    return tensor.to(device, torch.float32).contiguous()


def require_shapes(gaussians: Gaussians, cameras: Cameras, background: Tensor) -> None:
    """Raise ``ValueError`` unless all shapes fit together; a kernel would read outside of its tensors."""
    n, v, k = len(gaussians), len(cameras), gaussians.sh.shape[1]
    wanted = {"means": (n, 3), "log_scales": (n, 3), "quats": (n, 4), "opacity_logits": (n,), "sh": (n, k, 3)}
    shapes = {name: tuple(tensor.shape) for name, tensor in gaussians.tensors().items()}
    if shapes != wanted or k not in SH_SIZES:
        raise ValueError(f"Gaussians: expected {wanted} with k in {SH_SIZES}, got {shapes}")
    views = [tuple(each.shape) for each in (cameras.world_to_camera, cameras.intrinsics, background)]
    if views != [(v, 4, 4), (v, 3, 3), (v, 3)] or min(cameras.height, cameras.width) < 1:
        raise ValueError(f"cameras and background: expected (v, 4, 4), (v, 3, 3), (v, 3), got {views}")
