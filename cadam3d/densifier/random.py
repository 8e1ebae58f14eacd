"""Random growth, the control of every experiment: as many Gaussians as CAdam's quantile lets through."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool
from torch import Tensor

from cadam3d.core.chart import Chart, Curve
from cadam3d.core.checks import BelowOne
from cadam3d.core.schedule import Schedule, as_schedule
from cadam3d.densifier.base import GradientFree, RowCount


@dataclass(frozen=True, kw_only=True)
class RandomGrowth(GradientFree):
    """Select a share of the Gaussians uniformly at random, whatever their gradients; reset no opacity.

    If another densifier does no better at the same share, its evidence is worth nothing.
    """

    share: BelowOne | Schedule  # tau_Q = 1 - share

    def select(self, state: RowCount, step: int, generator: torch.Generator) -> Bool[Tensor, "n"]:
        """Return a random mask of as many Gaussians as exceed the quantile ``1 - share`` (paper eq. 9)."""
        n = len(state.no_rows)
        rank = (1 - as_schedule(self.share)(step)) * (n - 1)
        drawn = torch.randperm(n, generator=generator)[: max(n - 1 - math.floor(rank), 0)]
        return state.no_rows.index_fill(0, drawn.to(state.no_rows.device), True)

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
