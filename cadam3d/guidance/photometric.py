"""Photometric: the difference between renders and the true images, if the prior knows them."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.chart import Chart, Curve
from cadam3d.core.checks import Positive, Share, fail
from cadam3d.guidance.base import Guidance, GuidanceOutput
from cadam3d.prior.base import Condition, DiffusionPrior

SSIM_WINDOW = 11  # pixels, as in 3DGS
DIFFERENCE = Chart(
    title="Difference to the true images",
    caption="Mean absolute difference between the renders and the true images.",
    curves=(Curve(key="l1"),),
    log_y=True,
)


@dataclass(frozen=True, kw_only=True)
class Photometric(Guidance):
    """The loss of 3DGS (Kerbl et al. 2023, eq. 7): (1 - share) L1 + share (1 - SSIM), means over all pixels.

    If the prompt has several modes, the one nearest to the renders is the truth. The log holds ``l1``.
    """

    weight: Positive
    ssim_share: Share

    def __call__(
        self,
        rgb: Float[Tensor, "v h w 3"],
        condition: Condition,
        prior: DiffusionPrior,
        step: int,
        generator: torch.Generator,
    ) -> GuidanceOutput:
        """Return the loss of the render ``rgb``, which is in [0, 1] and has a gradient.

        Raises ``UserError`` if the prior does not know the true images.
        """
        from kornia.losses import ssim_loss  # slow to import

        true = condition.nearest(rgb.detach())
        if true is None:
            expected = "an objective for this prior, which does not know the true images"
            raise fail("guidance", expected=expected, got="photometric", example="guidance=sds")
        l1 = (rgb - true).abs().mean()
        # The loss of kornia is half of 1 - SSIM.
        unlike = 2 * ssim_loss(rgb.permute(0, 3, 1, 2), true.permute(0, 3, 1, 2), SSIM_WINDOW)
        loss = self.weight * ((1 - self.ssim_share) * l1 + self.ssim_share * unlike)
        return GuidanceOutput(loss=loss, log={"l1": l1.detach()})

    def charts(self) -> tuple[Chart, ...]:
        """Declare a chart of ``l1``."""
        return (DIFFERENCE,)
