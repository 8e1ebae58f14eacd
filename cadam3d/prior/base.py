"""DiffusionPrior: one interface for image models, whether networks or exact models."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.cameras import Cameras
from cadam3d.core.checks import Declared
from cadam3d.core.rendering import Truth
from cadam3d.prior.path import Latents, NoisePath, PerView, Prediction


class Condition(ABC):
    """The input that a prediction is conditioned on: the prompt for particular views.

    Guidance passes it to the prior without reading it.
    """

    @abstractmethod
    def unprompted(self) -> "Condition":
        """Return the same views under the empty prompt and the empty negative prompt (for inversion)."""

    def nearest(self, rgb: Float[Tensor, "v h w 3"]) -> Float[Tensor, "v h w 3"] | None:
        """Return the true images of these views, or None if they are not known; all are in [0, 1].

        If the prompt leaves something open, they show the mode that is nearest to the images ``rgb``.
        """
        return None


class PromptEmbedding(ABC):
    """A prompt and a negative prompt, embedded once per run."""

    @abstractmethod
    def at(self, cameras: Cameras, background: Float[Tensor, "v 3"]) -> Condition:
        """Return the condition of these views over these background colours, RGB in [0, 1]."""


@dataclass(frozen=True)
class MemoryEstimate:
    """The memory that training with a prior needs, in bytes, estimated before anything is loaded."""

    weights: int  # of the networks that stay loaded
    working: int  # largest scratch memory of one of them, in addition to the weights
    texts: int  # peak while prompts are embedded, before the rest is loaded; 0 if they are cached

    @property
    def total(self) -> int:
        """Return the peak, in bytes."""
        return max(self.weights + self.working, self.texts)

    def __str__(self) -> str:
        return (
            f"{amount(self.total)}: weights {amount(self.weights)}, working memory {amount(self.working)}; "
            f"before that, the text encoders need {amount(self.texts)}"
        )


def amount(count: int) -> str:
    """Return a number of bytes as text, such as ``"5.2 GiB"`` or ``"310 MiB"``."""
    return f"{count / 2**30:.1f} GiB" if count >= 2**30 else f"{count / 2**20:.0f} MiB"


class DiffusionPrior(Declared, ABC):
    """A denoiser of images. ``t`` is in [0, 1]: 0 is clean and 1 is noise, for diffusion and flow models.

    ``noise_path`` is how the model mixes images with noise. It is declared as an attribute and not as a
    property, so that subclasses can make it a dataclass field.
    """

    noise_path: NoisePath

    @abstractmethod
    def embed(self, prompt: str, negative: str) -> PromptEmbedding:
        """Embed both prompts, once per run. Raises ``UserError`` for a prompt that the model cannot read."""

    @abstractmethod
    def encode(self, rgb: Float[Tensor, "v h w 3"]) -> Float[Tensor, "v c lh lw"]:
        """Convert images in [0, 1] to the space that the model denoises in; differentiable."""

    @abstractmethod
    def decode(
        self, latents: Float[Tensor, "v c lh lw"], height: int, width: int
    ) -> Float[Tensor, "v h w 3"]:
        """Invert :meth:`encode`: return images in [0, 1], without gradient.

        ``height`` and ``width`` are the size of the encoded images, in pixels.
        """

    @abstractmethod
    def predict(self, noisy: Latents, t: PerView, condition: Condition, scale: float) -> Prediction:
        """Predict under guidance, negative + scale * (positive - negative), without gradient.

        ``scale`` 1 uses the prompt alone, 0 the negative prompt alone (the empty one unless the user gave
        one). A scale below 0 leads away from the prompt, as in the inversion of SDI.
        """

    def truth(self, prompt: str) -> Truth | None:
        """Return the true images and the true shape of ``prompt``, or None if they are not known."""
        return None

    def memory(self, prompt: str, negative: str, views: int, size: int | None) -> MemoryEstimate | None:
        """Estimate the memory of training on ``views`` square renders of ``size`` pixels per side.

        Returns None if it is negligible.
        """
        return None

    def lacks(self) -> str | None:
        """Return what is missing before this prior can be used, such as weights; None if it is ready."""
        return None

    def load(self) -> None:
        """Load everything that training needs, which may take minutes.

        The trainer calls it first, so that a missing file is reported before the first step.
        """
        return

    def notice(self) -> str | None:
        """Return a sentence that the user must read before training with this prior, or None."""
        return None

    def to(self, device: torch.device) -> "DiffusionPrior":
        """Move everything that the prior holds to ``device``, and return the prior."""
        return self
