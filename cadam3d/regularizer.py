"""Regularizers: penalties on Gaussians and renders, added to the guidance loss."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from cadam3d.core.checks import AtLeastZero, Declared, Positive
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.rendering import RenderOutput
from cadam3d.core.schedule import Schedule, as_schedule

# Distance of alpha from 0 and 1 that keeps logarithms finite in transparent and in opaque pixels.
CLEAR = 1e-5


class Regularizer(Declared, ABC):
    """A penalty on properties that the prior does not control. Holds frozen hyper-parameters."""

    @abstractmethod
    def __call__(self, gaussians: Gaussians, output: RenderOutput, step: int) -> Float[Tensor, ""]:
        """Return the weighted penalty at ``step`` (0 is the first), >= 0, with gradient."""


@dataclass(frozen=True, kw_only=True)
class Weighted(Regularizer):
    """A penalty times a weight that may follow a schedule."""

    weight: AtLeastZero | Schedule

    def __call__(self, gaussians: Gaussians, output: RenderOutput, step: int) -> Float[Tensor, ""]:
        """Return ``weight(step)`` times :meth:`penalty`."""
        return as_schedule(self.weight)(step) * self.penalty(gaussians, output)

    @abstractmethod
    def penalty(self, gaussians: Gaussians, output: RenderOutput) -> Float[Tensor, ""]:
        """Return the penalty at weight 1."""


@dataclass(frozen=True, kw_only=True)
class MeanScale(Weighted):
    """Mean standard deviation in world units: keeps Gaussians small (LucidDreamer, weight 1).

    3DGS-MCMC uses a weight of 0.01.
    """

    def penalty(self, gaussians: Gaussians, output: RenderOutput) -> Float[Tensor, ""]:
        """Return the mean over Gaussians and axes."""
        return _mean(gaussians.scales)


@dataclass(frozen=True, kw_only=True)
class MeanOpacity(Weighted):
    """Mean opacity: fades out Gaussians that are not needed.

    3DGS-MCMC (Kheradmand et al. 2024) uses a weight of 0.01.
    """

    def penalty(self, gaussians: Gaussians, output: RenderOutput) -> Float[Tensor, ""]:
        """Return the mean over Gaussians, in (0, 1)."""
        return _mean(gaussians.opacities)


@dataclass(frozen=True, kw_only=True)
class OutsideBall(Weighted):
    """Mean squared distance of the centres to the ball that must hold the object; zero inside it."""

    radius: Positive  # world units

    def penalty(self, gaussians: Gaussians, output: RenderOutput) -> Float[Tensor, ""]:
        """Return the mean over Gaussians of ``max(|mean| - radius, 0)^2``, in world units squared."""
        return _mean((gaussians.means.norm(dim=-1) - self.radius).clamp_min(0).square())


@dataclass(frozen=True, kw_only=True)
class AlphaEntropy(Weighted):
    """Mean binary entropy of the rendered alpha: makes every pixel either object or background, not fog."""

    def penalty(self, gaussians: Gaussians, output: RenderOutput) -> Float[Tensor, ""]:
        """Return the mean over pixels, in nats: 0 for a clean silhouette, log 2 at most."""
        alpha = output.alpha.clamp(CLEAR, 1 - CLEAR)
        return _mean(-alpha * alpha.log() - (1 - alpha) * (1 - alpha).log())


@dataclass(frozen=True, kw_only=True)
class Sparsity(Weighted):
    """Mean of ``sqrt(alpha^2 + 0.01)`` over pixels: keeps empty space empty (as in DreamFusion)."""

    def penalty(self, gaussians: Gaussians, output: RenderOutput) -> Float[Tensor, ""]:
        """Return the mean over pixels, in (0.1, 1.005)."""
        return _mean((output.alpha.square() + 0.01).sqrt())


@dataclass(frozen=True, kw_only=True)
class TotalVariation(Weighted):
    """Mean absolute difference of neighbouring pixels of the render: suppresses speckle."""

    def penalty(self, gaussians: Gaussians, output: RenderOutput) -> Float[Tensor, ""]:
        """Return the mean over views, channels and directions, per pixel."""
        # Imported here, since kornia is slow to import and this penalty is rarely used.
        from kornia.losses import total_variation

        images = output.rgb.permute(0, 3, 1, 2)
        return total_variation(images, reduction="mean").mean()


@dataclass(frozen=True, kw_only=True)
class SquaredVariation(Weighted):
    """Mean squared difference of neighbouring pixels: LucidDreamer's total variation, weight 1."""

    def penalty(self, gaussians: Gaussians, output: RenderOutput) -> Float[Tensor, ""]:
        """Return twice the sum, over the two directions, of the mean over views, channels and pixels."""
        return _squared_variation(output.rgb.permute(0, 3, 1, 2))


@dataclass(frozen=True, kw_only=True)
class DisparityVariation(Weighted):
    """:class:`SquaredVariation` of the disparity: suppresses floaters (LucidDreamer, weight 1)."""

    def penalty(self, gaussians: Gaussians, output: RenderOutput) -> Float[Tensor, ""]:
        """Return the squared variation of ``output.disparity()``, a grey image in [0, 1]."""
        return _squared_variation(output.disparity()[:, None])


def _squared_variation(images: Float[Tensor, "v c h w"]) -> Float[Tensor, ""]:
    return 2 * (_mean(images.diff(dim=2).square()) + _mean(images.diff(dim=3).square()))


def _mean(values: Tensor) -> Float[Tensor, ""]:
    """Return the mean, or 0 if there are no values, so that an empty scene does not give NaN."""
    return values.sum() / max(values.numel(), 1)
