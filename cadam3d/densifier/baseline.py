"""3DGS adaptive density control: grow where the view-space gradient is large on average (paper eq. 1)."""

from abc import abstractmethod
from dataclasses import dataclass, replace
from typing import Annotated, TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from cadam3d.core.chart import Chart, Curve
from cadam3d.core.checks import Positive, one_of
from cadam3d.core.edit import RowEdit, RowState
from cadam3d.core.schedule import Schedule, as_schedule
from cadam3d.densifier.base import Densifier, GradientSignal

VIEWS = ("sum_norm", "sum_vector", "last")
Sums = TypeVar("Sums", bound="BaselineState")


@dataclass
class BaselineState(RowState):
    """Gradient norms and sizes since the last refinement: 12 bytes per Gaussian."""

    norm_sum: Float[Tensor, "n"]  # of view-space gradients; loss per NDC unit
    sightings: Int[Tensor, "n"]  # number of norms added
    radius: Float[Tensor, "n"]  # the largest on screen, in pixels

    def carry(self, edit: RowEdit) -> "BaselineState":
        """Return zeros for survivors too, because 3DGS averages over one refinement interval at a time."""
        return type(self)(**{name: rows.new_zeros(edit.rows_after) for name, rows in self.to_dict().items()})


@dataclass(frozen=True, kw_only=True)
class ScreenGradients(Densifier[BaselineState]):
    """Base of densifiers that compare mean norms of view-space gradients with a threshold.

    The mean is over the sightings of the Gaussian since the last refinement: over single views with
    ``views=sum_norm``, otherwise over steps. Gradients are in normalised device coordinates (image
    half-widths), as in 3DGS and gsplat. A reset lowers every opacity.
    """

    views: Annotated[str, one_of(VIEWS)]  # see `_norms`
    grad_multiplier: Positive
    screen_px: Positive | None  # pixels

    @abstractmethod
    def threshold(self, state: BaselineState, step: int) -> float:
        """Return the mean norm from which a Gaussian grows, in loss per NDC unit."""

    def init_state(self, n: int, device: torch.device) -> BaselineState:
        """Return sums and sizes of zero."""
        return BaselineState(
            norm_sum=torch.zeros(n, device=device),
            sightings=torch.zeros(n, dtype=torch.int32, device=device),
            radius=torch.zeros(n, device=device),
        )

    def observe(self, state: Sums, signal: GradientSignal) -> Sums:
        """Return the sums after one more batch. A gradient that is not finite counts as not seen."""
        norms, sightings = self._norms(self._pulls(signal), signal)
        return replace(
            state,
            norm_sum=state.norm_sum + norms,
            sightings=state.sightings + sightings,
            radius=torch.maximum(state.radius, signal.radii.amax(dim=0)),
        )

    def select(self, state: BaselineState, step: int, generator: torch.Generator) -> Bool[Tensor, "n"]:
        """Return the mask of Gaussians to grow: A_i >= threshold (paper eq. 1; ``>=`` as in 3DGS)."""
        return self._mean_norms(state) >= self.threshold(state, step)

    def unreliable(self, state: BaselineState) -> Bool[Tensor, "n"]:
        """Return the mask of all Gaussians: the global opacity reset of 3DGS."""
        return torch.ones_like(state.sightings, dtype=torch.bool)

    def unwanted(self, state: BaselineState) -> Bool[Tensor, "n"] | None:
        """Return the mask of Gaussians larger than ``screen_px`` in any view since the last refinement.

        3DGS intends this, at 20 pixels, but clears its radii before it compares them. As shipped it prunes no
        Gaussian, which is ``null`` here.
        """
        return None if self.screen_px is None else state.radius > self.screen_px

    def scores(self, state: BaselineState) -> dict[str, Float[Tensor, "n"]]:
        """Return the mean gradient norm, in loss per NDC unit, which is compared with the threshold."""
        return {"mean_norm": self._mean_norms(state)}

    def statistics(self, state: BaselineState, step: int) -> dict[str, float]:
        """Return the threshold, quantiles of the mean gradient norm, and the share that reaches it."""
        norms = self._mean_norms(state)
        if len(norms) == 0:
            return {}
        ordered, last = norms.sort().values, len(norms) - 1
        tau_pos = self.threshold(state, step)
        return {
            "tau_pos": tau_pos,
            **{f"gradient_p{p}": float(ordered[round(last * p / 100)]) for p in (10, 50, 90)},
            "share_above_tau_pos": float((norms >= tau_pos).float().mean()),
        }

    def charts(self) -> tuple[Chart, ...]:
        """Declare the charts of :meth:`statistics`."""
        return (
            Chart(
                title="Screen-space gradients",
                caption="Mean gradient norm of each Gaussian, in loss per NDC unit, before each refinement.",
                curves=(
                    Curve(key="gradient_p50", label="median"),
                    Curve(key="tau_pos", label="tau_pos", is_threshold=True),
                ),
                band=("gradient_p10", "gradient_p90"),
                band_label="10 to 90 %",
                log_y=True,
            ),
            Chart(
                title="Gaussians that reach the gradient threshold",
                caption="Share of all Gaussians whose mean gradient norm is at least tau_pos.",
                curves=(Curve(key="share_above_tau_pos"),),
                percent=True,
            ),
        )

    def _pulls(self, signal: GradientSignal) -> Float[Tensor, "v n 2"]:
        """Return the evidence, in loss per pixel."""
        return signal.means2d

    def _norms(
        self, pulls: Float[Tensor, "v n 2"], signal: GradientSignal
    ) -> tuple[Float[Tensor, "n"], Int[Tensor, "n"]]:
        """Return what a batch adds to the sum of norms and to their number. Published codes differ in this.

        ``sum_norm``: every view counts separately (gsplat, gsgen). ``sum_vector``: the norm of the sum, one
        count per batch (GaussianDreamer). ``last``: only the last view (LucidDreamer, FlowDreamer, GCS-BEG).
        """
        # Each axis is scaled separately, because broadcasting over rows of two is slow.
        x, y = pulls.unbind(dim=-1)
        # An NDC unit is half the image size.
        x = x * (self.grad_multiplier * signal.width / 2)
        y = y * (self.grad_multiplier * signal.height / 2)
        norms = torch.hypot(x, y)
        seen = signal.visible & norms.isfinite()
        if self.views == "sum_norm":
            return norms.where(seen, 0.0).sum(dim=0), seen.sum(dim=0, dtype=torch.int32)
        if self.views == "sum_vector":
            total = torch.hypot(x.where(seen, 0.0).sum(dim=0), y.where(seen, 0.0).sum(dim=0))
            return total, seen.any(dim=0).to(torch.int32)
        return norms[-1].where(seen[-1], 0.0), seen[-1].to(torch.int32)

    def _mean_norms(self, state: BaselineState) -> Float[Tensor, "n"]:
        return state.norm_sum / state.sightings.clamp_min(1)


@dataclass(frozen=True, kw_only=True)
class Baseline(ScreenGradients):
    """Select Gaussians whose mean gradient norm reaches a fixed threshold; a reset lowers every opacity.

    With a loss that is a mean over pixels (``guidance.reduction=mean``) the threshold does not depend on the
    image size; with the other reductions, which sum over pixels, it does. It always depends on the scale of
    the loss and of its noise (paper sec. 4.1: the dilemma).
    """

    tau_pos: Positive | Schedule  # loss per NDC unit

    def threshold(self, state: BaselineState, step: int) -> float:
        """Return ``tau_pos`` at this step."""
        return as_schedule(self.tau_pos)(step)
