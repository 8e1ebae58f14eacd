"""Densifier: WHEN a Gaussian may grow. HOW (clone, split, prune) is shared: see refine.py (sec. 4.4)."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Generic, TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from cadam3d.core.edit import RowEdit, RowState

State = TypeVar("State", bound=RowState)


@dataclass(frozen=True)
class GradientSignal:
    """What one backward pass told us about each Gaussian, before the optimizer step."""

    means: Float[Tensor, "n 3"]  # dLoss/dmeans, loss per world unit: CAdam's evidence
    means2d: Float[Tensor, "v n 2"]  # dLoss/dmeans2d, loss per pixel, every view: the baseline's evidence
    visible: Bool[Tensor, "v n"]
    height: int  # image size in pixels, to turn means2d into NDC units
    width: int


class Densifier(ABC, Generic[State]):
    """Frozen hyper-parameters; the per-Gaussian tensors live in a state that the trainer holds."""

    @abstractmethod
    def init_state(self, n: int, device: torch.device) -> State:
        """The state of ``n`` newborn Gaussians."""

    @abstractmethod
    def observe(self, state: State, signal: GradientSignal) -> State:
        """The state after one more step; ``state`` itself is left alone. Called at every step.

        A gradient may hold NaN or infinities (the loop then skips the optimizer step); the state never may.
        """

    @abstractmethod
    def select(self, state: State) -> Bool[Tensor, "n"]:
        """Whom to grow. Called at refinement steps only; the one real difference between densifiers."""

    @abstractmethod
    def unreliable(self, state: State) -> Bool[Tensor, "n"]:
        """Whose opacity an opacity reset lowers (the baseline: everybody's)."""

    def carry(self, state: State, edit: RowEdit) -> State:
        """The state after a refinement; by default survivors keep their rows and newborns start at zero."""
        return state.carry(edit)

    def statistics(self, state: State) -> dict[str, float]:
        """Numbers about the state for logs and plots; never read back."""
        return {}
