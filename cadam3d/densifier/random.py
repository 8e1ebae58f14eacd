"""Random growth, the control of every experiment: as many as CAdam's quantile lets through, drawn by lot."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool
from torch import Tensor

from cadam3d.core.edit import RowState
from cadam3d.core.schedule import Schedule, as_schedule, require_scheduled
from cadam3d.densifier.base import Densifier, GradientSignal


@dataclass
class RandomGrowthState(RowState):
    """Nothing to remember but how many there are."""

    blank: Bool[Tensor, "n"]  # all False


@dataclass(frozen=True, kw_only=True)
class RandomGrowth(Densifier[RandomGrowthState]):
    """Selects a share of the Gaussians uniformly at random, whatever their gradients, and distrusts nobody.

    What a densifier gains over this one at the same share is what its evidence is worth.
    """

    share: float | Schedule  # of the Gaussians, at each refinement; the control of tau_Q = 1 - share

    def __post_init__(self) -> None:
        require_scheduled("densifier.share", self.share, low=0, below=1, example=0.1)

    def init_state(self, n: int, device: torch.device) -> RandomGrowthState:
        """One row for each of ``n``."""
        return RandomGrowthState(blank=torch.zeros(n, dtype=torch.bool, device=device))

    def observe(self, state: RandomGrowthState, signal: GradientSignal) -> RandomGrowthState:
        """The same state: gradients change nothing here."""
        return state

    def select(self, state: RandomGrowthState, step: int, generator: torch.Generator) -> Bool[Tensor, "n"]:
        """Mark exactly as many as exceed the quantile ``1 - share`` of distinct numbers (paper eq. 9)."""
        n = len(state.blank)
        rank = (1 - as_schedule(self.share)(step)) * (n - 1)
        drawn = torch.randperm(n, generator=generator)[: max(n - 1 - math.floor(rank), 0)]
        return state.blank.index_fill(0, drawn.to(state.blank.device), True)

    def unreliable(self, state: RandomGrowthState) -> Bool[Tensor, "n"]:
        """Nobody's opacity is reset: there is no evidence to doubt anybody by."""
        return state.blank

    def statistics(self, state: RandomGrowthState, step: int) -> dict[str, float]:
        """The share of this step."""
        return {"share": as_schedule(self.share)(step)}
