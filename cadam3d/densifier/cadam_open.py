"""CAdam with every choice that the paper leaves open as a setting, and with gates of our own.

With the values of ``configs/densifier/cadam_open.yaml`` this is exactly ``cadam.py``. ``docs/method.md``
gives the reason for each value.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from cadam3d.core.checks import require, require_choice, require_range, unless_none
from cadam3d.core.edit import RowEdit
from cadam3d.core.reductions import all_finite, quantile
from cadam3d.densifier.base import GradientSignal
from cadam3d.densifier.cadam import CAdam, CAdamState
from cadam3d.densifier.noise_floor import snr_threshold

CHOICES = {
    "grad_source": ("total", "guidance"),
    "grad_norm": ("none", "per_step_rms"),
    "invisible": ("zero", "skip"),
    "nonfinite": ("skip_step", "skip_row"),
    "quantile_over": ("all", "mature", "seen"),
    "eps_mode": ("abs", "rel_median"),
    "child_state": ("zero", "inherit", "inherit_half"),
    "parent_state": ("keep", "reset"),
    "reset_moments": (False, True),
}


@dataclass(frozen=True, kw_only=True)
class CAdamOpen(CAdam):
    """CAdam with other evidence, other gates, another inheritance or another reset."""

    # The values of each text are in CHOICES. Evidence: which gradients the moments average.
    grad_source: str
    grad_norm: str
    invisible: str
    nonfinite: str
    # Gates: which Gaussians are candidates.
    quantile_over: str
    tau_m: float | None  # >= 0, loss per world unit
    alpha: float | None  # in (0, 1), replaces tau_SNR
    eps_mode: str
    # Histories: moments and ages after a refinement.
    child_state: str
    parent_state: str
    # Resets.
    tau_reset: float | None  # >= 0, null = tau_SNR
    reset_moments: bool

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, choices in CHOICES.items():
            require_choice(f"densifier.{name}", getattr(self, name), choices)
        unless_none(require_range, "densifier.tau_m", self.tau_m, low=0)
        require(
            any(gate is not None for gate in (self.tau_Q, self.tau_SNR, self.tau_m, self.alpha)),
            "densifier.tau_m",
            expected="a number, because no other gate limits growth",
            got=self.tau_m,
            example="densifier.tau_m=0.001",
        )
        unless_none(require_range, "densifier.tau_reset", self.tau_reset, low=0)
        require(
            self.tau_reset is None or self.reset == "unreliable",
            "densifier.tau_reset",
            expected=f"null, because it has no effect with densifier.reset={self.reset}",
            got=self.tau_reset,
            example="densifier.tau_reset=null",
        )
        if self.alpha is not None:
            self._check_alpha(self.alpha)

    def _check_alpha(self, alpha: float) -> None:
        require_range("densifier.alpha", alpha, above=0, below=1)
        require(
            self.tau_SNR is None,
            "densifier.tau_SNR",
            expected=f"null, because densifier.alpha={alpha:g} sets the SNR that candidates exceed",
            got=self.tau_SNR,
            example="densifier.tau_SNR=null densifier.tau_reset=0.1",
        )
        # A small tolerance, so that 0.81 may be written for 0.9**2.
        require(
            self.beta2 >= self.beta1**2 - 1e-6,
            "densifier.beta2",
            expected=f"at least beta1^2 = {self.beta1**2:g}, because densifier.alpha is not calibrated below",
            got=self.beta2,
            example=f"densifier.beta2={max(self.beta1**2, 0.99):g}",
        )

    @property
    def guidance_only(self) -> bool:
        """Return whether ``grad_source`` is ``guidance``."""
        return self.grad_source == "guidance"

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
        gradients, is_updated = signal.means, self._updated_rows(signal)
        if is_updated is not None:
            gradients = torch.where(is_updated[:, None], gradients, 0.0)
        if self.grad_norm == "per_step_rms":
            gradients = _over_population_rms(gradients)
        after = self.update(state, gradients)
        if is_updated is None:
            return after
        return CAdamState(
            m=torch.where(is_updated[:, None], after.m, state.m),
            v=torch.where(is_updated[:, None], after.v, state.v),
            age=torch.where(is_updated, after.age, state.age),
        )

    def _updated_rows(self, signal: GradientSignal) -> Bool[Tensor, "n"] | None:
        """Return the mask of Gaussians that this step updates; ``None`` if it updates all or none."""
        skips_rows, skips_invisible = self.nonfinite == "skip_row", self.invisible == "skip"
        if not (skips_rows or skips_invisible):
            return None
        is_finite = _finite_rows(signal.means) if skips_rows else all_finite(signal.means)
        return is_finite & signal.visible.any(dim=0) if skips_invisible else is_finite

    def strengths(self, state: CAdamState) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
        """Return drift and noise, to which ``eps`` is added in the unit that ``eps_mode`` chooses.

        The median is over the Gaussians that ever had a gradient.
        """
        if self.eps_mode == "abs":
            return super().strengths(state)
        noise = state.noise(self.beta2)
        touched = noise[noise > 0]
        unit = quantile(touched, 0.5) if len(touched) else 1.0
        return state.drift(self.beta1), noise + self.eps * unit

    def thresholds(
        self, state: CAdamState, drift: Float[Tensor, "n"], step: int
    ) -> tuple[Float[Tensor, ""], Float[Tensor, "n"]]:
        """Return the larger of ``tau_m`` and the quantile over the chosen population, and the SNR.

        Under ``alpha`` the SNR depends on the age.
        """
        ranked = drift if self.quantile_over == "all" else drift[self._population(state)]
        least_drift, _ = super().thresholds(state, ranked, step)
        least_snr = torch.full_like(drift, self.tau_SNR or 0.0)
        if self.tau_m is not None:
            least_drift = least_drift.clamp_min(self.tau_m)
        if self.alpha is not None:
            least_snr = snr_threshold(self.alpha, float(self.beta1), float(self.beta2), state.age)
        return least_drift, least_snr

    def _population(self, state: CAdamState) -> Bool[Tensor, "n"]:
        """Return the mask of Gaussians that the quantile ranks, unless it ranks all."""
        return state.age >= self.min_age if self.quantile_over == "mature" else (state.v > 0).any(dim=-1)

    def after_reset(self, state: CAdamState, rows: Bool[Tensor, "n"]) -> CAdamState:
        """Return the state after an opacity reset of ``rows``; ``reset_moments`` makes these rows newborn."""
        if not self.reset_moments:
            return state
        return CAdamState(
            m=state.m.masked_fill(rows[:, None], 0.0),
            v=state.v.masked_fill(rows[:, None], 0.0),
            age=state.age.masked_fill(rows, 0),
        )

    def carry(self, state: CAdamState, edit: RowEdit) -> CAdamState:
        """Return the state after a refinement, as ``child_state`` and ``parent_state`` choose.

        ``inherit_half`` gives newborns the moments that their parents would have if every gradient had been
        half as large, because a clone takes over half of the work: m / 2 and v / 4, so half the drift at the
        same SNR.
        """
        carried = state.carry(edit)
        kept = edit.keep.shape[0]
        if self.child_state != "zero":
            share = 0.5 if self.child_state == "inherit_half" else 1.0
            carried.m[kept:] = state.m[edit.parents] * share
            carried.v[kept:] = state.v[edit.parents] * share**2
            carried.age[kept:] = state.age[edit.parents]
        if self.parent_state == "reset":
            is_parent = torch.isin(edit.keep, edit.parents)
            for rows in carried.to_dict().values():
                rows[:kept][is_parent] = 0
        return carried


def _finite_rows(values: Float[Tensor, "n 3"]) -> Bool[Tensor, "n"]:
    """Return the mask of rows without NaN or infinity, which become NaN when they are multiplied by 0."""
    x, y, z = (values * 0).unbind(dim=-1)
    return (x + y + z) == 0


def _over_population_rms(gradients: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Return gradients over the root mean square of their norms, which removes a shared scale."""
    rms = gradients.square().sum(dim=-1).mean().sqrt()
    return gradients / torch.where(rms > 0, rms, 1.0)
