"""The automatic choice of a rasterizer: the fastest that works on the device of the Gaussians."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.cameras import Cameras
from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.rendering import RenderOutput
from cadam3d.rasterizer.base import Backend, Rasterizer
from cadam3d.rasterizer.cpu import CpuRasterizer
from cadam3d.rasterizer.cuda import CudaRasterizer
from cadam3d.rasterizer.gsplat import GsplatRasterizer
from cadam3d.rasterizer.reference import ReferenceRasterizer
from cadam3d.rasterizer.selftest import GSPLAT, OWN, Demands, self_test


@dataclass(frozen=True, kw_only=True)
class AutoRasterizer(Rasterizer):
    """Renders with the compiled kernels for the device of the Gaussians, or else with the reference.

    On CUDA, gsplat comes between them. The choice is made once per device and process.
    """

    def render(
        self,
        gaussians: Gaussians,
        cameras: Cameras,
        background: Float[Tensor, "v 3"],
        absgrad: bool = False,
    ) -> RenderOutput:
        """See :meth:`Rasterizer.render`."""
        return choose(gaussians.device).rasterizer.render(gaussians, cameras, background, absgrad)

    def render_ahead(
        self,
        gaussians: Gaussians,
        cameras: Cameras,
        background: Float[Tensor, "v 3"],
        absgrad: bool = False,
    ) -> RenderOutput:
        """See :meth:`Rasterizer.render_ahead`."""
        return choose(gaussians.device).rasterizer.render_ahead(gaussians, cameras, background, absgrad)

    def prepare(self, device: torch.device) -> Backend:
        """See :meth:`Rasterizer.prepare`. If the choice is not the fastest, the reason is given."""
        return choose(device).backend


@dataclass(frozen=True)
class Chosen:
    """A rasterizer that works on a device, and its name."""

    rasterizer: Rasterizer
    backend: Backend


def choose(device: torch.device) -> Chosen:
    """Return the rasterizer that ``rasterizer=auto`` uses on ``device``."""
    if device.type == "cuda" and device.index is None and torch.cuda.is_available():
        device = torch.device("cuda", torch.cuda.current_device())
    return _choose(device)


@cache
def _choose(device: torch.device) -> Chosen:
    reason: str | None = None
    for rasterizer, demands in FASTEST.get(device.type, ()):
        try:
            backend = rasterizer.prepare(device)
            if demands is not None:
                require_agreement(rasterizer, device, demands)
            return Chosen(rasterizer, replace(backend, reason=reason))
        except UserError as error:
            reason = reason or str(error)
    reference = ReferenceRasterizer()
    return Chosen(reference, replace(reference.prepare(device), reason=reason))


def require_agreement(rasterizer: Rasterizer, device: torch.device, demands: Demands) -> None:
    """Raise :class:`UserError` unless the rasterizer passes the self-test on ``device``."""
    try:
        found = self_test(rasterizer, device, demands)
    except Exception as error:
        # Another version of a library may raise anything, also without a message.
        found = f"{type(error).__name__}: {error}".splitlines()[0]
    if isinstance(found, str) or not found.passes:
        key, name = f"rasterizer={rasterizer.prepare(device).name}", torch.cuda.get_device_name(device)
        raise UserError(f"{key} fails its self-test on {name}: {found}. Try: cadam3d doctor")


# For each type of device, the rasterizers with what their self-test demands, the fastest first. The kernels
# for CPUs are tested when they are built. Our kernels for GPUs come before gsplat because they repeat their
# bits and need no nvcc.
FASTEST: Mapping[str, Sequence[tuple[Rasterizer, Demands | None]]] = {
    "cpu": [(CpuRasterizer(cache_dir=None), None)],
    "cuda": [(CudaRasterizer(cache_dir=None), OWN), (GsplatRasterizer(), GSPLAT)],
}
