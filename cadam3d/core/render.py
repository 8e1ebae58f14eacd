"""RenderOutput: what every rasterizer returns; RenderFn: how the rest of the house asks for one."""

from collections.abc import Callable
from dataclasses import dataclass

from jaxtyping import Bool, Float
from torch import Tensor

from cadam3d.core.cameras import Cameras


@dataclass(frozen=True)
class RenderOutput:
    """Images of ``v`` views and the per-view facts that densifiers need."""

    rgb: Float[Tensor, "v h w 3"]  # composited over the background; not clamped above
    alpha: Float[Tensor, "v h w"]  # in [0, 1)
    depth: Float[Tensor, "v h w"]  # expected camera z, sum(w z) / sum(w), world units; 0 where alpha is 0
    means2d: Float[Tensor, "v n 2"]  # pixels; keeps its gradient while training
    radii: Float[Tensor, "v n"]  # pixels; 0 = not seen
    # Only where it was asked for, and gradients are on: zeros. What a backward pass leaves as their gradient
    # is no derivative, but the sum over pixels of |dLoss/dmeans2d|, each axis by itself (AbsGS).
    absgrad: Float[Tensor, "v n 2"] | None = None

    @property
    def visible(self) -> Bool[Tensor, "v n"]:
        """Which Gaussians touched which view."""
        return self.radii > 0


# Cameras and one RGB background per view (in [0, 1]) to images of the Gaussians at hand, without gradients.
RenderFn = Callable[[Cameras, Tensor], RenderOutput]

# Cameras and one background per view to the true images of each mode, "m v h w 3": known only to some priors.
TruthFn = Callable[[Cameras, Tensor], Tensor]
