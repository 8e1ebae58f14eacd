"""The automatic choice of a rasterizer: the fastest that works on the device of the Gaussians."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.cameras import Cameras
from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.render import RenderOutput
from cadam3d.rasterizer.base import Backend, Rasterizer
from cadam3d.rasterizer.cpu import CpuRasterizer
from cadam3d.rasterizer.cuda import CudaRasterizer
from cadam3d.rasterizer.reference import ReferenceRasterizer
from cadam3d.rasterizer.selftest import self_test

REPORT = "Please report this with the output of `cadam3d doctor`. Try: rasterizer=reference"


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

    def prepare(self, device: torch.device) -> Backend:
        """See :meth:`Rasterizer.prepare`. If the reference was chosen as a fallback, the reason is given."""
        return choose(device).backend


@dataclass(frozen=True)
class Choice:
    """A rasterizer that works on a device, and its name."""

    rasterizer: Rasterizer
    backend: Backend


def choose(device: torch.device) -> Choice:
    """Return the rasterizer that ``rasterizer=auto`` uses on ``device``."""
    if device.type == "cuda" and device.index is None and torch.cuda.is_available():
        device = torch.device("cuda", torch.cuda.current_device())
    return _choose(device)


@cache
def _choose(device: torch.device) -> Choice:
    reference = ReferenceRasterizer()
    if device.type not in FASTEST:
        return Choice(reference, reference.prepare(device))
    try:
        rasterizer = FASTEST[device.type](device)
        return Choice(rasterizer, rasterizer.prepare(device))
    except UserError as error:
        _refuse_broken(device)
        return Choice(reference, replace(reference.prepare(device), reason=str(error)))


def native_cpu(device: torch.device) -> Rasterizer:
    """Return the native CPU rasterizer, which is tested when its kernels are built."""
    rasterizer = CpuRasterizer(cache_dir=None)
    rasterizer.prepare(device)
    return rasterizer


def checked_cuda(device: torch.device) -> Rasterizer:
    """Return the CUDA rasterizer. Raises :class:`UserError` unless it passes the self-test on ``device``."""
    rasterizer = CudaRasterizer(cache_dir=None)
    rasterizer.prepare(device)
    name = torch.cuda.get_device_name(device)
    try:
        agreement = self_test(rasterizer, device)
    except (RuntimeError, MemoryError) as error:
        reason = str(error).splitlines()[0]
        raise UserError(
            f"rasterizer=cuda cannot finish its self-test on {name}: {reason}. {REPORT}"
        ) from error
    if not (agreement.holds and agreement.repeats):
        raise UserError(f"rasterizer=cuda fails its self-test on {name}: it {agreement}. {REPORT}")
    return rasterizer


# For each type of device, a function that returns a rasterizer that works there or raises UserError.
FASTEST: Mapping[str, Callable[[torch.device], Rasterizer]] = {"cpu": native_cpu, "cuda": checked_cuda}


def _refuse_broken(device: torch.device) -> None:
    """Raise :class:`UserError` if a failed kernel has made the device unusable.

    A kernel that accesses invalid memory makes the device unusable for the whole process, so the reference
    could not render there either.
    """
    if device.type == "cuda" and torch.cuda.is_available():
        try:
            torch.cuda.synchronize(device)
        except RuntimeError as error:
            reason = str(error).splitlines()[0]
            raise UserError(
                f"rasterizer=auto: the self-test of rasterizer=cuda broke {device} ({reason}). "
                "Try: rasterizer=reference"
            ) from error
