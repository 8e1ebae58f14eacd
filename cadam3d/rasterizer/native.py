"""What rasterizers with kernels of their own share: the autograd graph around the kernels.

``means -> means2d`` is one step, ``means2d and everything else -> images`` the other, so ``means2d`` is an
honest node of the graph: its gradient is there to be retained, and a loss may use it.
"""

from abc import ABC, abstractmethod

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from cadam3d.core.cameras import Cameras
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.render import RenderOutput
from cadam3d.rasterizer.base import absgrad_probe

SH_SIZES = (1, 4, 9, 16)  # coefficients of degree 0 to 3


class Frame(ABC):
    """One call of a rasterizer: its cameras, and what the kernels keep for the way back.

    Tensors are contiguous float32 on the device of the Gaussians; ``parameters`` are those of
    :meth:`Gaussians.tensors`, in that order.
    """

    def __init__(self, cameras: Cameras, device: torch.device, absgrad: bool = False) -> None:
        self.height, self.width, self.device = cameras.height, cameras.width, device
        self.absgrad = absgrad  # whether the backward brings that, too
        self.matrices = plain(cameras.world_to_camera.detach(), device)
        self.intrinsics = plain(cameras.intrinsics.detach(), device)

    @property
    def views(self) -> int:
        """How many."""
        return self.matrices.shape[0]

    @abstractmethod
    def project(self, parameters: list[Tensor]) -> tuple[Tensor, Tensor]:
        """``means2d`` [v n 2] and ``radii`` [v n]; comes first."""

    @abstractmethod
    def blend(
        self, parameters: list[Tensor], background: Tensor, keeps: bool
    ) -> tuple[Tensor, Tensor, Tensor]:
        """``rgb`` [v h w 3], ``alpha`` and ``depth`` [v h w]; ``keeps``: whether a backward may come."""

    @abstractmethod
    def blend_backward(
        self, parameters: list[Tensor], background: Tensor, images: list[Tensor | None]
    ) -> list[Tensor | None]:
        """Gradients of means2d, absgrad (``None`` unless wanted) and the parameters.

        Those of the parameters lack the path through means2d. ``images``: alpha, depth, and the gradients of
        rgb, alpha and depth, each of which may be ``None``.
        """

    @abstractmethod
    def centre_backward(self, parameters: list[Tensor], radii: Tensor, grad_means2d: Tensor) -> Tensor:
        """Gradient of the means through means2d."""


def render_frame(frame: Frame, gaussians: Gaussians, background: Float[Tensor, "v 3"]) -> RenderOutput:
    """Render the frame, with autocast off; see ``Rasterizer.render``."""
    dtype, device = gaussians.means.dtype, gaussians.device
    means, *others = (plain(tensor, device) for tensor in gaussians.tensors().values())
    with torch.autocast(device.type, enabled=False):
        means2d, radii = _Project.apply(frame, means, *(tensor.detach() for tensor in others))
        means2d = means2d.to(dtype)
        keeps = torch.is_grad_enabled()
        if keeps:
            means2d.requires_grad_().retain_grad()
        probe = absgrad_probe(means2d, frame.absgrad)
        tensors = (means, *others, plain(background, device))
        probed = None if probe is None else plain(probe, device)
        images = _Blend.apply(frame, keeps, plain(means2d, device), probed, *tensors)
        rgb, alpha, depth = (image.to(dtype) for image in images)
    radii = radii.to(dtype)
    return RenderOutput(rgb=rgb, alpha=alpha, depth=depth, means2d=means2d, radii=radii, absgrad=probe)


class _Project(torch.autograd.Function):
    """Gaussians to ``means2d`` and ``radii``; differentiable in the means alone, as a centre is."""

    @staticmethod
    def forward(ctx, frame: Frame, *parameters: Tensor) -> tuple[Tensor, Tensor]:
        means2d, radii = frame.project(list(parameters))
        ctx.frame = frame
        ctx.save_for_backward(*parameters, radii)
        ctx.mark_non_differentiable(radii)
        return means2d, radii

    @staticmethod
    @once_differentiable
    def backward(ctx, *grads: Tensor) -> tuple[Tensor | None, ...]:
        *parameters, radii = ctx.saved_tensors
        grad_means = ctx.frame.centre_backward(parameters, radii, grads[0].contiguous())
        return None, grad_means, None, None, None, None


class _Blend(torch.autograd.Function):
    """``means2d``, the probe for ``absgrad``, the raw parameters and the backgrounds to images."""

    @staticmethod
    def forward(
        ctx, frame: Frame, keeps: bool, means2d: Tensor, probe: Tensor | None, *tensors: Tensor
    ) -> tuple[Tensor, ...]:
        *parameters, background = tensors
        rgb, alpha, depth = frame.blend(parameters, background, keeps)
        ctx.frame = frame
        ctx.save_for_backward(*tensors, alpha, depth)
        ctx.set_materialize_grads(False)
        return rgb, alpha, depth

    @staticmethod
    @once_differentiable
    def backward(ctx, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        *parameters, background, alpha, depth = ctx.saved_tensors
        images = [alpha, depth, *(None if grad is None else grad.contiguous() for grad in grads)]
        totals = ctx.frame.blend_backward(parameters, background, images)
        grad_background = None
        if ctx.needs_input_grad[-1] and grads[0] is not None:
            grad_background = (grads[0] * (1 - alpha)[..., None]).sum(dim=(1, 2))
        return None, None, *totals, grad_background


def plain(tensor: Tensor, device: torch.device) -> Tensor:
    """As a kernel reads it: contiguous float32."""
    return tensor.to(device, torch.float32).contiguous()


def require_shapes(gaussians: Gaussians, cameras: Cameras, background: Tensor) -> None:
    """Raise ``ValueError`` unless all fit together: a kernel would read foreign memory."""
    n, v, k = len(gaussians), len(cameras), gaussians.sh.shape[1]
    wanted = {"means": (n, 3), "log_scales": (n, 3), "quats": (n, 4), "opacity_logits": (n,), "sh": (n, k, 3)}
    shapes = {name: tuple(tensor.shape) for name, tensor in gaussians.tensors().items()}
    if shapes != wanted or k not in SH_SIZES:
        raise ValueError(f"Gaussians: expected {wanted} with k in {SH_SIZES}, got {shapes}")
    views = [tuple(each.shape) for each in (cameras.world_to_camera, cameras.intrinsics, background)]
    if views != [(v, 4, 4), (v, 3, 3), (v, 3)] or min(cameras.height, cameras.width) < 1:
        raise ValueError(f"cameras and background: expected (v, 4, 4), (v, 3, 3), (v, 3), got {views}")
