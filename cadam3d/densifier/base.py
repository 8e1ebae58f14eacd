"""Densifier: WHEN a Gaussian may grow. HOW (clone, split, prune) is shared: see refine.py (sec. 4.4)."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Generic, TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from cadam3d.core.chart import Chart
from cadam3d.core.edit import RowEdit, RowState
from cadam3d.core.gaussians import Gaussians
from cadam3d.densifier.refine import Refine, RefinePlan

State = TypeVar("State", bound=RowState)


@dataclass(frozen=True)
class GradientSignal:
    """What one backward pass told us about each Gaussian, before the optimizer step."""

    means: Float[Tensor, "n 3"]  # dLoss/dmeans, loss per world unit: CAdam's evidence
    means2d: Float[Tensor, "v n 2"]  # dLoss/dmeans2d, loss per pixel, every view: the baseline's evidence
    radii: Float[Tensor, "v n"]  # on screen, in pixels; 0 = not seen
    height: int  # image size in pixels, to turn means2d into NDC units
    width: int
    # Sums over pixels of |dLoss/dmeans2d|, for a densifier that needs them.
    absgrad: Float[Tensor, "v n 2"] | None = None

    @property
    def visible(self) -> Bool[Tensor, "v n"]:
        """Which Gaussians touched which view."""
        return self.radii > 0


@dataclass
class Headcount(RowState):
    """The state of a densifier that remembers nothing but how many Gaussians there are."""

    nobody: Bool[Tensor, "n"]  # all False

    @classmethod
    def of(cls, n: int, device: torch.device) -> "Headcount":
        """The count of ``n``."""
        return cls(nobody=torch.zeros(n, dtype=torch.bool, device=device))


class Densifier(ABC, Generic[State]):
    """Frozen hyper-parameters; the per-Gaussian tensors live in a state that the trainer holds.

    Every method is pure: it returns a new state and leaves its arguments alone, so a step that fails half way
    has changed nothing. Working in place would save CAdam about a third of 11 ms per million Gaussians on one
    core, where the cheapest step takes 770 ms (``scripts/bench_densifier.py``).
    """

    @property
    def guidance_only(self) -> bool:
        """Whether signals leave the regularizers out: where there are some, another backward pass."""
        return False

    @property
    def needs_absgrad(self) -> bool:
        """Whether signals bring ``absgrad``, which rasterizers do not sum unless somebody wants it."""
        return False

    @abstractmethod
    def init_state(self, n: int, device: torch.device) -> State:
        """The state of ``n`` newborn Gaussians."""

    @abstractmethod
    def observe(self, state: State, signal: GradientSignal) -> State:
        """The state after one more step; ``state`` itself is left alone. Called at every step.

        A gradient may hold NaN or infinities (the loop then skips the optimizer step); the state never may.
        """

    @abstractmethod
    def select(self, state: State, step: int, generator: torch.Generator) -> Bool[Tensor, "n"]:
        """Whom to grow. Called at refinement steps only; the one real difference between densifiers.

        ``step`` (1 after the first step) is for schedules; the evidence is in the state. ``generator`` (on
        the CPU) is for those who draw lots.
        """

    @abstractmethod
    def unreliable(self, state: State) -> Bool[Tensor, "n"]:
        """Whose opacity an opacity reset lowers (the baseline: everybody's)."""

    def unwanted(self, state: State) -> Bool[Tensor, "n"] | None:
        """Whom a refinement prunes besides the faint and the large, once ``refine.prune_from`` is over.

        Nobody by default (``None``). Asked before the edit: newborns are not meant.
        """
        return None

    def plan(
        self, state: State, gaussians: Gaussians, step: int, refine: Refine, generator: torch.Generator
    ) -> RefinePlan:
        """One refinement, decided, not applied: whom by :meth:`select`, how by ``refine``.

        A densifier with a "how" of its own overrides it. Nothing is changed but ``generator``, on the CPU.
        """
        selected = self.select(state, step, generator)
        return refine.plan(gaussians, selected, step, generator, self.unwanted(state))

    def after_reset(self, state: State, rows: Bool[Tensor, "n"]) -> State:
        """The state after an opacity reset of ``rows``; by default the statistics do not notice."""
        return state

    def perturb(
        self, gaussians: Gaussians, lr: float, generator: torch.Generator
    ) -> Float[Tensor, "n 3"] | None:
        """What an optimizer step is followed by: displacements of the means, in world units.

        None by default (``None``). ``lr`` is the learning rate of the means at that step; ``generator`` is on
        the CPU, and nobody else draws from it.
        """
        return None

    def carry(self, state: State, edit: RowEdit) -> State:
        """The state after a refinement; by default survivors keep their rows and newborns start at zero."""
        return state.carry(edit)

    def scores(self, state: State) -> dict[str, Float[Tensor, "n"]]:
        """Numbers per Gaussian for pictures and histograms, such as the SNR; never read back."""
        return {}

    def statistics(self, state: State, step: int) -> dict[str, float]:
        """Numbers about the state for logs and plots; never read back."""
        return {}

    def charts(self) -> tuple[Chart, ...]:
        """Declare the charts that the report draws of :meth:`statistics`; none by default."""
        return ()
