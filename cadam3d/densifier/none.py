"""No densification: the initial Gaussians are all there will be. Pruning (refine.py) still happens."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool
from torch import Tensor

from cadam3d.densifier.base import Densifier, GradientSignal, Headcount


@dataclass(frozen=True, kw_only=True)
class NoGrowth(Densifier[Headcount]):
    """Selects nobody and distrusts nobody."""

    def init_state(self, n: int, device: torch.device) -> Headcount:
        """Nothing to remember."""
        return Headcount.of(n, device)

    def observe(self, state: Headcount, signal: GradientSignal) -> Headcount:
        """The same state: gradients change nothing here."""
        return state

    def select(self, state: Headcount, step: int, generator: torch.Generator) -> Bool[Tensor, "n"]:
        """Nobody grows."""
        return state.nobody

    def unreliable(self, state: Headcount) -> Bool[Tensor, "n"]:
        """Nobody's opacity is reset."""
        return state.nobody
