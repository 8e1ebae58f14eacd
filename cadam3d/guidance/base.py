"""Guidance: how the prior's opinion about a render becomes a gradient."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.chart import Chart
from cadam3d.prior.base import Condition, DiffusionPrior


@dataclass(frozen=True)
class GuidanceOutput:
    """A surrogate loss and what the eye wants to follow."""

    loss: Float[Tensor, ""]  # its gradient IS the distillation gradient
    log: dict[str, float]  # for eyes only; never read back


class Guidance(ABC):
    """A distillation objective (paper eq. 4). Frozen hyper-parameters; stateless."""

    @abstractmethod
    def __call__(
        self,
        rgb: Float[Tensor, "v h w 3"],
        condition: Condition,
        prior: DiffusionPrior,
        step: int,
        generator: torch.Generator,
    ) -> GuidanceOutput:
        """Judge the render ``rgb`` (in [0, 1], with gradient); all draws come from the CPU ``generator``."""

    def charts(self) -> tuple[Chart, ...]:
        """Declare the charts that the report draws of :attr:`GuidanceOutput.log`; none by default."""
        return ()
