"""No densification: no Gaussian is ever added. Pruning (refine.py) still happens."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool
from torch import Tensor

from cadam3d.densifier.base import GradientFree, RowCount


@dataclass(frozen=True, kw_only=True)
class NoGrowth(GradientFree):
    """Select no Gaussian for growth and none for an opacity reset."""

    @property
    def grows_from(self) -> None:
        """Return ``None``, because no Gaussian grows."""

    def select(self, state: RowCount, step: int, generator: torch.Generator) -> Bool[Tensor, "n"]:
        """Return the empty mask."""
        return state.no_rows
