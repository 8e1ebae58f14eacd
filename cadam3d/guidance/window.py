"""The window of noise levels that an objective draws from; schedules may move it during training."""

from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.checks import require, within
from cadam3d.core.schedule import FAR_STEP, Schedule, as_schedule
from cadam3d.guidance.base import Guidance


@dataclass(frozen=True, kw_only=True)
class WindowedGuidance(Guidance):
    """Guidance at noise levels drawn uniformly from [t_min, t_max).

    With t_min = t_max the level is not random: the same schedule for both is DreamGaussian's annealing of t.
    """

    t_min: Annotated[float | Schedule, within()]  # in [0, t_max]
    t_max: Annotated[float | Schedule, within()]  # in [t_min, 1]
    shared_t: bool

    def __post_init__(self) -> None:
        super().__post_init__()
        # At the steps in between, the two may cross. These are checked when training reaches them.
        for step in (0, FAR_STEP):
            self.window(step)

    def window(self, step: int) -> tuple[float, float]:
        """Return t_min and t_max at ``step``. Raises ``UserError`` if a schedule leaves its range there."""
        low, high = as_schedule(self.t_min)(step), as_schedule(self.t_max)(step)
        require(
            0 <= low <= high <= 1,
            "guidance.t_max",
            expected="0 <= t_min <= t_max <= 1 at every step",
            got=f"t_min {low:g} and t_max {high:g}",
            example="guidance.t_min=0.02 guidance.t_max=0.98",
        )
        return low, high

    def draw_t(
        self, clean: Float[Tensor, "v c h w"], step: int, generator: torch.Generator
    ) -> Float[Tensor, "v"]:
        """Draw noise levels for the encoded renders ``clean``, on the CPU, as :meth:`uniform` does."""
        low, high = self.window(step)
        uniform = self.uniform(clean, generator)
        return torch.lerp(torch.full_like(uniform, low), torch.full_like(uniform, high), uniform)

    def uniform(self, clean: Float[Tensor, "v c h w"], generator: torch.Generator) -> Float[Tensor, "v"]:
        """Draw uniformly from [0, 1): one number for all views with ``shared_t``, otherwise one for each.

        The result is on the CPU, and in float32 or wider, since noise levels need precision.
        """
        views = clean.shape[0]
        drawn = torch.rand(1 if self.shared_t else views, generator=generator, dtype=torch.float32)
        return drawn.to(torch.promote_types(clean.dtype, torch.float32)).expand(views)
