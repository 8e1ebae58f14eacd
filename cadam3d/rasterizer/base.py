"""Rasterizer: Gaussians and cameras in, images and their gradients out."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.cameras import Cameras
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.render import RenderFn, RenderOutput

# Constants of the image formation model, shared by every backend (gsplat-compatible).
BLUR = 0.3  # pixels^2 added to the diagonal of each projected covariance
ALPHA_MIN = 1 / 255  # a fainter contribution to a pixel is skipped
ALPHA_MAX = 0.99  # a stronger one is capped, with zero gradient to what is capped
TRANSMITTANCE_MIN = 1e-4  # a pixel stops before the splat that would bring it to this or below
NEAR = 0.01  # world units; this near or nearer, centres are culled
FAR = 1e15  # world units; this far or farther too, before gradients of depth leave float32
FRUSTUM_MARGIN = 0.15  # the Jacobian is evaluated at most this share of the image size outside the border


@dataclass(frozen=True)
class Backend:
    """What renders on a device."""

    name: str  # as in rasterizer=<name>
    reason: str | None = None  # why nothing faster does, and what to type; None if nothing faster exists


class Rasterizer(ABC):
    """How we see. A component is its hyper-parameters; it holds no tensors."""

    @abstractmethod
    def render(
        self,
        gaussians: Gaussians,
        cameras: Cameras,
        background: Float[Tensor, "v 3"],
        absgrad: bool = False,
    ) -> RenderOutput:
        """Render every view, differentiably in all five tensors of ``gaussians`` and in ``means2d``.

        ``background`` is one RGB colour per view, in [0, 1]. Whenever gradients are on, ``means2d`` retains
        its own gradient, so ``output.means2d.grad`` is filled by ``backward()``. Gaussians that are behind a
        camera, ``FAR`` or farther in front of it, off screen, too faint or not finite, and those whose
        quaternion has a squared length below 1e-12 and so no direction, are culled: radius 0, no
        contribution, zero gradient, never a NaN.

        With ``absgrad``, ``output.absgrad.grad`` is filled too: what each pixel adds to ``means2d.grad``, in
        absolute value and summed, so that opposite pulls do not cancel. It changes nothing else.
        """

    def prepare(self, device: torch.device) -> Backend:
        """Compile and load now what rendering on ``device`` needs, and say what will render there.

        Raises :class:`UserError` if it cannot be had. Without this call, the first render does it.
        """
        return Backend(type(self).__name__.removesuffix("Rasterizer").lower())


def render_fn(rasterizer: Rasterizer, gaussians: Callable[[], Gaussians]) -> RenderFn:
    """A :data:`RenderFn` of whatever Gaussians ``gaussians()`` returns when it is called."""

    def render(cameras, background) -> RenderOutput:
        now = gaussians().detach()
        with torch.no_grad():
            return rasterizer.render(now, cameras.to(now.device), background.to(now.device))

    return render


def absgrad_probe(means2d: Float[Tensor, "v n 2"], wanted: bool) -> Float[Tensor, "v n 2"] | None:
    """What a backend hands out as ``absgrad``; ``None`` where it is not wanted, or gradients are off."""
    return torch.zeros_like(means2d, requires_grad=True) if wanted and torch.is_grad_enabled() else None
