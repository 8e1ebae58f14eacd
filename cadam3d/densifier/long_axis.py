"""Long-axis split: one Gaussian becomes two along its longest axis that hardly overlap (Deng et al. 2025).

"Improving Densification in 3D Gaussian Splatting for High-Fidelity Rendering", arXiv 2508.12313.
"""

from dataclasses import dataclass, replace
from math import sqrt
from typing import Annotated

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from cadam3d.core.checks import Count, within
from cadam3d.core.gaussians import Gaussians
from cadam3d.densifier.base import GradientSignal
from cadam3d.densifier.baseline import Baseline, BaselineState
from cadam3d.densifier.refine import Refine, RefinePlan

# Standard deviations at which 3DGS ends a Gaussian.
RADIUS = 3.0


@dataclass(frozen=True, kw_only=True)
class LongAxisRefine(Refine):
    """Replace every selected Gaussian by two along its longest axis; draw nothing and clone nothing.

    The centres of the children are at ``offset`` of the parent's radius, and they end where the parent ends.
    Across the axis a child is as wide as the parent is at the centre of the child.
    """

    offset: float
    opacity: float

    def splits(self, gaussians: Gaussians) -> Bool[Tensor, "n"]:
        """Return the mask of all Gaussians."""
        return torch.ones(len(gaussians), dtype=torch.bool, device=gaussians.device)

    def _split(self, parents: Gaussians, generator: torch.Generator) -> Gaussians:
        each = parents.map(lambda tensor: tensor.repeat_interleave(2, dim=0))
        longest = each.scales.argmax(dim=-1, keepdim=True)
        is_longest = torch.zeros_like(each.scales, dtype=torch.bool).scatter(-1, longest, True)
        steps = torch.where(is_longest, RADIUS * self.offset * each.scales, 0.0)
        steps[::2] *= -1
        factors = torch.where(is_longest, 1 - self.offset, sqrt(1 - self.offset**2))
        return replace(
            each,
            means=each.means + (each.rotations @ steps[..., None])[..., 0],
            log_scales=each.log_scales + factors.log(),
            opacity_logits=(self.opacity * each.opacities).logit(),
        )


@dataclass(frozen=True, kw_only=True)
class LongAxis(Baseline):
    """Split Gaussians along their longest axis, drawn among those with a large absolute gradient.

    The candidates have a mean norm of absolute gradients of at least ``tau_pos``, as in AbsGS. At a
    refinement the number of Gaussians may grow to ``budget`` times the square root of the share of the
    densification that has passed, and as many candidates are drawn, without replacement and in proportion to
    their norms. The paper draws in proportion to the edges of photographs that a Gaussian covers (its
    edge-aware score), which do not exist here. Its pruning of Gaussians that recover slowly from a reset, and
    its late multi-step updates, are left out as well, so that arms differ in growth only.
    """

    budget: Count  # Gaussians after the last refinement, before pruning
    offset: Annotated[float, within(above=0, below=1)]  # of three standard deviations
    opacity: Annotated[float, within(above=0, below=1)]  # of each child; share of the parent's

    @property
    def needs_absgrad(self) -> bool:
        """Return True: absolute gradients are the evidence."""
        return True

    def plan(
        self,
        state: BaselineState,
        gaussians: Gaussians,
        step: int,
        refine: Refine,
        generator: torch.Generator,
    ) -> RefinePlan:
        """Draw candidates as the budget allows, and split them."""
        passed = (step - refine.start) / (min(refine.end, refine.steps) - refine.start)
        growing = max(int(self.budget * sqrt(passed)) - len(gaussians), 0)
        rows = self.select(state, step, generator).nonzero()[:, 0]
        # The largest of these keys are a weighted sample without replacement (Efraimidis and Spirakis 2006).
        draws = torch.rand(len(rows), generator=generator).to(rows.device)
        keys = draws.log() / self._mean_norms(state)[rows]
        drawn = rows[keys.topk(min(growing, len(rows))).indices]
        selected = torch.zeros_like(state.sightings, dtype=torch.bool).index_fill(0, drawn, True)
        changes = {"split_children": 2, "offset": self.offset, "opacity": self.opacity}
        how = LongAxisRefine(**vars(refine) | changes)
        return how.plan(gaussians, selected, step, generator, self.unwanted(state))

    def _pulls(self, signal: GradientSignal) -> Float[Tensor, "v n 2"]:
        assert signal.absgrad is not None, "needs_absgrad requests it"
        return signal.absgrad
