"""CAdam, the paper's densifier: grow where the gradient drifts consistently (paper sec. 4.2 to 4.4).

The gradient of a Gaussian is a drift plus noise of mean zero (sec. 4.1). Its first moment m keeps the drift
while the noise cancels; its second moment v measures both. Both gates are independent of the scale of the
loss: one is a rank, the other a ratio. ``refine.py`` grows the chosen Gaussians, ``cadam_charts.py`` logs and
draws, and ``cadam_open.py`` has the choices that the paper leaves open.
"""

from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from cadam3d.core.checks import AtLeastZero, BelowOne, Positive, Whole, one_of, require_choice
from cadam3d.core.edit import RowState
from cadam3d.core.reductions import all_finite, quantile
from cadam3d.core.schedule import Schedule, as_schedule
from cadam3d.densifier.base import GradientSignal
from cadam3d.densifier.cadam_charts import CAdamCharts

RESET = ("all", "none", "unreliable")  # the last one needs an SNR to compare with


@dataclass
class CAdamState(RowState):
    """Running moments of the world-space gradient of each Gaussian, which are 0 at birth (sec. 4.2)."""

    m: Float[Tensor, "n 3"]  # first moment; loss per world unit
    v: Float[Tensor, "n 3"]  # second raw moment
    age: Int[Tensor, "n"]  # updates since birth; the step count of the bias correction

    def drift(self, beta1: float) -> Float[Tensor, "n"]:
        """Return ``||m_hat||_2`` (eq. 8). Each Gaussian's bias is corrected by its own age (sec. 4.2)."""
        return self.m.norm(dim=-1) / bias_correction(beta1, self.age)

    def noise(self, beta2: float) -> Float[Tensor, "n"]:
        """Return ``sqrt(||v_hat||_1)`` (eq. 10)."""
        return (self.v.sum(dim=-1) / bias_correction(beta2, self.age)).sqrt()


@dataclass(frozen=True, kw_only=True)
class CAdam(CAdamCharts[CAdamState]):
    """Select Gaussians whose drift is in the top quantile and large compared with its own noise."""

    tau_Q: BelowOne | Schedule | None  # eq. 9
    tau_SNR: AtLeastZero | None  # eq. 11 and 13
    beta1: BelowOne  # decay of m
    beta2: BelowOne  # decay of v
    eps: Positive  # loss per world unit
    min_age: Whole  # updates
    reset: Annotated[str, one_of(RESET)]
    reset_min_age: Whole  # updates

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.least_reliable is None:
            require_choice("densifier.reset", self.reset, RESET[:2])

    def init_state(self, n: int, device: torch.device) -> CAdamState:
        """Return zero moments and age 0."""
        zero = torch.zeros(n, 3, device=device)
        return CAdamState(m=zero, v=zero.clone(), age=torch.zeros(n, dtype=torch.int32, device=device))

    def observe(self, state: CAdamState, signal: GradientSignal) -> CAdamState:
        """Return the moments after one more step; of the evidence, CAdam reads the gradient of the means."""
        return self.update(state, signal.means)

    def update(self, state: CAdamState, gradients: Float[Tensor, "n 3"]) -> CAdamState:
        """Return the moments after one more gradient (eq. 8 and 10), without waiting for the device.

        Adam's operations in Adam's order give Adam's bits. A gradient that is not finite changes nothing.
        """
        is_finite = all_finite(gradients)
        gradients = torch.where(is_finite, gradients, 0.0)
        decayed = state.v * torch.where(is_finite, self.beta2, 1.0)
        return CAdamState(
            m=torch.lerp(state.m, gradients, is_finite * (1.0 - self.beta1)),
            v=decayed.addcmul_(gradients, gradients, value=1 - self.beta2),
            age=state.age + is_finite,
        )

    def strengths(self, state: CAdamState) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
        """Return drift and noise, in loss per world unit; their ratio is the intrinsic SNR (eq. 11)."""
        return state.drift(self.beta1), state.noise(self.beta2) + self.eps

    def thresholds(self, state: CAdamState, drift: Float[Tensor, "n"], step: int) -> tuple[Tensor, Tensor]:
        """Return the drift (right-hand side of eq. 9) and, per Gaussian, the SNR that candidates exceed."""
        least_drift = drift.new_tensor(-torch.inf)
        if self.tau_Q is not None:
            least_drift = quantile(drift, as_schedule(self.tau_Q)(step))
        return least_drift, torch.full_like(drift, self.tau_SNR or 0.0)

    def select(self, state: CAdamState, step: int, generator: torch.Generator) -> Bool[Tensor, "n"]:
        """Return the mask of Gaussians to grow, by their drift (eq. 9) and their SNR (eq. 11)."""
        drift, noise = self.strengths(state)
        least_drift, least_snr = self.thresholds(state, drift, step)
        # Compare with a product, because a quotient would divide by a noise close to zero.
        return (drift > least_drift) & (drift > least_snr * noise) & (state.age >= self.min_age)

    def unreliable(self, state: CAdamState) -> Bool[Tensor, "n"]:
        """Return the mask of Gaussians whose opacity a reset lowers: those dominated by noise (eq. 13)."""
        if self.reset != "unreliable" or self.least_reliable is None:
            return torch.full_like(state.age, self.reset == "all", dtype=torch.bool)
        drift, noise = self.strengths(state)
        return (drift < self.least_reliable * noise) & (state.age >= self.reset_min_age)


def bias_correction(beta: float, age: Int[Tensor, "n"]) -> Float[Tensor, "n"]:
    """Return ``1 - beta**age``, in double precision because ``beta2`` is close to 1; age 0 counts as 1."""
    return (1 - beta ** age.clamp_min(1).double()).float()
