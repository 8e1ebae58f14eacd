"""CAdam: grow where the gradient drifts, not where it shakes (paper sec. 4.2-4.4)."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from cadam3d.core.checks import require, require_choice, require_range, require_whole
from cadam3d.core.edit import RowEdit, RowState
from cadam3d.core.schedule import Schedule, as_schedule, require_scheduled
from cadam3d.densifier.base import Densifier, GradientSignal
from cadam3d.densifier.noise_floor import snr_threshold

EPS_MODE = ("abs", "rel_median")
GRAD_SOURCE = ("total", "guidance")
INVISIBLE = ("zero", "skip")
QUANTILE_OVER = ("all", "mature", "seen")
GRAD_NORM = ("none", "per_step_rms")
NONFINITE = ("skip_step", "skip_row")
CHILD_STATE = ("zero", "inherit", "inherit_half")
PARENT_STATE = ("keep", "reset")
RESET = ("unreliable", "everybody", "nobody")


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

    Both tests are free of the loss scale. Where the paper leaves a choice open, a key names it; the ablations
    and variants in ``configs/densifier/cadam_*.yaml`` are settings of this class.
    """

    tau_Q: (
        float | Schedule | None
    )  # in [0, 1): quantile of drift that candidates exceed (eq. 9); null = no gate
    tau_m: float | None  # absolute drift that candidates exceed, loss per world unit; null = no gate (paper)
    tau_SNR: float | None  # SNR that candidates exceed (paper eq. 11); null, like 0, = no gate
    alpha: float | None  # in (0, 1): how often pure noise may pass, instead of tau_SNR; null = tau_SNR
    beta1: float  # decay of m
    beta2: float  # decay of v
    eps: float  # added to the noise strength; keeps a never-touched Gaussian at SNR 0
    eps_mode: str  # eps is in loss per world unit: "abs", or a share of the median noise: "rel_median"
    grad_source: str  # "total" gradient of the loss, or "guidance" without the regularizers
    grad_norm: str  # "none", or "per_step_rms": divide each step's gradients by their population RMS
    invisible: str  # a Gaussian that no view sees: "zero" gradient, or "skip" its update (and its ageing)
    nonfinite: str  # a gradient with NaN or infinity: "skip_step" for all, or "skip_row" for its Gaussian
    min_age: int  # updates before a Gaussian may be a candidate: at age 1 the SNR is 1 whatever the gradient
    quantile_over: str  # population of tau_Q: "all", "mature" (age >= min_age) or "seen" (v > 0)
    child_state: str  # newborns: "zero" moments and age, or those of the parent: "inherit", "inherit_half"
    parent_state: str  # a cloned parent: "keep" its moments and age, or "reset" them to zero
    reset: str  # whose opacity a reset lowers: the "unreliable" (paper eq. 13), "everybody" or "nobody"
    tau_reset: float | None  # the unreliable have a smaller SNR; null = tau_SNR
    reset_min_age: int  # updates before a Gaussian may be called unreliable
    reset_moments: bool  # whether an opacity reset makes its Gaussians newborn: zero moments and age

    def __post_init__(self) -> None:
        self._check_gates()
        require_range("densifier.beta1", self.beta1, low=0, below=1, example=0.9)
        require_range("densifier.beta2", self.beta2, low=0, below=1, example=0.999)
        require_range("densifier.eps", self.eps, above=0, example=1e-15)
        require_choice("densifier.eps_mode", self.eps_mode, EPS_MODE)
        require_choice("densifier.grad_source", self.grad_source, GRAD_SOURCE)
        require_choice("densifier.grad_norm", self.grad_norm, GRAD_NORM)
        require_choice("densifier.invisible", self.invisible, INVISIBLE)
        require_choice("densifier.nonfinite", self.nonfinite, NONFINITE)
        require_whole("densifier.min_age", self.min_age, low=0, example=20)
        require_choice("densifier.quantile_over", self.quantile_over, QUANTILE_OVER)
        require_choice("densifier.child_state", self.child_state, CHILD_STATE)
        require_choice("densifier.parent_state", self.parent_state, PARENT_STATE)
        self._check_reset()
        self._check_calibration()

    def _check_gates(self) -> None:
        if self.tau_Q is not None:
            require_scheduled("densifier.tau_Q", self.tau_Q, low=0, below=1, example=0.9)
        if self.tau_m is not None:
            require_range("densifier.tau_m", self.tau_m, low=0, example=1e-4)
        if self.tau_SNR is not None:
            require_range("densifier.tau_SNR", self.tau_SNR, low=0, example=0.1)

    def _check_reset(self) -> None:
        require_choice("densifier.reset", self.reset, RESET)
        require_whole("densifier.reset_min_age", self.reset_min_age, low=0, example=50)
        require_choice("densifier.reset_moments", self.reset_moments, (False, True))
        if self.tau_reset is not None:
            require_range("densifier.tau_reset", self.tau_reset, low=0, example=0.1)
        require(
            self.tau_reset is None or self.reset == "unreliable",
            "densifier.tau_reset",
            expected=f"null, for densifier.reset={self.reset} asks nobody's SNR",
            got=self.tau_reset,
            example="densifier.tau_reset=null",
        )
        require(
            self.reset != "unreliable" or self.tau_reset is not None or self.tau_SNR is not None,
            "densifier.tau_reset",
            expected="a number, for densifier.tau_SNR is null: whose opacity would a reset lower?",
            got=self.tau_reset,
            example="densifier.tau_reset=0.1",
        )

    def _check_calibration(self) -> None:
        if self.alpha is None:
            return
        require_range("densifier.alpha", self.alpha, above=0, below=1, example=0.05)
        require(
            self.tau_SNR is None,
            "densifier.tau_SNR",
            expected=f"null, for densifier.alpha={self.alpha:g} sets the SNR that candidates exceed",
            got=self.tau_SNR,
            example="densifier.tau_SNR=null densifier.tau_reset=0.1",
        )
        require(
            self.beta2 >= self.beta1**2 - 1e-6,  # so that 0.81 may be written for 0.9**2
            "densifier.beta2",
            expected=f"at least beta1^2 = {self.beta1**2:g}, up to which densifier.alpha is calibrated",
            got=self.beta2,
            example=f"densifier.beta2={max(self.beta1**2, 0.99):g}",
        )

    @property
    def guidance_only(self) -> bool:
        """As ``grad_source`` says."""
        return self.grad_source == "guidance"

    def init_state(self, n: int, device: torch.device) -> CAdamState:
        """Zero moments, age 0."""
        return CAdamState(
            m=torch.zeros(n, 3, device=device),
            v=torch.zeros(n, 3, device=device),
            age=torch.zeros(n, dtype=torch.int32, device=device),
        )

    def observe(self, state: CAdamState, signal: GradientSignal) -> CAdamState:
        """Return the moments after one more step (paper eq. 8 and 10); never waits for the device.

        Operation by operation what Adam does, so that with its betas the moments equal Adam's to the bit.
        """
        is_updated = self._updated(signal)
        rows = is_updated if is_updated.ndim == 0 else is_updated[:, None].expand(-1, 3).contiguous()
        gradients = torch.where(rows, signal.means, 0.0)  # contiguous: a row of three broadcasts slowly
        if self.grad_norm == "per_step_rms":
            gradients = _over_population_rms(gradients)
        gain1, gain2 = 1 - float(self.beta1), 1 - float(self.beta2)
        decayed = state.v * torch.where(rows, float(self.beta2), 1.0)
        return CAdamState(
            m=torch.lerp(state.m, gradients, rows * gain1),
            v=decayed.addcmul_(gradients, gradients, value=gain2),
            age=state.age + is_updated,
        )

    def select(self, state: CAdamState, step: int, generator: torch.Generator) -> Bool[Tensor, "n"]:
        """Mark the Gaussians to grow: drift above its quantile, and above its noise (paper eq. 9 and 11)."""
        drift, noise = self.strengths(state)
        selected = drift > self._gate(state) * (noise + self._eps(noise))  # compare; never divide by ~0
        if self.tau_Q is not None:
            selected &= drift > quantile(drift[self._population(state)], as_schedule(self.tau_Q)(step))
        if self.tau_m is not None:
            selected &= drift > self.tau_m
        return selected & (state.age >= self.min_age)

    def unreliable(self, state: CAdamState) -> Bool[Tensor, "n"]:
        """Mark the Gaussians dominated by noise, for the selective opacity reset (paper eq. 13)."""
        if self.reset != "unreliable":
            return torch.full_like(state.age, self.reset == "everybody", dtype=torch.bool)
        tau_reset = self.tau_SNR if self.tau_reset is None else self.tau_reset
        assert tau_reset is not None, "_check_reset"
        drift, noise = self.strengths(state)
        return (drift < tau_reset * (noise + self._eps(noise))) & (state.age >= self.reset_min_age)

    def after_reset(self, state: CAdamState, rows: Bool[Tensor, "n"]) -> CAdamState:
        """With ``reset_moments`` the Gaussians whose opacity was reset start their statistics afresh."""
        if not self.reset_moments:
            return state
        return CAdamState(
            m=state.m.masked_fill(rows[:, None], 0.0),
            v=state.v.masked_fill(rows[:, None], 0.0),
            age=state.age.masked_fill(rows, 0),
        )

    def carry(self, state: CAdamState, edit: RowEdit) -> CAdamState:
        """The state after a refinement, under the chosen reading of who keeps a history.

        ``inherit_half`` gives newborns the moments their parents would have, had every gradient been half as
        large, as a twin takes over half of the work: m / 2, v / 4, so half the drift at the same SNR.
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

    def strengths(self, state: CAdamState) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
        """Drift ``||m_hat||_2`` and noise ``sqrt(||v_hat||_1)``, their ratio the SNR (eq. 11); 0 at age 0."""
        drift = state.m.norm(dim=-1) / _bias_correction(self.beta1, state.age)
        noise = (state.v.sum(dim=-1) / _bias_correction(self.beta2, state.age)).sqrt()
        return drift, noise

    def scores(self, state: CAdamState) -> dict[str, Float[Tensor, "n"]]:
        """Drift and noise in loss per world unit, and the SNR, their ratio."""
        drift, noise = self.strengths(state)
        return {"drift": drift, "noise": noise, "snr": drift / (noise + self._eps(noise))}

    def statistics(self, state: CAdamState, step: int) -> dict[str, float]:
        """The quantile threshold, the spread of the SNR, and how many stand above the gate.

        The gate is ``tau_SNR``; under ``alpha`` each Gaussian has its own, and the median is told.
        """
        if len(state.age) == 0:
            return {}
        scores, gate = self.scores(state), self._gate(state)
        drift, snr = scores["drift"], scores["snr"]
        numbers = {f"snr_p{p}": quantile(snr, p / 100) for p in (10, 50, 90)}
        numbers |= {
            "tau_SNR": quantile(gate, 0.5),
            "share_above_tau_SNR": (snr > gate).float().mean(),
            "age_median": quantile(state.age.float(), 0.5),
            "drift_median": quantile(drift, 0.5),
        }
        population = drift[self._population(state)]
        if self.tau_Q is not None and len(population):  # an empty one has no quantile, and JSON no infinity
            numbers["drift_threshold"] = quantile(population, as_schedule(self.tau_Q)(step))
        return {name: float(number) for name, number in numbers.items() if math.isfinite(number)}

    def _updated(self, signal: GradientSignal) -> Bool[Tensor, ""] | Bool[Tensor, "n"]:
        """Whom this step updates: one truth for all, where the settings allow it, else one for each."""
        is_finite = _finite_rows if self.nonfinite == "skip_row" else _all_finite
        is_updated = is_finite(signal.means)
        return is_updated & signal.visible.any(dim=0) if self.invisible == "skip" else is_updated

    def _gate(self, state: CAdamState) -> Float[Tensor, "n"]:
        """The SNR that candidates exceed."""
        if self.alpha is None:
            return torch.full_like(state.age, self.tau_SNR or 0.0, dtype=state.m.dtype)
        return snr_threshold(self.alpha, float(self.beta1), float(self.beta2), state.age)

    def _eps(self, noise: Float[Tensor, "n"]) -> Float[Tensor, ""]:
        """What is added to the noise; the median is of those that ever had a gradient."""
        if self.eps_mode == "abs":
            return noise.new_tensor(self.eps)
        touched = noise[noise > 0]
        return self.eps * (quantile(touched, 0.5) if len(touched) else noise.new_tensor(1.0))

    def _population(self, state: CAdamState) -> Bool[Tensor, "n"]:
        if self.quantile_over == "mature":
            return state.age >= self.min_age
        if self.quantile_over == "seen":
            return (state.v > 0).any(dim=-1)
        return torch.ones_like(state.age, dtype=torch.bool)


def quantile(values: Float[Tensor, "n"], share: float) -> Float[Tensor, ""]:
    """``torch.quantile`` (linear interpolation) for any ``n``: that one refuses more than 2^24 values.

    The rank is a double, so no ``n`` of this world costs it its whole numbers. Infinity if there are no
    values: nothing exceeds it.
    """
    if len(values) == 0:
        return values.new_tensor(math.inf)
    rank = share * (len(values) - 1)
    below = math.floor(rank)
    ordered = values.sort().values  # kthvalue is faster on most values, and quadratic on ordered ones
    return torch.lerp(ordered[below], ordered[math.ceil(rank)], rank - below)


def _bias_correction(beta: float, age: Int[Tensor, "n"]) -> Float[Tensor, "n"]:
    """``1 - beta**age``, in double precision, for ``beta2`` is close to 1; age 0 counts as 1, never 0 / 0."""
    return (1 - beta ** age.clamp_min(1).double()).float()


def _all_finite(values: Float[Tensor, "n 3"]) -> Bool[Tensor, ""]:
    """Whether no value is NaN or infinite, in one pass and without a temporary."""
    if values.numel() == 0:
        return torch.ones((), dtype=torch.bool, device=values.device)
    low, high = values.aminmax()  # NaN if there is one
    return low.isfinite() & high.isfinite()


def _finite_rows(values: Float[Tensor, "n 3"]) -> Bool[Tensor, "n"]:
    """Which rows have neither NaN nor infinity: zero times those is NaN, and never overflows."""
    x, y, z = (values * 0).unbind(dim=-1)
    return (x + y + z) == 0


def _over_population_rms(gradients: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Gradients over the root mean square of their norms: free of the scale that all share, such as w(t)."""
    rms = gradients.square().sum(dim=-1).mean().sqrt()
    return gradients / torch.where(rms > 0, rms, 1.0)
