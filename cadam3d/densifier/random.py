"""Random growth, the control of every experiment: as many as CAdam's quantile passes, chosen at random."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool
from torch import Tensor

from cadam3d.core.chart import Chart, Curve
from cadam3d.core.schedule import Schedule, as_schedule, require_scheduled
from cadam3d.densifier.base import Densifier, GradientSignal, RowCount


@dataclass(frozen=True, kw_only=True)
class RandomGrowth(Densifier[RowCount]):
    """Select a share of the Gaussians uniformly at random, whatever their gradients; reset no opacity.

    What a densifier gains over this one at the same share is what its evidence is worth.
    """

    share: float | Schedule  # in [0, 1): of the Gaussians, at each refinement; matches tau_Q = 1 - share

    def __post_init__(self) -> None:
        require_scheduled("densifier.share", self.share, low=0, below=1, example=0.1)

    def init_state(self, n: int, device: torch.device) -> RowCount:
        """Return a state without statistics."""
        return RowCount.of(n, device)

    def observe(self, state: RowCount, signal: GradientSignal) -> RowCount:
        """Return the same state, because gradients decide nothing."""
        return state

    def select(self, state: RowCount, step: int, generator: torch.Generator) -> Bool[Tensor, "n"]:
        """Mark exactly as many as exceed the quantile ``1 - share`` of distinct numbers (paper eq. 9)."""
        n = len(state.no_rows)
        rank = (1 - as_schedule(self.share)(step)) * (n - 1)
        drawn = torch.randperm(n, generator=generator)[: max(n - 1 - math.floor(rank), 0)]
        return state.no_rows.index_fill(0, drawn.to(state.no_rows.device), True)

    def unreliable(self, state: RowCount) -> Bool[Tensor, "n"]:
        """Return the empty mask: without evidence, no Gaussian is doubtful."""
        return state.no_rows

    def statistics(self, state: RowCount, step: int) -> dict[str, float]:
        """Return the share of this step."""
        return {"share": as_schedule(self.share)(step)}

    def charts(self) -> tuple[Chart, ...]:
        """Declare the chart of :meth:`statistics`."""
        return (
            Chart(
                title="Share chosen at random",
                caption="Share of all Gaussians that each refinement selects.",
                curves=(Curve(key="share"),),
                percent=True,
            ),
        )
