"""The best rasterizer for the device the Gaussians live on: what a user who does not care gets."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.cameras import Cameras
from cadam3d.core.checks import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.render import RenderOutput
from cadam3d.rasterizer import cuda
from cadam3d.rasterizer.base import Rasterizer
from cadam3d.rasterizer.cpu import CpuRasterizer, load_kernels
from cadam3d.rasterizer.reference import ReferenceRasterizer


@dataclass(frozen=True)
class Candidate:
    """A backend, and the question whether it works here."""

    name: str  # what a user types to have it: rasterizer=<name>
    works_on: Callable[[torch.device], bool]  # must answer, not raise
    build: Callable[[], Rasterizer]


def has_native_kernels(device: torch.device) -> bool:
    """Whether the native rasterizer serves ``device``: its kernels are compiled or cached now, to be sure.

    Where that fails, one warning says why and what to install; the reference then takes its place.
    """
    if device.type != "cpu":
        return False
    try:
        load_kernels(None)
    except UserError as error:
        warnings.warn(f"Rendering with the slow reference rasterizer, for {error}", stacklevel=2)
        return False
    return True


def has_cuda_kernels(device: torch.device) -> bool:
    """Whether the CUDA rasterizer serves ``device``: its kernels are compiled and loaded now, to be sure.

    Where that fails on a CUDA device, one warning says why; the reference then takes its place.
    """
    try:
        return cuda.works_on(device)
    except UserError as error:
        warnings.warn(f"Rendering with the slow reference rasterizer, for {error}", stacklevel=2)
        return False


CANDIDATES = (  # fastest first; the last one works everywhere
    Candidate("cuda", has_cuda_kernels, partial(cuda.CudaRasterizer, cache_dir=None)),
    Candidate("cpu", has_native_kernels, partial(CpuRasterizer, cache_dir=None)),
    Candidate("reference", lambda device: True, ReferenceRasterizer),
)


@dataclass(frozen=True, kw_only=True)
class AutoRasterizer(Rasterizer):
    """Renders with the first of ``CANDIDATES`` that works on the device of the Gaussians.

    The question is asked once per device, at the first render; the answer holds as long as the process lives.
    """

    def render(
        self, gaussians: Gaussians, cameras: Cameras, background: Float[Tensor, "v 3"]
    ) -> RenderOutput:
        """See :meth:`Rasterizer.render`."""
        _, rasterizer = _choose(gaussians.device)
        return rasterizer.render(gaussians, cameras, background)

    def chosen(self, device: torch.device) -> str:
        """Name of the backend that renders Gaussians on ``device``, as in ``rasterizer=<name>``."""
        name, _ = _choose(device)
        return name


@cache
def _choose(device: torch.device) -> tuple[str, Rasterizer]:
    candidate = next(candidate for candidate in CANDIDATES if candidate.works_on(device))
    return candidate.name, candidate.build()
