"""GDAGS: split where the gradients of pixels conflict, clone where they agree (Zhou et al. 2026).

"Gradient-Direction-Aware Density Control for 3D Gaussian Splatting", arXiv 2508.09239.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.checks import AtLeastZero, Positive
from cadam3d.core.schedule import Schedule
from cadam3d.densifier.absgrad import AbsGrad, AbsGradState


@dataclass(frozen=True, kw_only=True)
class Gdags(AbsGrad):
    """Select by the baseline's gradient times a weight for splits, and divided by it for clones.

    The weight of a Gaussian is ``offset + scale (1 - C)^power``. C is its gradient coherence ratio: the norm
    of the sum of its pixels' gradients over the sum of their norms, 1 if all pixels pull in one direction and
    0 if they cancel. Here the denominator is the norm of the sums of absolute values along x and y, as in
    AbsGS. It is at most the sum of norms and at least 0.71 of it, so C is up to 1.41 times that of the paper.
    Both norms are added up over the views since the last refinement before they are divided.
    """

    tau_clone: Positive | Schedule  # loss per NDC unit
    offset: Positive  # alpha in the paper
    scale: AtLeastZero  # beta in the paper
    power: Positive  # p in the paper

    def scores(self, state: AbsGradState) -> dict[str, Float[Tensor, "n"]]:
        """Return the weighted gradient norm that decides about splits, and the coherence ratio."""
        return {**super().scores(state), "coherence": self._coherence(state)}

    def _coherence(self, state: AbsGradState) -> Float[Tensor, "n"]:
        """Return the gradient coherence ratio of each Gaussian, in [0, 1]; 0 without gradients."""
        tiny = torch.finfo(state.norm_sum.dtype).tiny
        return (state.plain_sum / state.norm_sum.clamp_min(tiny)).clamp_max(1)

    def _weights(self, state: AbsGradState) -> Float[Tensor, "n"]:
        return self.offset + self.scale * (1 - self._coherence(state)) ** self.power

    def _mean_norms(self, state: AbsGradState) -> Float[Tensor, "n"]:
        return super()._clone_norms(state) * self._weights(state)

    def _clone_norms(self, state: AbsGradState) -> Float[Tensor, "n"]:
        return super()._clone_norms(state) / self._weights(state)
