"""The automatic choice of a rasterizer: the fastest that works on the device of the Gaussians."""

from collections.abc import Callable, Mapping, Sequence
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

REPORT = "Please report this with what the following prints. Try: cadam3d doctor"


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
    failures: list[str] = []
    for name, candidate in FASTEST.get(device.type, {}).items():
        try:
            rasterizer = candidate(device)
            backend = rasterizer.prepare(device)
            return Chosen(rasterizer, replace(backend, reason=_reason(failures)))
        except UserError as error:
            _refuse_broken(name, device)
            failures.append(str(error))
    reference = ReferenceRasterizer()
    return Chosen(reference, replace(reference.prepare(device), reason=_reason(failures)))


def _reason(failures: Sequence[str]) -> str | None:
    """Return all messages as one, with what to type in the last one; ``None`` if there is none."""
    whole = [*(message.partition(" Try: ")[0] for message in failures[:-1]), *failures[-1:]]
    return " ".join(whole) or None


def native_cpu(device: torch.device) -> Rasterizer:
    """Return the native CPU rasterizer, which is tested when its kernels are built."""
    rasterizer = CpuRasterizer(cache_dir=None)
    rasterizer.prepare(device)
    return rasterizer


def checked_cuda(device: torch.device) -> Rasterizer:
    """Return the CUDA rasterizer. Raises :class:`UserError` unless it passes the self-test on ``device``."""
    return _checked(CudaRasterizer(cache_dir=None), device, OWN)


def checked_gsplat(device: torch.device) -> Rasterizer:
    """Return gsplat. Raises :class:`UserError` unless it is installed and passes the self-test."""
    return _checked(GsplatRasterizer(), device, GSPLAT)


def _checked(rasterizer: Rasterizer, device: torch.device, demands: Demands) -> Rasterizer:
    key, name = f"rasterizer={rasterizer.prepare(device).name}", torch.cuda.get_device_name(device)
    try:
        agreement = self_test(rasterizer, device, demands)
    except Exception as error:
        # Another version of a library may raise anything, also without a message.
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        raise UserError(f"{key} cannot finish its self-test on {name}: {reason}. {REPORT}") from error
    if not agreement.passes:
        raise UserError(f"{key} fails its self-test on {name}: it {agreement}. {REPORT}")
    return rasterizer


# For each type of device, rasterizers by name, the fastest first: functions that return one that works there
# or raise UserError. Our kernels come before gsplat because they repeat their bits and need no nvcc.
FASTEST: Mapping[str, Mapping[str, Callable[[torch.device], Rasterizer]]] = {
    "cpu": {"cpu": native_cpu},
    "cuda": {"cuda": checked_cuda, "gsplat": checked_gsplat},
}


def _refuse_broken(name: str, device: torch.device) -> None:
    """Raise :class:`UserError` if a failed kernel has made the device unusable.

    A kernel that accesses invalid memory makes the device unusable for the whole process, so no other
    rasterizer could render there either.
    """
    if device.type == "cuda" and torch.cuda.is_available():
        try:
            torch.cuda.synchronize(device)
        except RuntimeError as error:
            reason = str(error).splitlines()[0]
            raise UserError(
                f"rasterizer=auto: the self-test of rasterizer={name} broke {device} ({reason}). "
                "Try: rasterizer=reference"
            ) from error
