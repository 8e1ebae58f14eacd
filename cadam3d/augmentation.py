"""Augmentation: changes to the Gaussians before they are rendered, and to the images before guidance."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.checks import Declared, Share
from cadam3d.core.device import upload
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.rendering import RenderOutput

# The smallest factor that noise multiplies a scale by. It is positive, so its logarithm is finite.
LEAST = 1e-3
LARGEST_SEED = 2**63 - 1


class Augmentation(Declared, ABC):
    """Two differentiable changes: to the Gaussians of a training step, and to its images.

    Holds frozen hyper-parameters; all randomness comes from the generator.
    """

    @abstractmethod
    def perturb(self, gaussians: Gaussians, generator: torch.Generator) -> Gaussians:
        """Return the Gaussians to render and regularize instead of ``gaussians``, with the same rows.

        ``means`` must be the same tensor object, since densifiers read its gradient.
        """

    @abstractmethod
    def show(self, output: RenderOutput, generator: torch.Generator) -> Float[Tensor, "v h w 3"]:
        """Return the images for guidance, in [0, 1]; called once per step, after :meth:`perturb`."""


@dataclass(frozen=True, kw_only=True)
class NoAugmentation(Augmentation):
    """Changes neither the Gaussians nor the images, and draws no random numbers."""

    def perturb(self, gaussians: Gaussians, generator: torch.Generator) -> Gaussians:
        """Return the Gaussians themselves."""
        return gaussians

    def show(self, output: RenderOutput, generator: torch.Generator) -> Float[Tensor, "v h w 3"]:
        """Return the rendered colours."""
        return output.rgb


@dataclass(frozen=True, kw_only=True)
class LucidAugmentation(Augmentation):
    """Noise on the scales, sometimes disparity instead of colour, and mirrored images (LucidDreamer).

    The noise is drawn once per step for all views; LucidDreamer renders view by view and draws new noise for
    each. Use it only with priors that accept any image: for a prior that knows the camera or distinguishes
    left from right, a mirrored image is wrong.
    """

    scale_noise: Share  # standard deviation
    disparity: Share  # probability
    flip: Share  # probability

    def perturb(self, gaussians: Gaussians, generator: torch.Generator) -> Gaussians:
        """Return the same Gaussians with ``scales * max(1 + scale_noise * N(0, 1), 0.001)``."""
        # Each step has its own generator, so that later draws do not depend on the number of Gaussians.
        seed = int(torch.randint(LARGEST_SEED, (1,), generator=generator))
        log_scales = gaussians.log_scales
        noise = torch.randn(log_scales.shape, generator=torch.Generator().manual_seed(seed))
        factor = (1 + self.scale_noise * noise).clamp_min(LEAST).to(log_scales.dtype)
        return Gaussians(
            means=gaussians.means,
            log_scales=log_scales + upload(factor, log_scales.device).log(),
            quats=gaussians.quats,
            opacity_logits=gaussians.opacity_logits,
            sh=gaussians.sh,
        )

    def show(self, output: RenderOutput, generator: torch.Generator) -> Float[Tensor, "v h w 3"]:
        """Return colours or disparities, possibly mirrored; the same two choices hold for all views."""
        odds = torch.tensor([float(self.disparity), float(self.flip)])
        as_disparity, flipped = (torch.rand(2, generator=generator) < odds).tolist()
        images = output.disparity()[..., None].expand_as(output.rgb) if as_disparity else output.rgb
        return images.flip(dims=(2,)) if flipped else images
