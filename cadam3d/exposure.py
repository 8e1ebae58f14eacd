"""Exposure: dims the colours of Gaussians that distillation has driven too bright."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.checks import AtLeastZero, Declared, Share, Whole, within
from cadam3d.core.rendering import RenderOutput


class Exposure(Declared, ABC):
    """Checks the brightness of a step's renders. Holds frozen hyper-parameters; uses no random numbers."""

    @abstractmethod
    def dimming(
        self, output: RenderOutput, background: Float[Tensor, "v 3"], step: int
    ) -> Float[Tensor, ""] | None:
        """Return the factor for all colour coefficients after the ``step``-th step (1 is the first).

        None or 1 leaves them unchanged. ``output`` was rendered over ``background`` before the step. The
        trainer reads the factor from the device together with all else that it needs.
        """


@dataclass(frozen=True, kw_only=True)
class NoExposure(Exposure):
    """Accepts any brightness."""

    def dimming(self, output: RenderOutput, background: Float[Tensor, "v 3"], step: int) -> None:
        """Return None."""
        return


@dataclass(frozen=True, kw_only=True)
class BrightnessGuard(Exposure):
    """Dims colours when the bright parts of most views are too bright (GCS-BEG's over-exposure guard).

    The brightness of a pixel is the mean of its channels without the contribution of the background. Over
    black this equals the published code. A background of any other colour counts as part of the object there,
    so that a random colour decides whether the object is dimmed. Here it has no influence.
    """

    begin: Whole  # step
    end: Whole  # step
    quantile: Share
    threshold: AtLeastZero  # brightness
    rate: Annotated[float, within(above=0, below=1)]

    def __post_init__(self) -> None:
        super().__post_init__()
        self.expect(self.end > self.begin, "end", f"a step after begin={self.begin}", self.begin + 3500)

    @torch.no_grad()
    def dimming(
        self, output: RenderOutput, background: Float[Tensor, "v 3"], step: int
    ) -> Float[Tensor, ""] | None:
        """Return ``rate`` if the quantile over views of :meth:`brightness` exceeds the threshold, else 1."""
        if not self.begin < step < self.end:
            return None
        views = self.brightness(output, background)
        return torch.where(views.quantile(self.quantile) > self.threshold, self.rate, 1.0)

    @torch.no_grad()
    def brightness(self, output: RenderOutput, background: Float[Tensor, "v 3"]) -> Float[Tensor, "v"]:
        """Return the quantile over the object's pixels (alpha > 0) of each view, or 0 if it has none."""
        behind = (1 - output.alpha)[..., None] * background[:, None, None]
        pixels = (output.rgb - behind).mean(dim=-1)
        # NaN marks pixels that do not count, because their number is unknown to the host.
        seen = pixels.masked_fill(output.alpha <= 0, torch.nan).flatten(start_dim=1)
        return seen.nanquantile(self.quantile, dim=1).nan_to_num(nan=0.0)
