"""Densifier: decides WHEN a Gaussian grows. HOW (clone, split, prune) is shared, see refine.py (sec. 4.4)."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Generic, TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from cadam3d.core.chart import Chart
from cadam3d.core.checks import Declared
from cadam3d.core.edit import RowState
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.rendering import RenderOutput
from cadam3d.densifier.refine import Refine, RefinePlan

State = TypeVar("State", bound=RowState)


@dataclass(frozen=True)
class GradientSignal:
    """The gradients that one backward pass left on each Gaussian, before the optimizer step."""

    means: Float[Tensor, "n 3"]  # dLoss/dmeans, loss per world unit: CAdam's evidence
    means2d: Float[Tensor, "v n 2"]  # dLoss/dmeans2d, loss per pixel: the baseline's evidence
    radii: Float[Tensor, "v n"]  # on screen, in pixels; 0 = not seen
    height: int  # image size in pixels, to turn means2d into NDC units
    width: int
    # Sums over pixels of |dLoss/dmeans2d|, for a densifier that needs them.
    absgrad: Float[Tensor, "v n 2"] | None = None

    @classmethod
    def read(cls, gaussians: Gaussians, output: RenderOutput) -> "GradientSignal":
        """Return the gradients of the last backward pass; another pass would add to the images' gradients.

        The gradient of the means is a copy, because the optimizer reads it after the densifier.
        """
        return cls(
            means=_gradient_of(gaussians.means).clone(),
            means2d=_gradient_of(output.means2d),
            radii=output.radii.detach(),
            height=output.rgb.shape[1],
            width=output.rgb.shape[2],
            absgrad=None if output.absgrad is None else _gradient_of(output.absgrad),
        )

    @property
    def visible(self) -> Bool[Tensor, "v n"]:
        """Return the mask of Gaussians that touched each view."""
        return self.radii > 0


@dataclass
class RowCount(RowState):
    """State of a densifier that remembers nothing except the number of Gaussians."""

    no_rows: Bool[Tensor, "n"]  # all False: the mask that marks no Gaussian


class Densifier(Declared, ABC, Generic[State]):
    """Frozen hyper-parameters; the per-Gaussian tensors are in a state that the trainer holds.

    Every method is pure: it returns a new state and leaves its arguments alone. So a step that fails half way
    has changed nothing, and a step for which the rasterizer had reserved too little memory can be repeated.
    Working in place could save CAdam only a part of 4 ms per million Gaussians on one core, where the
    cheapest step takes 340 ms (``docs/method.md``).
    """

    @property
    def needs_absgrad(self) -> bool:
        """Return whether signals must contain ``absgrad``; rasterizers compute it on request only."""
        return False

    @property
    def grows_from(self) -> int | None:
        """Return the first step after which a Gaussian may grow; ``None`` if none ever grows."""
        return 0

    @property
    def resets(self) -> bool:
        """Return whether opacity resets may lower any opacity."""
        return True

    @abstractmethod
    def init_state(self, n: int, device: torch.device) -> State:
        """Return the state of ``n`` newborn Gaussians."""

    @abstractmethod
    def observe(self, state: State, signal: GradientSignal) -> State:
        """Return the state after one more step, without modifying ``state``. Called at every step.

        A gradient may contain NaN or infinities (the loop then skips the optimizer step); the state never
        may.
        """

    @abstractmethod
    def select(self, state: State, step: int, generator: torch.Generator) -> Bool[Tensor, "n"]:
        """Return the mask of Gaussians to grow: the one real difference between densifiers.

        Called at refinements only. ``step`` (1 after the first step) is for schedules, because the evidence
        is in the state. ``generator`` (on the CPU) is for random choices.
        """

    @abstractmethod
    def unreliable(self, state: State) -> Bool[Tensor, "n"]:
        """Return the mask of Gaussians whose opacity an opacity reset lowers; the baseline marks all."""

    def unwanted(self, state: State) -> Bool[Tensor, "n"] | None:
        """Return the mask of Gaussians that a refinement prunes besides faint and large ones.

        ``None``, the default, marks none. The mask has the rows before the edit, so it never includes
        newborns, and it applies only after ``refine.prune_from``.
        """
        return None

    def plan(
        self, state: State, gaussians: Gaussians, step: int, refine: Refine, generator: torch.Generator
    ) -> RefinePlan:
        """Decide one refinement without applying it: :meth:`select` decides which rows grow, ``refine`` how.

        A densifier with its own "how" overrides this. Only ``generator`` (on the CPU) is changed.
        """
        selected = self.select(state, step, generator)
        # A mask of another shape could be broadcast, and a wrong choice would not show.
        assert selected.dtype == torch.bool, "select returns a mask"
        assert selected.shape == (len(gaussians),), "select returns a mask with one row per Gaussian"
        return refine.plan(gaussians, selected, step, generator, self.unwanted(state))

    def perturb(
        self, gaussians: Gaussians, lr: float, generator: torch.Generator
    ) -> Float[Tensor, "n 3"] | None:
        """Return displacements of the means, in world units, to add after an optimizer step.

        ``None``, the default, moves nothing. ``lr`` is the learning rate of the means at that step;
        ``generator`` is on the CPU, and nothing else draws from it.
        """
        return None

    def scores(self, state: State) -> dict[str, Float[Tensor, "n"]]:
        """Return numbers per Gaussian, such as the SNR, for pictures and histograms only."""
        return {}

    def statistics(self, state: State, step: int) -> dict[str, float]:
        """Return numbers about the state, for logs and plots only."""
        return {}

    def charts(self) -> tuple[Chart, ...]:
        """Declare the charts that the report draws of :meth:`statistics`; none by default."""
        return ()


@dataclass(frozen=True, kw_only=True)
class GradientFree(Densifier[RowCount]):
    """Base of densifiers that decide without gradients and reset no opacity."""

    @property
    def resets(self) -> bool:
        """Return False, because :meth:`unreliable` marks no Gaussian."""
        return False

    def init_state(self, n: int, device: torch.device) -> RowCount:
        """Return a state without statistics."""
        return RowCount(no_rows=torch.zeros(n, dtype=torch.bool, device=device))

    def observe(self, state: RowCount, signal: GradientSignal) -> RowCount:
        """Return the same state, because gradients decide nothing."""
        return state

    def unreliable(self, state: RowCount) -> Bool[Tensor, "n"]:
        """Return the empty mask: without gradients, no Gaussian is called unreliable."""
        return state.no_rows


def _gradient_of(tensor: Tensor) -> Tensor:
    """Return the gradient that backward left on ``tensor``; zeros if it left none."""
    return torch.zeros_like(tensor) if tensor.grad is None else tensor.grad.detach()
