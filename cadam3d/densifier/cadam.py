"""CAdam, the paper's densifier: grow where the gradient drifts consistently (paper sec. 4.2 to 4.4).

The gradient of a Gaussian is a drift plus noise of mean zero (sec. 4.1). Its first moment m keeps the drift
while the noise cancels; its second moment v measures both. A Gaussian grows if its drift is large among all
Gaussians and large compared with its own noise. Choices that the paper leaves open, and our variants, are in
``cadam_open.py``.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from cadam3d.core.chart import Chart, Curve, Level
from cadam3d.core.checks import require, require_choice, require_range, require_whole
from cadam3d.core.edit import RowState
from cadam3d.core.schedule import Schedule, as_schedule, require_scheduled
from cadam3d.densifier.base import Densifier, GradientSignal
from cadam3d.densifier.noise_floor import white_noise_snr

RESET = ("unreliable", "all", "none")


@dataclass
class CAdamState(RowState):
    """Running moments of the world-space gradient of each Gaussian: 28 bytes each.

    Survivors of an edit keep their history, and newborns start at zero with age 0 (paper sec. 4.2), which is
    the rule of :class:`RowState`.
    """

    m: Float[Tensor, "n 3"]  # first moment; loss per world unit
    v: Float[Tensor, "n 3"]  # second raw moment
    age: Int[Tensor, "n"]  # updates since birth; the step count of the bias correction

    def is_possible(self, step: int) -> bool:
        """Return whether squares are not negative and no Gaussian is older than the run."""
        is_age = (self.age >= 0) & (self.age <= step)
        return bool((self.v >= 0).all() & is_age.all())


@dataclass(frozen=True, kw_only=True)
class CAdam(Densifier[CAdamState]):
    """Select Gaussians whose drift is in the top quantile and large compared with its own noise.

    Both tests are independent of the scale of the loss: one is a rank, the other a ratio.
    """

    tau_Q: float | Schedule | None  # in [0, 1), eq. 9
    tau_SNR: float | None  # >= 0, eq. 11 and 13
    beta1: float  # in [0, 1), decay of m
    beta2: float  # in [0, 1), decay of v
    eps: float  # > 0, loss per world unit
    min_age: int  # updates
    reset: str  # one of RESET
    reset_min_age: int  # updates

    def __post_init__(self) -> None:
        if self.tau_Q is not None:
            require_scheduled("densifier.tau_Q", self.tau_Q, low=0, below=1, example=0.9)
        if self.tau_SNR is not None:
            require_range("densifier.tau_SNR", self.tau_SNR, low=0, example=0.1)
        require_range("densifier.beta1", self.beta1, low=0, below=1, example=0.9)
        require_range("densifier.beta2", self.beta2, low=0, below=1, example=0.999)
        require_range("densifier.eps", self.eps, above=0, example=1e-15)
        require_whole("densifier.min_age", self.min_age, low=0, example=20)
        require_choice("densifier.reset", self.reset, RESET)
        require_whole("densifier.reset_min_age", self.reset_min_age, low=0, example=50)
        self._check_reset_threshold()

    @property
    def grows_from(self) -> int:
        """Return the step at which the initial Gaussians reach the age from which they may grow."""
        return self.min_age

    @property
    def resets(self) -> bool:
        """Return whether resets lower unreliable or all opacities."""
        return self.reset != "none"

    def init_state(self, n: int, device: torch.device) -> CAdamState:
        """Return zero moments and age 0."""
        return CAdamState(
            m=torch.zeros(n, 3, device=device),
            v=torch.zeros(n, 3, device=device),
            age=torch.zeros(n, dtype=torch.int32, device=device),
        )

    def observe(self, state: CAdamState, signal: GradientSignal) -> CAdamState:
        """Return the moments after one more step; of the evidence, CAdam reads the gradient of the means."""
        return self.update(state, signal.means)

    def update(self, state: CAdamState, gradients: Float[Tensor, "n 3"]) -> CAdamState:
        """Return the moments after one more gradient (eq. 8 and 10), without waiting for the device.

        These are Adam's operations in Adam's order, so with its betas the moments equal Adam's to the bit. If
        any gradient is NaN or infinite, the step changes nothing.
        """
        is_finite = all_finite(gradients)
        gradients = torch.where(is_finite, gradients, 0.0)
        beta1, beta2 = float(self.beta1), float(self.beta2)
        decayed = state.v * torch.where(is_finite, beta2, 1.0)
        return CAdamState(
            m=torch.lerp(state.m, gradients, is_finite * (1 - beta1)),
            v=decayed.addcmul_(gradients, gradients, value=1 - beta2),
            age=state.age + is_finite,
        )

    def strengths(self, state: CAdamState) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
        """Return drift ``||m_hat||_2`` and noise ``sqrt(||v_hat||_1)``, in loss per world unit; 0 at age 0.

        Their ratio is the intrinsic SNR (eq. 11). Each Gaussian's bias is corrected by its own age (sec.
        4.2).
        """
        drift = state.m.norm(dim=-1) / _bias_correction(self.beta1, state.age)
        noise = (state.v.sum(dim=-1) / _bias_correction(self.beta2, state.age)).sqrt()
        return drift, noise

    def select(self, state: CAdamState, step: int, generator: torch.Generator) -> Bool[Tensor, "n"]:
        """Return the mask of Gaussians to grow, by their drift (eq. 9) and their SNR (eq. 11)."""
        drift, noise = self.strengths(state)
        is_strong = drift > self._drift_threshold(state, drift, step)
        # Compare with a product, because a quotient would divide by a noise close to zero.
        is_reliable = drift > self._snr_threshold(state) * (noise + self._eps(noise))
        return is_strong & is_reliable & (state.age >= self.min_age)

    def unreliable(self, state: CAdamState) -> Bool[Tensor, "n"]:
        """Return the mask of Gaussians whose opacity a reset lowers: those dominated by noise (eq. 13)."""
        if self.reset != "unreliable":
            return torch.full_like(state.age, self.reset == "all", dtype=torch.bool)
        drift, noise = self.strengths(state)
        is_noisy = drift < self._reset_threshold() * (noise + self._eps(noise))
        return is_noisy & (state.age >= self.reset_min_age)

    # Terms of the equations above, which the open choices in ``cadam_open.py`` replace.

    def _drift_threshold(self, state: CAdamState, drift: Float[Tensor, "n"], step: int) -> Float[Tensor, ""]:
        """Return the drift that candidates exceed at ``step`` (right-hand side of eq. 9)."""
        if self.tau_Q is None:
            return drift.new_tensor(-math.inf)
        return quantile(drift, as_schedule(self.tau_Q)(step))

    def _snr_threshold(self, state: CAdamState) -> Float[Tensor, "n"]:
        """Return the SNR that each candidate exceeds; 0 if there is no such gate."""
        return torch.full_like(state.age, self.tau_SNR or 0.0, dtype=state.m.dtype)

    def _reset_threshold(self) -> float:
        """Return the SNR below which a Gaussian is unreliable."""
        assert self.tau_SNR is not None, "_check_reset_threshold requires it"
        return self.tau_SNR

    def _eps(self, noise: Float[Tensor, "n"]) -> Float[Tensor, ""]:
        """Return what is added to ``noise``, so that the SNR of a Gaussian without any gradient is 0."""
        return noise.new_tensor(self.eps)

    def _check_reset_threshold(self) -> None:
        require(
            self.tau_SNR is not None or self.reset != "unreliable",
            "densifier.tau_SNR",
            expected="a number, because densifier.reset=unreliable compares with it too",
            got=self.tau_SNR,
            example="densifier=cadam_no_snr",
        )

    # For logs and reports; training never reads these back.

    def scores(self, state: CAdamState) -> dict[str, Float[Tensor, "n"]]:
        """Return drift and noise, in loss per world unit, and the SNR, their ratio."""
        drift, noise = self.strengths(state)
        return {"drift": drift, "noise": noise, "snr": drift / (noise + self._eps(noise))}

    def statistics(self, state: CAdamState, step: int) -> dict[str, float]:
        """Return thresholds, quantiles of drift and SNR, the share above the SNR gate and the median age.

        ``tau_SNR`` is the median over Gaussians if each has its own. Infinite numbers are left out, because
        JSON has none.
        """
        if len(state.age) == 0:
            return {}
        scores, gate = self.scores(state), self._snr_threshold(state)
        drift, snr = scores["drift"], scores["snr"]
        numbers = {f"snr_p{p}": quantile(snr, p / 100) for p in (10, 50, 90)} | {
            "tau_SNR": quantile(gate, 0.5),
            "share_above_tau_SNR": (snr > gate).float().mean(),
            "age_median": quantile(state.age.float(), 0.5),
            "drift_median": quantile(drift, 0.5),
            "drift_threshold": self._drift_threshold(state, drift, step),
        }
        return {name: float(number) for name, number in numbers.items() if math.isfinite(number)}

    def charts(self) -> tuple[Chart, ...]:
        """Declare the charts of :meth:`statistics`."""
        threshold = Curve(key="drift_threshold", label="threshold", is_threshold=True)
        return (
            Chart(
                title="Signal to noise of the gradients",
                caption="Drift over noise of all Gaussians, before each refinement.",
                curves=(
                    Curve(key="snr_p50", label="median"),
                    Curve(key="tau_SNR", label="tau_SNR", is_threshold=True),
                ),
                band=("snr_p10", "snr_p90"),
                band_label="10 to 90 %",
                score="snr",
                levels=self._snr_levels(),
            ),
            Chart(
                title="Gaussians above the SNR gate",
                caption="Share of all Gaussians whose SNR exceeds tau_SNR, before each refinement.",
                curves=(Curve(key="share_above_tau_SNR"),),
                percent=True,
            ),
            Chart(
                title="Drift",
                caption="Length of the mean gradient (loss per world unit). Candidates exceed the threshold.",
                curves=(
                    Curve(key="drift_median", label="median"),
                    *([threshold] if self._limits_drift() else []),
                ),
                log_y=True,
            ),
            Chart(
                title="Median age",
                caption="Steps since birth, as the bias correction counts them.",
                curves=(Curve(key="age_median"),),
            ),
        )

    def _limits_drift(self) -> bool:
        """Return whether any drift threshold is set."""
        return self.tau_Q is not None

    def _snr_levels(self) -> tuple[Level, ...]:
        """Return the SNR values that the distribution of the SNR is compared with."""
        values = {"tau_SNR": self.tau_SNR, "white noise": white_noise_snr(self.beta1, self.beta2)}
        return tuple(Level(label=label, value=value) for label, value in values.items() if value)


def quantile(values: Float[Tensor, "n"], share: float) -> Float[Tensor, ""]:
    """Return the quantile ``share`` of ``values``, with linear interpolation, for any ``n``.

    ``torch.quantile`` refuses more than 2^24 values. The rank is a double, which represents every possible
    row number exactly. Infinity if there are no values, so that nothing exceeds it.
    """
    if len(values) == 0:
        return values.new_tensor(math.inf)
    rank = share * (len(values) - 1)
    below = math.floor(rank)
    # kthvalue is faster on most values, but takes quadratic time on ordered ones.
    ordered = values.sort().values
    return torch.lerp(ordered[below], ordered[math.ceil(rank)], rank - below)


def _bias_correction(beta: float, age: Int[Tensor, "n"]) -> Float[Tensor, "n"]:
    """Return ``1 - beta**age``, in double precision because ``beta2`` is close to 1; age 0 counts as 1."""
    return (1 - beta ** age.clamp_min(1).double()).float()


def all_finite(values: Float[Tensor, "n 3"]) -> Bool[Tensor, ""]:
    """Return whether no value is NaN or infinite, in one pass and without a temporary."""
    if values.numel() == 0:
        return torch.ones((), dtype=torch.bool, device=values.device)
    # Both are NaN if any value is.
    low, high = values.aminmax()
    # A product with 0 is NaN if the factor is NaN or infinite.
    return (low * 0 + high * 0) == 0
