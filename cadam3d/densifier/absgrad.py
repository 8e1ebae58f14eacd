"""AbsGS: the baseline with absolute gradients, so that opposite pixels do not cancel (Ye et al. 2024)."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from cadam3d.densifier.base import GradientSignal
from cadam3d.densifier.baseline import Baseline


@dataclass(frozen=True, kw_only=True)
class AbsGrad(Baseline):
    """Select Gaussians whose mean norm of absolute gradients reaches a fixed threshold.

    The baseline takes the view-space gradient, a sum over pixels in which opposite directions cancel. This
    class takes the sums over pixels of the absolute values, along x and along y separately. A large Gaussian
    over fine detail, whose pixels disagree, then stands out. All else is as in the baseline. Absolute values
    are larger, and the gradients of noise do not cancel either, so the threshold must be higher.
    """

    @property
    def needs_absgrad(self) -> bool:
        """Return True: absolute gradients are the evidence."""
        return True

    def _pulls(self, signal: GradientSignal) -> Float[Tensor, "v n 2"]:
        assert signal.absgrad is not None, "needs_absgrad requests it"
        return signal.absgrad
