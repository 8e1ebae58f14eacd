"""No densification: the initial Gaussians are all there will be. Pruning (refine.py) still happens."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool
from torch import Tensor

from cadam3d.core.edit import RowState
from cadam3d.densifier.base import Densifier, GradientSignal


@dataclass
class NoGrowthState(RowState):
    """Nothing to remember but how many there are."""

    nobody: Bool[Tensor, "n"]  # all False


@dataclass(frozen=True, kw_only=True)
class NoGrowth(Densifier[NoGrowthState]):
    """Selects nobody and distrusts nobody."""

    def init_state(self, n: int, device: torch.device) -> NoGrowthState:
        """The mask of nobody among ``n``."""
        return NoGrowthState(nobody=torch.zeros(n, dtype=torch.bool, device=device))

    def observe(self, state: NoGrowthState, signal: GradientSignal) -> NoGrowthState:
        """The same state: gradients change nothing here."""
        return state

    def select(self, state: NoGrowthState, step: int, generator: torch.Generator) -> Bool[Tensor, "n"]:
        """Nobody grows."""
        return state.nobody

    def unreliable(self, state: NoGrowthState) -> Bool[Tensor, "n"]:
        """Nobody's opacity is reset."""
        return state.nobody
