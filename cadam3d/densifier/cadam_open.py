"""CAdam with choices that the paper leaves open as settings, and with gates of our own.

With the values of ``configs/densifier/cadam_open.yaml`` this is exactly ``cadam.py``. ``docs/method.md``
gives the reason for each value.
"""

from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.checks import AtLeastZero, one_of, within
from cadam3d.densifier.base import GradientSignal
from cadam3d.densifier.cadam import CAdam, CAdamState
from cadam3d.densifier.noise_floor import snr_threshold

GRAD_NORM = ("none", "per_step_rms")
INVISIBLE = ("zero", "skip")


@dataclass(frozen=True, kw_only=True)
class CAdamOpen(CAdam):
    """CAdam with other evidence, other gates or another reset."""

    # Evidence: which gradients the moments average.
    grad_norm: Annotated[str, one_of(GRAD_NORM)]
    invisible: Annotated[str, one_of(INVISIBLE)]
    # Gates: which Gaussians are candidates.
    tau_m: AtLeastZero | None  # loss per world unit
    alpha: Annotated[float, within(above=0, below=1)] | None  # replaces tau_SNR
    # Resets.
    tau_reset: AtLeastZero | None  # null = tau_SNR

    def __post_init__(self) -> None:
        super().__post_init__()
        gates = (self.tau_Q, self.tau_SNR, self.tau_m, self.alpha)
        has_gate = any(gate is not None for gate in gates)
        self.expect(has_gate, "tau_m", "a number, because no other gate limits growth", 0.001)
        is_used = self.tau_reset is None or self.reset == "unreliable"
        self.expect(is_used, "tau_reset", f"null, because it has no effect with reset={self.reset}")
        if self.alpha is None:
            return
        expected = f"null, because alpha={self.alpha:g} sets the SNR that candidates exceed"
        self.expect(self.tau_SNR is None, "tau_SNR", expected, "null")
        # A small tolerance, so that 0.81 may be written for 0.9**2.
        least = self.beta1**2
        expected = f"at least beta1^2 = {least:g}, because alpha is not calibrated below"
        self.expect(self.beta2 >= least - 1e-6, "beta2", expected)

    @property
    def limits_drift(self) -> bool:
        """Return whether ``tau_Q`` or ``tau_m`` is set."""
        return self.tau_m is not None or super().limits_drift

    @property
    def least_reliable(self) -> float | None:
        """Return ``tau_reset``, or else ``tau_SNR``."""
        return super().least_reliable if self.tau_reset is None else self.tau_reset

    def observe(self, state: CAdamState, signal: GradientSignal) -> CAdamState:
        """Return the moments after one more step of the chosen evidence, without waiting for the device."""
        gradients = signal.means
        if self.grad_norm == "per_step_rms":
            # The root mean square of the norms over the population is a scale that all gradients share.
            rms = gradients.square().sum(dim=-1).mean().sqrt()
            gradients = gradients / torch.where(rms > 0, rms, 1.0)
        after = self.update(state, gradients)
        if self.invisible == "zero":
            return after
        is_seen = signal.visible.any(dim=0)
        return CAdamState(
            m=torch.where(is_seen[:, None], after.m, state.m),
            v=torch.where(is_seen[:, None], after.v, state.v),
            age=torch.where(is_seen, after.age, state.age),
        )

    def thresholds(
        self, state: CAdamState, drift: Float[Tensor, "n"], step: int
    ) -> tuple[Float[Tensor, ""], Float[Tensor, "n"]]:
        """Return the larger of ``tau_m`` and the quantile, and the SNR, by ``alpha`` for each age."""
        least_drift, least_snr = super().thresholds(state, drift, step)
        if self.tau_m is not None:
            least_drift = least_drift.clamp_min(self.tau_m)
        if self.alpha is not None:
            least_snr = snr_threshold(self.alpha, float(self.beta1), float(self.beta2), state.age)
        return least_drift, least_snr
