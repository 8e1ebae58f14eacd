"""Random growth, the control of every experiment: as many as CAdam's quantile lets through, drawn by lot."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool
from torch import Tensor

from cadam3d.core.schedule import Schedule, as_schedule, require_scheduled
from cadam3d.densifier.base import Densifier, GradientSignal, Headcount


@dataclass(frozen=True, kw_only=True)
class RandomGrowth(Densifier[Headcount]):
    """Selects a share of the Gaussians uniformly at random, whatever their gradients, and distrusts nobody.

    What a densifier gains over this one at the same share is what its evidence is worth.
    """

    share: float | Schedule  # of the Gaussians, at each refinement; the control of tau_Q = 1 - share

    def __post_init__(self) -> None:
        require_scheduled("densifier.share", self.share, low=0, below=1, example=0.1)

    def init_state(self, n: int, device: torch.device) -> Headcount:
        """Nothing to remember."""
        return Headcount.of(n, device)

    def observe(self, state: Headcount, signal: GradientSignal) -> Headcount:
        """The same state: gradients change nothing here."""
        return state

    def select(self, state: Headcount, step: int, generator: torch.Generator) -> Bool[Tensor, "n"]:
        """Mark exactly as many as exceed the quantile ``1 - share`` of distinct numbers (paper eq. 9)."""
        n = len(state.nobody)
        rank = (1 - as_schedule(self.share)(step)) * (n - 1)
        drawn = torch.randperm(n, generator=generator)[: max(n - 1 - math.floor(rank), 0)]
        return state.nobody.index_fill(0, drawn.to(state.nobody.device), True)

    def unreliable(self, state: Headcount) -> Bool[Tensor, "n"]:
        """Nobody's opacity is reset: there is no evidence to doubt anybody by."""
        return state.nobody

    def statistics(self, state: Headcount, step: int) -> dict[str, float]:
        """The share of this step."""
        return {"share": as_schedule(self.share)(step)}
