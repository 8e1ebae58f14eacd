"""CAdam with every choice that the paper leaves open as a setting, and with gates of our own.

With the values of ``configs/densifier/cadam_open.yaml`` this is exactly ``cadam.py``. ``docs/method.md``
gives the reason for each value.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from cadam3d.core.checks import require, require_choice, require_range
from cadam3d.core.edit import RowEdit
from cadam3d.densifier.base import GradientSignal
from cadam3d.densifier.cadam import CAdam, CAdamState, all_finite, quantile
from cadam3d.densifier.noise_floor import snr_threshold

EPS_MODE = ("abs", "rel_median")
GRAD_SOURCE = ("total", "guidance")
INVISIBLE = ("zero", "skip")
QUANTILE_OVER = ("all", "mature", "seen")
GRAD_NORM = ("none", "per_step_rms")
NONFINITE = ("skip_step", "skip_row")
CHILD_STATE = ("zero", "inherit", "inherit_half")
PARENT_STATE = ("keep", "reset")


@dataclass(frozen=True, kw_only=True)
class CAdamOpen(CAdam):
    """CAdam with other evidence, other gates, another inheritance or another reset."""

    # Evidence: which gradients the moments average.
    grad_source: str  # one of GRAD_SOURCE
    grad_norm: str  # one of GRAD_NORM
    invisible: str  # one of INVISIBLE
    nonfinite: str  # one of NONFINITE
    # Gates: which Gaussians are candidates.
    quantile_over: str  # one of QUANTILE_OVER
    tau_m: float | None  # >= 0, loss per world unit
    alpha: float | None  # in (0, 1), replaces tau_SNR
    eps_mode: str  # one of EPS_MODE
    # Histories: moments and ages after a refinement.
    child_state: str  # one of CHILD_STATE
    parent_state: str  # one of PARENT_STATE
    # Resets.
    tau_reset: float | None  # >= 0, null = tau_SNR
    reset_moments: bool

    def __post_init__(self) -> None:
        super().__post_init__()
        require_choice("densifier.grad_source", self.grad_source, GRAD_SOURCE)
        require_choice("densifier.grad_norm", self.grad_norm, GRAD_NORM)
        require_choice("densifier.invisible", self.invisible, INVISIBLE)
        require_choice("densifier.nonfinite", self.nonfinite, NONFINITE)
        require_choice("densifier.quantile_over", self.quantile_over, QUANTILE_OVER)
        if self.tau_m is not None:
            require_range("densifier.tau_m", self.tau_m, low=0, example=1e-4)
        self._check_alpha()
        require_choice("densifier.eps_mode", self.eps_mode, EPS_MODE)
        require_choice("densifier.child_state", self.child_state, CHILD_STATE)
        require_choice("densifier.parent_state", self.parent_state, PARENT_STATE)
        require_choice("densifier.reset_moments", self.reset_moments, (False, True))

    @property
    def guidance_only(self) -> bool:
        """Return whether ``grad_source`` is ``guidance``."""
        return self.grad_source == "guidance"

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

    def _updated_rows(self, signal: GradientSignal) -> Bool[Tensor, "n"] | None:
        """Return the mask of Gaussians that this step updates; ``None`` if it updates all or none."""
        skips_rows, skips_invisible = self.nonfinite == "skip_row", self.invisible == "skip"
        if not (skips_rows or skips_invisible):
            return None
        is_finite = _finite_rows(signal.means) if skips_rows else all_finite(signal.means)
        return is_finite & signal.visible.any(dim=0) if skips_invisible else is_finite

    def _drift_threshold(self, state: CAdamState, drift: Float[Tensor, "n"], step: int) -> Float[Tensor, ""]:
        """Return the larger of ``tau_m`` and the quantile over the chosen population."""
        population = drift if self.quantile_over == "all" else drift[self._population(state)]
        threshold = super()._drift_threshold(state, population, step)
        return threshold if self.tau_m is None else threshold.clamp_min(self.tau_m)

    def _limits_drift(self) -> bool:
        return self.tau_m is not None or super()._limits_drift()

    def _snr_threshold(self, state: CAdamState) -> Float[Tensor, "n"]:
        """Return the SNR that each candidate exceeds; under ``alpha`` it depends on the age."""
        if self.alpha is None:
            return super()._snr_threshold(state)
        return snr_threshold(self.alpha, float(self.beta1), float(self.beta2), state.age)

    def _reset_threshold(self) -> float:
        return super()._reset_threshold() if self.tau_reset is None else self.tau_reset

    def _eps(self, noise: Float[Tensor, "n"]) -> Float[Tensor, ""]:
        """Return ``eps`` in loss per world unit; the median is of the Gaussians that ever had a gradient."""
        if self.eps_mode == "abs":
            return super()._eps(noise)
        touched = noise[noise > 0]
        return self.eps * (quantile(touched, 0.5) if len(touched) else noise.new_tensor(1.0))

    def _population(self, state: CAdamState) -> Bool[Tensor, "n"]:
        """Return the mask of Gaussians that the quantile ranks, unless it ranks all."""
        return state.age >= self.min_age if self.quantile_over == "mature" else (state.v > 0).any(dim=-1)

    def _check_reset_threshold(self) -> None:
        if self.tau_reset is not None:
            require_range("densifier.tau_reset", self.tau_reset, low=0, example=0.1)
        require(
            self.tau_reset is None or self.reset == "unreliable",
            "densifier.tau_reset",
            expected=f"null, because it has no effect with densifier.reset={self.reset}",
            got=self.tau_reset,
            example="densifier.tau_reset=null",
        )
        require(
            self.reset != "unreliable" or self.tau_reset is not None or self.tau_SNR is not None,
            "densifier.tau_reset",
            expected="a number, because densifier.reset=unreliable needs one and densifier.tau_SNR is null",
            got=self.tau_reset,
            example="densifier.tau_reset=0.1",
        )

    def _check_alpha(self) -> None:
        if self.alpha is None:
            return
        require_range("densifier.alpha", self.alpha, above=0, below=1, example=0.05)
        require(
            self.tau_SNR is None,
            "densifier.tau_SNR",
            expected=f"null, because densifier.alpha={self.alpha:g} sets the SNR that candidates exceed",
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


def _finite_rows(values: Float[Tensor, "n 3"]) -> Bool[Tensor, "n"]:
    """Return the mask of rows without NaN or infinity, which become NaN when they are multiplied by 0."""
    x, y, z = (values * 0).unbind(dim=-1)
    return (x + y + z) == 0


def _over_population_rms(gradients: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Return gradients over the root mean square of their norms, which removes a shared scale."""
    rms = gradients.square().sum(dim=-1).mean().sqrt()
    return gradients / torch.where(rms > 0, rms, 1.0)
