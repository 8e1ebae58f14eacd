"""RenderOutput: what every rasterizer returns; RenderFn: how the rest of the house asks for one."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from cadam3d.core.cameras import Cameras

SOLID = 0.9  # alpha from which a pixel counts as object when disparities are stretched
FLAT = 1e-6  # per world unit; a smaller spread of inverse depths is not stretched to the whole range


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

    def disparity(self) -> Float[Tensor, "v h w"]:
        """Closeness as a grey image in [0, 1], with gradient: the object's nearest point is 1, the rest less.

        Inverse depth times alpha, which puts the background infinitely far away; then stretched per view: the
        farthest solid pixel (alpha from 0.9 on) becomes 0, and all that is fainter than it stays 0. This is
        LucidDreamer's picture of depth, whose background lies far behind the object.
        """
        is_hit = self.alpha > 0
        inverse = torch.where(is_hit, self.alpha / torch.where(is_hit, self.depth, 1.0), 0.0)
        is_solid = self.alpha >= SOLID
        farthest = torch.where(is_solid, inverse, torch.inf).amin(dim=(1, 2), keepdim=True)
        farthest = torch.where(is_solid.any(dim=2).any(dim=1)[:, None, None], farthest, 0.0)
        spread = (inverse.amax(dim=(1, 2), keepdim=True) - farthest).clamp_min(FLAT)
        return ((inverse - farthest) / spread).clamp(0, 1)


# Cameras and one RGB background per view (in [0, 1]) to images of the Gaussians at hand, without gradients.
RenderFn = Callable[[Cameras, Tensor], RenderOutput]

# Cameras and one background per view to the true images of each mode, "m v h w 3": known only to some priors.
TruthFn = Callable[[Cameras, Tensor], Tensor]
