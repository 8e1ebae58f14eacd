"""No densification: no Gaussian is ever added. Pruning (refine.py) still happens."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool
from torch import Tensor

from cadam3d.densifier.base import Densifier, GradientSignal, RowCount


@dataclass(frozen=True, kw_only=True)
class NoGrowth(Densifier[RowCount]):
    """Select no Gaussian for growth and none for an opacity reset."""

    def init_state(self, n: int, device: torch.device) -> RowCount:
        """Return a state without statistics."""
        return RowCount.of(n, device)

    def observe(self, state: RowCount, signal: GradientSignal) -> RowCount:
        """Return the same state, because gradients decide nothing."""
        return state

    def select(self, state: RowCount, step: int, generator: torch.Generator) -> Bool[Tensor, "n"]:
        """Return the empty mask."""
        return state.no_rows

    def unreliable(self, state: RowCount) -> Bool[Tensor, "n"]:
        """Return the empty mask: no opacity is reset."""
        return state.no_rows
