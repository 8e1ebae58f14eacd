"""DiffusionPrior: what knows images, behind one interface for networks and for exact models."""

from abc import ABC, abstractmethod

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

    def notice(self) -> str | None:
        """A sentence the user must read before training with this prior, if any."""
        return None

    def to(self, device: torch.device) -> "DiffusionPrior":
        """Move whatever the prior holds to ``device``; returns the prior."""
        return self
