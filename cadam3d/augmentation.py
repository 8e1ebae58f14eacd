"""Augmentation: what is done to the Gaussians before they are rendered, and to the images before guidance."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.checks import require_range
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.render import RenderOutput

LEAST = 1e-3  # of a scale that noise leaves over: a logarithm needs something
LARGEST_SEED = 2**63 - 1


class Augmentation(ABC):
    """Two differentiable disguises of a training step. Frozen hyper-parameters; randomness is handed in."""

    @abstractmethod
    def perturb(self, gaussians: Gaussians, generator: torch.Generator) -> Gaussians:
        """What is rendered, and penalised, in place of ``gaussians``: as many rows, in the same order.

        ``means`` must stay the very tensor it is: densifiers read its gradient.
        """

    @abstractmethod
    def show(self, output: RenderOutput, generator: torch.Generator) -> Float[Tensor, "v h w 3"]:
        """What guidance judges, in [0, 1]; called once per step, after :meth:`perturb`."""


@dataclass(frozen=True, kw_only=True)
class NoAugmentation(Augmentation):
    """Renders what there is and shows what was rendered. Draws nothing."""

    def perturb(self, gaussians: Gaussians, generator: torch.Generator) -> Gaussians:
        """The Gaussians themselves."""
        return gaussians

    def show(self, output: RenderOutput, generator: torch.Generator) -> Float[Tensor, "v h w 3"]:
        """The colours."""
        return output.rgb


@dataclass(frozen=True, kw_only=True)
class LucidAugmentation(Augmentation):
    """Noise on the scales, at times disparity instead of colour, and mirror images (LucidDreamer).

    The noise is drawn once per step for all views, where LucidDreamer renders view by view with noise of its
    own for each. For priors that take any image: one that knows the camera, or left from right, would be
    shown something false.
    """

    scale_noise: float  # standard deviation of the factor by which each scale is multiplied
    disparity: float  # probability, per step, of showing the disparity of all views as grey images
    flip: float  # probability, per step, of mirroring all views left to right

    def __post_init__(self) -> None:
        require_range("augmentation.scale_noise", self.scale_noise, low=0, high=1, example=0.1118)
        require_range("augmentation.disparity", self.disparity, low=0, high=1, example=0.2)
        require_range("augmentation.flip", self.flip, low=0, high=1, example=0.5)

    def perturb(self, gaussians: Gaussians, generator: torch.Generator) -> Gaussians:
        """The same Gaussians with ``scales * max(1 + scale_noise * N(0, 1), 0.001)``."""
        # A generator of the step's own: later draws must not depend on how many Gaussians there are.
        seed = int(torch.randint(LARGEST_SEED, (1,), generator=generator))
        log_scales = gaussians.log_scales
        noise = torch.randn(log_scales.shape, generator=torch.Generator().manual_seed(seed))
        factor = (1 + self.scale_noise * noise).clamp_min(LEAST).to(log_scales)
        return Gaussians(
            means=gaussians.means,
            log_scales=log_scales + factor.log(),
            quats=gaussians.quats,
            opacity_logits=gaussians.opacity_logits,
            sh=gaussians.sh,
        )

    def show(self, output: RenderOutput, generator: torch.Generator) -> Float[Tensor, "v h w 3"]:
        """Colours or disparities, perhaps mirrored; two tosses decide for all views together."""
        as_disparity, flipped = (torch.rand(2, generator=generator) < torch.tensor(self._odds)).tolist()
        images = output.disparity()[..., None].expand_as(output.rgb) if as_disparity else output.rgb
        return images.flip(dims=(2,)) if flipped else images

    @property
    def _odds(self) -> tuple[float, float]:
        return float(self.disparity), float(self.flip)
