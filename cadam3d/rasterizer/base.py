"""Rasterizer: the interface that renders Gaussians into images, differentiably."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.cameras import Cameras
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.rendering import OverflowedError, RenderFn, RenderOutput

# The signature of :meth:`Rasterizer.render`.
Render = Callable[[Gaussians, Cameras, Tensor, bool], RenderOutput]
T = TypeVar("T")

# Constants of the image formation model, shared by every backend and compatible with gsplat.

# Added to the diagonal of each projected covariance.
BLUR = 0.3  # pixels^2
# A fainter contribution to a pixel is skipped.
ALPHA_MIN = 1 / 255
# A stronger contribution is capped, with zero gradient to whatever was capped.
ALPHA_MAX = 0.99
# A pixel stops before the splat that would bring its transmittance to this value or below.
TRANSMITTANCE_MIN = 1e-4
# Centres at this distance or nearer are culled.
NEAR = 0.01  # world units
# Centres at this distance or farther are culled, before the gradient of depth exceeds float32.
FAR = 1e15  # world units
# Outside the image the Jacobian is evaluated at most this share of the image size beyond the border.
FRUSTUM_MARGIN = 0.15
CONSTANTS = ("BLUR", "ALPHA_MIN", "ALPHA_MAX", "TRANSMITTANCE_MIN", "NEAR", "FAR", "FRUSTUM_MARGIN")
KERNELS = Path(__file__).parent / "kernels"


def definitions() -> list[str]:
    """Return the flags of a compiler that define the constants for native kernels."""
    return [f"-DSPLAT_{name}={globals()[name]!r}" for name in CONSTANTS]


@dataclass(frozen=True)
class Backend:
    """The rasterizer that renders on a device."""

    name: str  # as in rasterizer=<name>
    # Why nothing faster renders, and what to type; None if nothing faster exists.
    reason: str | None = None


class Rasterizer(ABC):
    """Renders Gaussians. A component is its hyper-parameters, so it holds no tensors."""

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
        its own gradient, so ``backward()`` fills ``output.means2d.grad``.

        Gaussians that are behind a camera, ``FAR`` or farther in front of it, off screen, too faint or not
        finite are culled. So are Gaussians with a quaternion of a squared length below 1e-12, which has no
        direction. A culled Gaussian has radius 0, contributes nothing, and gets a gradient of zero, never
        NaN.

        With ``absgrad``, ``backward()`` fills ``output.absgrad.grad`` too. It is the sum over the pixels of
        the absolute value of what each pixel adds to ``means2d.grad``, so opposite contributions do not
        cancel. It changes no other result.
        """

    def render_ahead(
        self,
        gaussians: Gaussians,
        cameras: Cameras,
        background: Float[Tensor, "v 3"],
        absgrad: bool = False,
    ) -> RenderOutput:
        """Render as :meth:`render` does, with the same bits, but if possible without waiting for the device.

        Memory is then reserved before its size is known. If it is too small, ``output.overflowed`` is true:
        the images show only the background, all gradients are zero, and the work must be repeated with
        :meth:`render`, which :meth:`ahead` does. By default this is :meth:`render`, which never overflows.
        """
        return self.render(gaussians, cameras, background, absgrad)

    def ahead(self, work: Callable[[Render], T], generators: Iterable[torch.Generator]) -> T:
        """Return ``work(render)``, where ``render`` does not wait for the device if possible.

        If ``work`` finds that too little memory was reserved, when it calls :meth:`RenderOutput.read`, it is
        done again with the same random numbers and with exactly as much memory as needed. So ``work`` may
        change nothing that a repetition does not overwrite, except its ``generators``.
        """
        draws_before = [(generator, generator.get_state()) for generator in generators]
        try:
            return work(self.render_ahead)
        except OverflowedError:
            for generator, draws in draws_before:
                generator.set_state(draws)
        return work(self.render)

    def prepare(self, device: torch.device) -> Backend:
        """Compile and load everything that rendering on ``device`` needs, and return the backend for it.

        Raises :class:`UserError` if that fails. Without this call, the first render does the same.
        """
        return Backend(type(self).__name__.removesuffix("Rasterizer").lower())


def render_fn(rasterizer: Rasterizer, gaussians: Callable[[], Gaussians]) -> RenderFn:
    """Return a function that renders the Gaussians that ``gaussians()`` returns at the time of the call.

    Cameras and backgrounds may be on any device; they are moved to the device of the Gaussians. The images
    carry no gradient.
    """

    def render(
        cameras: Cameras, background: Float[Tensor, "v 3"], shown: Gaussians | None = None
    ) -> RenderOutput:
        current = (gaussians() if shown is None else shown).detach()
        with torch.no_grad():
            return rasterizer.render(current, cameras.to(current.device), background.to(current.device))

    return render


def absgrad_probe(means2d: Float[Tensor, "v n 2"], wanted: bool) -> Float[Tensor, "v n 2"] | None:
    """Return the ``absgrad`` of a :class:`RenderOutput`: zeros that collect a gradient.

    Returns ``None`` if it is not wanted or gradients are off.
    """
    return torch.zeros_like(means2d, requires_grad=True) if wanted and torch.is_grad_enabled() else None
