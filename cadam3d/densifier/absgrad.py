"""AbsGS: the baseline with absolute gradients, so that opposite pixels do not cancel (Ye et al. 2024)."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.checks import Positive
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.schedule import Schedule, as_schedule
from cadam3d.densifier.base import GradientSignal
from cadam3d.densifier.baseline import Baseline, BaselineState
from cadam3d.densifier.refine import Refine, RefinePlan


@dataclass
class AbsGradState(BaselineState):
    """The baseline's state, about absolute gradients, and the norms of the plain ones: 16 bytes."""

    plain_sum: Float[Tensor, "n"]  # of view-space gradients; loss per NDC unit; 0 without ``tau_clone``


@dataclass(frozen=True, kw_only=True)
class AbsGrad(Baseline):
    """Select Gaussians whose mean norm of absolute gradients reaches a fixed threshold.

    The baseline takes the view-space gradient, a sum over pixels in which opposite directions cancel. This
    class takes the sums over pixels of the absolute values, along x and along y separately. A large Gaussian
    over fine detail, whose pixels disagree, then stands out. All else is as in the baseline. Absolute values
    are larger, and the gradients of noise do not cancel either, so the threshold must be higher.

    With ``tau_clone``, absolute gradients decide about Gaussians that split, and the baseline's gradient
    about those that are cloned, as in the code of AbsGS. Without it they decide about both, as in gsplat.
    """

    tau_clone: Positive | Schedule | None  # loss per NDC unit

    @property
    def needs_absgrad(self) -> bool:
        """Return True: absolute gradients are the evidence."""
        return True

    def init_state(self, n: int, device: torch.device) -> AbsGradState:
        """Return sums and sizes of zero."""
        sums = super().init_state(n, device)
        return AbsGradState(**sums.to_dict(), plain_sum=torch.zeros_like(sums.norm_sum))

    def observe(self, state: AbsGradState, signal: GradientSignal) -> AbsGradState:
        """Return the sums after one more batch. A gradient that is not finite counts as not seen."""
        after = super().observe(state, signal)
        if self.tau_clone is None:
            return after
        norms, _ = self._norms(signal.means2d, signal)
        return replace(after, plain_sum=state.plain_sum + norms)

    def plan(
        self, state: AbsGradState, gaussians: Gaussians, step: int, refine: Refine, generator: torch.Generator
    ) -> RefinePlan:
        """Decide one refinement; with ``tau_clone``, a Gaussian's size decides which gradient counts."""
        selected = self.select(state, step, generator)
        if self.tau_clone is not None:
            is_cloned = self._clone_norms(state) >= as_schedule(self.tau_clone)(step)
            selected = torch.where(refine.splits(gaussians.detach()), selected, is_cloned)
        return refine.plan(gaussians, selected, step, generator, self.unwanted(state))

    def _pulls(self, signal: GradientSignal) -> Float[Tensor, "v n 2"]:
        assert signal.absgrad is not None, "needs_absgrad requests it"
        return signal.absgrad

    def _clone_norms(self, state: AbsGradState) -> Float[Tensor, "n"]:
        """Return what decides about Gaussians that are cloned: the baseline's mean gradient norm."""
        return state.plain_sum / state.sightings.clamp_min(1)
