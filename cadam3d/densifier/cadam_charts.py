"""What CAdam logs about its two gates, and the charts of it; training never reads these back."""

import math
from abc import abstractmethod
from typing import TypeVar

from jaxtyping import Float
from torch import Tensor

from cadam3d.core.chart import Chart, Curve, Level
from cadam3d.core.edit import RowState
from cadam3d.core.reductions import quantile
from cadam3d.core.schedule import Schedule
from cadam3d.densifier.base import Densifier
from cadam3d.densifier.noise_floor import white_noise_snr

State = TypeVar("State", bound=RowState)


class CAdamCharts(Densifier[State]):
    """Base of CAdam and its variants, which compare drift and SNR of each Gaussian with thresholds."""

    # Settings of the subclass, which documents them.
    tau_Q: float | Schedule | None
    tau_SNR: float | None
    beta1: float
    beta2: float
    min_age: int
    reset: str

    @abstractmethod
    def strengths(self, state: State) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
        """Return drift and noise, whose ratio is the SNR."""

    @abstractmethod
    def thresholds(
        self, state: State, drift: Float[Tensor, "n"], step: int
    ) -> tuple[Float[Tensor, ""], Float[Tensor, "n"]]:
        """Return the drift and the SNR that candidates exceed at ``step``."""

    @property
    def grows_from(self) -> int:
        """Return the step at which the initial Gaussians reach the age from which they may grow."""
        return self.min_age

    @property
    def resets(self) -> bool:
        """Return whether resets lower unreliable or all opacities."""
        return self.reset != "none"

    @property
    def least_reliable(self) -> float | None:
        """Return the SNR below which a Gaussian is unreliable (eq. 13); None if there is no such number."""
        return self.tau_SNR

    @property
    def limits_drift(self) -> bool:
        """Return whether any drift threshold is set."""
        return self.tau_Q is not None

    def scores(self, state: State) -> dict[str, Float[Tensor, "n"]]:
        """Return drift and noise, in loss per world unit, and the SNR, their ratio."""
        drift, noise = self.strengths(state)
        return {"drift": drift, "noise": noise, "snr": drift / noise}

    def statistics(self, state: State, step: int) -> dict[str, float]:
        """Return thresholds, quantiles of drift and SNR, the share above the SNR gate and the median age.

        ``tau_SNR`` is the median over Gaussians if each has its own. Infinite numbers are left out, because
        JSON has none.
        """
        age, scores = state.to_dict()["age"], self.scores(state)
        if len(age) == 0:
            return {}
        drift, snr = scores["drift"], scores["snr"]
        least_drift, least_snr = self.thresholds(state, drift, step)
        numbers = {f"snr_p{p}": quantile(snr, p / 100) for p in (10, 50, 90)} | {
            "tau_SNR": quantile(least_snr, 0.5),
            "share_above_tau_SNR": (snr > least_snr).float().mean(),
            "age_median": quantile(age.float(), 0.5),
            "drift_median": quantile(drift, 0.5),
            "drift_threshold": least_drift,
        }
        return {name: float(number) for name, number in numbers.items() if math.isfinite(number)}

    def charts(self) -> tuple[Chart, ...]:
        """Declare the charts of :meth:`statistics`."""
        threshold = Curve(key="drift_threshold", label="threshold", is_threshold=True)
        levels = {"tau_SNR": self.tau_SNR, "white noise": white_noise_snr(self.beta1, self.beta2)}
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
                levels=tuple(Level(label=label, value=value) for label, value in levels.items() if value),
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
                    *([threshold] if self.limits_drift else []),
                ),
                log_y=True,
            ),
            Chart(
                title="Median age",
                caption="Steps since birth, as the bias correction counts them.",
                curves=(Curve(key="age_median"),),
            ),
        )
