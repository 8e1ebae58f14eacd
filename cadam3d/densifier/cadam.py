"""CAdam: grow where the gradient drifts, not where it shakes (paper sec. 4.2-4.4)."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from cadam3d.core.checks import require_choice, require_range, require_whole
from cadam3d.core.edit import RowEdit, RowState
from cadam3d.densifier.base import Densifier, GradientSignal

INVISIBLE = ("zero", "skip")
QUANTILE_OVER = ("all", "mature", "seen")
GRAD_NORM = ("none", "per_step_rms")
NONFINITE = ("skip_step", "skip_row")
CHILD_STATE = ("zero", "inherit")
PARENT_STATE = ("keep", "reset")


@dataclass
class CAdamState(RowState):
    """Running moments of the world-space gradient of each Gaussian: 28 bytes each.

    By the rule of :class:`RowState`, survivors keep their history through an edit and newborns start at zero
    with age 0 (paper sec. 4.2); see :meth:`CAdam.carry` for the other readings.
    """

    m: Float[Tensor, "n 3"]  # first moment; loss per world unit
    v: Float[Tensor, "n 3"]  # second raw moment
    age: Int[Tensor, "n"]  # updates since birth; drives the bias correction


@dataclass(frozen=True, kw_only=True)
class CAdam(Densifier[CAdamState]):
    """Select the top quantile of drift, if it stands above its own noise.

    Both tests are free of the loss scale. Where the paper leaves a choice open, a key names it.
    """

    tau_Q: float  # in [0, 1): quantile of the drift that a candidate must exceed (paper eq. 9)
    tau_SNR: float  # >= 0: candidates exceed it, the unreliable fall below it (paper eq. 11); 0 = no gate
    beta1: float  # decay of m
    beta2: float  # decay of v
    eps: float  # added to the noise strength; keeps a never-touched Gaussian at SNR 0
    invisible: str  # a Gaussian that no view sees: "zero" gradient, or "skip" its update (and its ageing)
    min_age: int  # updates before a Gaussian may be a candidate: at age 1 the SNR is 1 whatever the gradient
    quantile_over: str  # population of the quantile: "all", "mature" (age >= min_age) or "seen" (v > 0)
    reset_min_age: int  # updates before a Gaussian may be called unreliable
    grad_norm: str  # "none", or "per_step_rms": divide each step's gradients by their population RMS
    nonfinite: str  # a gradient with NaN or infinity: "skip_step" for all, or "skip_row" for its Gaussian
    child_state: str  # newborns: "zero" moments and age, or "inherit" both from the parent
    parent_state: str  # a cloned parent: "keep" its moments and age, or "reset" them to zero

    def __post_init__(self) -> None:
        require_range("densifier.tau_Q", self.tau_Q, low=0, below=1, example=0.9)
        require_range("densifier.tau_SNR", self.tau_SNR, low=0, example=0.1)
        require_range("densifier.beta1", self.beta1, low=0, below=1, example=0.9)
        require_range("densifier.beta2", self.beta2, low=0, below=1, example=0.999)
        require_range("densifier.eps", self.eps, above=0, example=1e-15)
        require_choice("densifier.invisible", self.invisible, INVISIBLE)
        require_whole("densifier.min_age", self.min_age, low=0, example=20)
        require_choice("densifier.quantile_over", self.quantile_over, QUANTILE_OVER)
        require_whole("densifier.reset_min_age", self.reset_min_age, low=0, example=50)
        require_choice("densifier.grad_norm", self.grad_norm, GRAD_NORM)
        require_choice("densifier.nonfinite", self.nonfinite, NONFINITE)
        require_choice("densifier.child_state", self.child_state, CHILD_STATE)
        require_choice("densifier.parent_state", self.parent_state, PARENT_STATE)

    def init_state(self, n: int, device: torch.device) -> CAdamState:
        """Zero moments, age 0."""
        return CAdamState(
            m=torch.zeros(n, 3, device=device),
            v=torch.zeros(n, 3, device=device),
            age=torch.zeros(n, dtype=torch.int32, device=device),
        )

    def observe(self, state: CAdamState, signal: GradientSignal) -> CAdamState:
        """Return the moments after one more step (paper eq. 8 and 10); never waits for the device."""
        is_finite = signal.means.isfinite().all(dim=-1)
        is_updated = is_finite if self.nonfinite == "skip_row" else is_finite.all().expand_as(is_finite)
        if self.invisible == "skip":
            is_updated = is_updated & signal.visible.any(dim=0)
        gradients = signal.means.masked_fill(~is_finite[:, None], 0.0)
        if self.grad_norm == "per_step_rms":
            gradients = _over_population_rms(gradients)
        rows = is_updated[:, None]
        return CAdamState(
            m=torch.where(rows, torch.lerp(state.m, gradients, 1 - self.beta1), state.m),
            v=torch.where(rows, torch.lerp(state.v, gradients.square(), 1 - self.beta2), state.v),
            age=state.age + is_updated,
        )

    def select(self, state: CAdamState) -> Bool[Tensor, "n"]:
        """Mark the Gaussians to grow: drift above its quantile, and above its noise (paper eq. 9 and 11)."""
        drift, noise = self.strengths(state)
        is_strong = drift > quantile(drift[self._population(state)], self.tau_Q)
        is_reliable = drift > self.tau_SNR * (noise + self.eps)  # compare; never divide by ~0
        return is_strong & is_reliable & (state.age >= self.min_age)

    def unreliable(self, state: CAdamState) -> Bool[Tensor, "n"]:
        """Mark the Gaussians dominated by noise, for the selective opacity reset (paper eq. 13)."""
        drift, noise = self.strengths(state)
        return (drift < self.tau_SNR * (noise + self.eps)) & (state.age >= self.reset_min_age)

    def carry(self, state: CAdamState, edit: RowEdit) -> CAdamState:
        """The state after a refinement, under the chosen reading of who keeps a history."""
        carried = state.carry(edit)
        kept = edit.keep.shape[0]
        if self.child_state == "inherit":
            for name, rows in carried.to_dict().items():
                rows[kept:] = getattr(state, name)[edit.parents]
        if self.parent_state == "reset":
            is_parent = torch.isin(edit.keep, edit.parents)
            for rows in carried.to_dict().values():
                rows[:kept][is_parent] = 0
        return carried

    def strengths(self, state: CAdamState) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
        """Drift ``||m_hat||_2`` and noise ``sqrt(||v_hat||_1)``, their ratio the SNR (eq. 11); 0 at age 0."""
        drift = state.m.norm(dim=-1) / _bias_correction(self.beta1, state.age)
        noise = (state.v.sum(dim=-1) / _bias_correction(self.beta2, state.age)).sqrt()
        return drift, noise

    def statistics(self, state: CAdamState) -> dict[str, float]:
        """The quantile threshold, the spread of the SNR, and how many stand above ``tau_SNR``."""
        if len(state.age) == 0:
            return {}
        drift, noise = self.strengths(state)
        snr = drift / (noise + self.eps)
        population = drift[self._population(state)]
        numbers = {f"snr_p{p}": quantile(snr, p / 100) for p in (10, 50, 90)}
        numbers |= {
            "tau_SNR": self.tau_SNR,
            "share_above_tau_SNR": (snr > self.tau_SNR).float().mean(),
            "age_median": quantile(state.age.float(), 0.5),
            "drift_median": quantile(drift, 0.5),
        }
        if len(population):  # an empty one has no quantile, and JSON no infinity
            numbers["drift_threshold"] = quantile(population, self.tau_Q)
        return {name: float(number) for name, number in numbers.items()}

    def _population(self, state: CAdamState) -> Bool[Tensor, "n"]:
        if self.quantile_over == "mature":
            return state.age >= self.min_age
        if self.quantile_over == "seen":
            return (state.v > 0).any(dim=-1)
        return torch.ones_like(state.age, dtype=torch.bool)


def quantile(values: Float[Tensor, "n"], share: float) -> Float[Tensor, ""]:
    """``torch.quantile`` (linear interpolation) for any ``n``: that one refuses more than 2^24 values.

    Infinity if there are none: nothing exceeds it.
    """
    if len(values) == 0:
        return values.new_tensor(math.inf)
    rank = share * (len(values) - 1)
    below = math.floor(rank)
    ordered = values.sort().values
    return torch.lerp(ordered[below], ordered[min(below + 1, len(values) - 1)], rank - below)


def _bias_correction(beta: float, age: Int[Tensor, "n"]) -> Float[Tensor, "n"]:
    """``1 - beta**age``, in double precision, for ``beta2`` is close to 1; age 0 counts as 1, never 0 / 0."""
    return (1 - beta ** age.clamp_min(1).double()).float()


def _over_population_rms(gradients: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Gradients over the root mean square of their norms: free of the scale that all share, such as w(t)."""
    rms = gradients.square().sum(dim=-1).mean().sqrt()
    return gradients / torch.where(rms > 0, rms, 1.0)
