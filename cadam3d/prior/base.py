"""DiffusionPrior: what knows images, behind one interface for networks and for exact models."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.cameras import Cameras
from cadam3d.core.render import TruthFn
from cadam3d.prior.path import NoisePath, Prediction


class Condition(ABC):
    """What a prediction is conditioned on: the prompt, seen from particular views. Opaque to guidance."""

    @abstractmethod
    def unprompted(self) -> "Condition":
        """The same views under the empty prompt and the empty negative prompt (for inversion)."""


class PromptEmbedding(ABC):
    """A prompt and a negative prompt, embedded once per run."""

    @abstractmethod
    def at(self, cameras: Cameras, background: Float[Tensor, "v 3"]) -> Condition:
        """The condition of these views: view-dependent wording, and the backdrop behind the render."""


@dataclass(frozen=True)
class MemoryEstimate:
    """What a prior will hold while it trains, in bytes, guessed before anything is loaded."""

    weights: int  # of the networks that stay
    working: int  # the most that one of them needs beside its weights
    texts: int  # the most while prompts are embedded, before the rest is loaded; 0 if they are known

    @property
    def total(self) -> int:
        """The peak, in bytes."""
        return max(self.weights + self.working, self.texts)

    def __str__(self) -> str:
        return (
            f"{amount(self.total)}: weights {amount(self.weights)}, working memory {amount(self.working)}, "
            f"and {amount(self.texts)} before them for the encoders of text"
        )


def amount(count: int) -> str:
    """Bytes in words: ``"5.2 GiB"``, ``"310 MiB"``."""
    return f"{count / 2**30:.1f} GiB" if count >= 2**30 else f"{count / 2**20:.0f} MiB"


class DiffusionPrior(ABC):
    """A denoiser of images. ``t`` in [0, 1]: 0 is clean, 1 is noise, for diffusion and flow models alike."""

    noise_path: NoisePath  # how this model mixes images with noise; not a property, so that it can be a field

    @abstractmethod
    def embed(self, prompt: str, negative: str) -> PromptEmbedding:
        """Embed both prompts; called once. Raises ``UserError`` if the model cannot understand them."""

    @abstractmethod
    def encode(self, rgb: Float[Tensor, "v h w 3"]) -> Float[Tensor, "v c lh lw"]:
        """Images in [0, 1] to the space that the model denoises in; differentiable."""

    @abstractmethod
    def decode(
        self, latents: Float[Tensor, "v c lh lw"], height: int, width: int
    ) -> Float[Tensor, "v h w 3"]:
        """The way back from :meth:`encode`: images in [0, 1], without gradient.

        ``height`` and ``width`` are those of the images that were encoded, in pixels.
        """

    @abstractmethod
    def predict(
        self, noisy: Float[Tensor, "v c lh lw"], t: Float[Tensor, "v"], condition: Condition, scale: float
    ) -> Prediction:
        """One guess, without gradient, under guidance: negative + scale * (positive - negative).

        ``scale`` 1 is the prompt alone, 0 the negative prompt alone (the empty one unless the user gave one);
        below 0 it leads away from the prompt (SDI inverts so).
        """

    def truth(self, prompt: str) -> TruthFn | None:
        """The true images of ``prompt``, for a prior that knows them; None for one that does not."""
        return None

    def memory(self, prompt: str, negative: str, views: int, size: int | None) -> MemoryEstimate | None:
        """What training on ``views`` renders of ``size`` pixels a side will hold; None if next to nothing."""
        return None

    def lacks(self) -> str | None:
        """What must be had before this prior can be used here, such as weights; None if it is ready."""
        return None

    def load(self) -> None:
        """Load what training needs, so that a missing file shows before the first step; may take minutes."""
        return

    def notice(self) -> str | None:
        """A sentence the user must read before training with this prior, if any."""
        return None

    def to(self, device: torch.device) -> "DiffusionPrior":
        """Move whatever the prior holds to ``device``; returns the prior."""
        return self
