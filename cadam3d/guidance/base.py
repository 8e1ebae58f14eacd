"""Guidance: the interface that turns a prior's prediction about a render into a gradient."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float, Real
from torch import Tensor

from cadam3d.core.chart import Chart
from cadam3d.core.checks import Declared
from cadam3d.prior.base import Condition, DiffusionPrior


@dataclass(frozen=True)
class GuidanceOutput:
    """A surrogate loss, and numbers that show how training proceeds."""

    loss: Float[Tensor, ""]  # its gradient is the distillation gradient
    # For reports; training never reads it. The trainer reads the tensors from the device together with all
    # else that it needs, because each separate reading waits for the device.
    log: Mapping[str, Real[Tensor, ""] | float]


class Guidance(Declared, ABC):
    """A distillation objective (paper eq. 4). Holds frozen hyper-parameters and no state."""

    @abstractmethod
    def __call__(
        self,
        rgb: Float[Tensor, "v h w 3"],
        condition: Condition,
        prior: DiffusionPrior,
        step: int,
        generator: torch.Generator,
    ) -> GuidanceOutput:
        """Return the loss of the render ``rgb``, which is in [0, 1] and has a gradient.

        All random numbers come from the CPU ``generator``.
        """

    def charts(self) -> tuple[Chart, ...]:
        """Declare the charts that the report draws of :attr:`GuidanceOutput.log`; none by default."""
        return ()
