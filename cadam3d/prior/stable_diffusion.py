"""Stable Diffusion 1.5, 2.1-base (both predict noise) and 2.1 (predicts velocity)."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.cameras import Cameras
from cadam3d.io.pretrained import Pretrained
from cadam3d.prior.latent import LatentPrior, Texts, completion, ddpm_path, tokenize
from cadam3d.prior.path import NoisePath, Prediction


@dataclass(frozen=True, kw_only=True)
class StableDiffusion(LatentPrior):
    """A UNet over four latent channels that reads one CLIP text encoder (Rombach et al. 2022).

    What the network predicts, and the noise it was trained on, are read from the model's scheduler.
    """

    kinds: ClassVar = ("StableDiffusionPipeline",)
    encoders: ClassVar = ("text_encoder",)
    network_part: ClassVar = "unet"
    half: ClassVar = "float16"
    upcasts: ClassVar = False

    @cached_property
    def noise_path(self) -> NoisePath:
        """The model's own noise schedule."""
        return ddpm_path(self.scheduler)

    def complete(
        self, noisy: Float[Tensor, "v c h w"], output: Float[Tensor, "v c h w"], t: Float[Tensor, "v"]
    ) -> Prediction:
        """Noise or velocity, as the model's scheduler says."""
        return completion(self.noise_path, self.scheduler)(noisy, output, t)

    @torch.no_grad()
    def embed_texts(self, found: Pretrained, texts: Sequence[str], device: torch.device) -> Texts:
        """The encoder's last hidden state, 77 tokens a text."""
        tokens = tokenize(found.part("tokenizer"), texts).to(device)
        encoder = found.part("text_encoder", self.torch_dtype).to(device)
        return Texts(encoder(tokens)[0], None)

    def denoise(
        self, noisy: Float[Tensor, "b c h w"], timestep: Float[Tensor, "b"], texts: Texts, cameras: Cameras
    ) -> Float[Tensor, "b c h w"]:
        """The UNet under text cross-attention."""
        return self.network(noisy, timestep, encoder_hidden_states=texts.tokens).sample
