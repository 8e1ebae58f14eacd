"""The best rasterizer for the device the Gaussians live on: what a user who does not care gets."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.cameras import Cameras
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.render import RenderOutput
from cadam3d.rasterizer.base import Rasterizer
from cadam3d.rasterizer.reference import ReferenceRasterizer


@dataclass(frozen=True)
class Candidate:
    """A backend, and the question whether it works here."""

    name: str  # what a user types to have it: rasterizer=<name>
    works_on: Callable[[torch.device], bool]  # must answer, not raise
    build: Callable[[], Rasterizer]


CANDIDATES = (  # fastest first; the last one works everywhere
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
