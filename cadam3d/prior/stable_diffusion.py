"""Stable Diffusion 1.5 and 2.1-base, which predict the noise, and 2.1, which predicts the velocity."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import torch

from cadam3d.core.cameras import Cameras
from cadam3d.io.pretrained import Pretrained
from cadam3d.prior.latent import LatentPrior, completion, ddpm_path
from cadam3d.prior.path import Latents, NoisePath, PerView, Prediction
from cadam3d.prior.texts import Texts, tokenize


@dataclass(frozen=True, kw_only=True)
class StableDiffusion(LatentPrior):
    """A UNet over four latent channels that reads one CLIP text encoder (Rombach et al. 2022).

    The prediction type and the noise schedule are read from the configuration of the model's scheduler.
    """

    kinds: ClassVar = ("StableDiffusionPipeline",)
    encoders: ClassVar = ("text_encoder",)
    network_part: ClassVar = "unet"
    half: ClassVar = "float16"
    upcasts: ClassVar = False

    @cached_property
    def noise_path(self) -> NoisePath:
        """Return the noise path of the model's scheduler."""
        return self.at_levels(ddpm_path(self.scheduler))

    def complete(self, noisy: Latents, output: Latents, t: PerView) -> Prediction:
        """Complete the network's output; the scheduler defines whether it is the noise or the velocity."""
        return completion(self.noise_path, self.scheduler)(noisy, output, t)

    @torch.no_grad()
    def embed_texts(self, found: Pretrained, texts: Sequence[str], device: torch.device) -> Texts:
        """Return the last hidden state of the encoder, 77 tokens per text."""
        tokens = tokenize(found.part("tokenizer"), texts).to(device)
        encoder = found.part("text_encoder", self.torch_dtype).to(device)
        return Texts(encoder(tokens)[0], None)

    def denoise(self, noisy: Latents, timestep: PerView, texts: Texts, cameras: Cameras) -> Latents:
        """Run the UNet with text cross-attention."""
        return self.network(noisy, timestep, encoder_hidden_states=texts.tokens).sample
