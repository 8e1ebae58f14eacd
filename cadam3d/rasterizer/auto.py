"""The automatic choice of a rasterizer: the fastest that works on the device of the Gaussians."""

from collections.abc import Mapping
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
from cadam3d.rasterizer.reference import ReferenceRasterizer
from cadam3d.rasterizer.selftest import self_test


@dataclass(frozen=True, kw_only=True)
class AutoRasterizer(Rasterizer):
    """Renders with the compiled kernels for the device of the Gaussians, or else with the reference.

    The choice is made once per device and process.
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
    reference = ReferenceRasterizer()
    fastest = FASTEST.get(device.type, reference)
    try:
        backend = fastest.prepare(device)
        # The kernels for CPUs are tested when they are built.
        if device.type == "cuda":
            require_agreement(fastest, device)
        return Chosen(fastest, backend)
    except UserError as error:
        return Chosen(reference, replace(reference.prepare(device), reason=str(error)))


def require_agreement(rasterizer: Rasterizer, device: torch.device) -> None:
    """Raise :class:`UserError` unless the rasterizer passes the self-test on ``device``."""
    try:
        found = self_test(rasterizer, device)
    except Exception as error:
        # A kernel that is wrong may raise anything, also without a message.
        found = f"{type(error).__name__}: {error}".splitlines()[0]
    if isinstance(found, str) or not found.passes:
        key, name = f"rasterizer={rasterizer.prepare(device).name}", torch.cuda.get_device_name(device)
        raise UserError(f"{key} fails its self-test on {name}: {found}. Try: cadam3d doctor")


# The fastest rasterizer for each type of device.
FASTEST: Mapping[str, Rasterizer] = {
    "cpu": CpuRasterizer(cache_dir=None),
    "cuda": CudaRasterizer(cache_dir=None),
}
