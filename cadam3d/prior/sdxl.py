"""Stable Diffusion XL: a larger UNet that reads two text encoders, a pooled text and the image size."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch

from cadam3d.core.cameras import Cameras
from cadam3d.io.pretrained import Pretrained
from cadam3d.prior.latent import FACTOR
from cadam3d.prior.path import Latents, PerView
from cadam3d.prior.stable_diffusion import StableDiffusion
from cadam3d.prior.texts import Texts, penultimate


@dataclass(frozen=True, kw_only=True)
class StableDiffusionXL(StableDiffusion):
    """Podell et al. 2023: Stable Diffusion with a network that reads more inputs.

    Every image is presented as uncropped and with its own size (their sec. 2.2). The empty text is embedded
    as zeros if the configuration of the model requires it, as in training.
    """

    kinds: ClassVar = ("StableDiffusionXLPipeline",)
    encoders: ClassVar = ("text_encoder", "text_encoder_2")
    upcasts: ClassVar = True

    def embed_texts(self, found: Pretrained, texts: Sequence[str], device: torch.device) -> Texts:
        """Concatenate the penultimate states of both encoders; the pooled text comes from the second."""
        first, second = (penultimate(found, part, texts, self.torch_dtype, device) for part in self.encoders)
        both = Texts(torch.cat([first.tokens, second.tokens], dim=-1), second.pooled)
        if not found.index.get("force_zeros_for_empty_prompt"):
            return both
        empty = torch.tensor(
            [i for i, text in enumerate(texts) if text == ""], dtype=torch.int64, device=device
        )
        pooled = None if both.pooled is None else both.pooled.index_fill(0, empty, 0)
        return Texts(both.tokens.index_fill(0, empty, 0), pooled)

    def denoise(self, noisy: Latents, timestep: PerView, texts: Texts, cameras: Cameras) -> Latents:
        """Run the UNet with text cross-attention; pooled text and image sizes are added to the time input."""
        height, width = (FACTOR * side for side in noisy.shape[2:])
        # Heights and widths: of the original, of the top left corner of the crop, and of the target. They are
        # filled in on the device, because copying them to it would wait for it.
        sizes = noisy.new_zeros(len(noisy), 3, 2)
        sizes[:, ::2, 0] = height
        sizes[:, ::2, 1] = width
        added = {"text_embeds": texts.pooled, "time_ids": sizes.flatten(1)}
        return self.network(
            noisy, timestep, encoder_hidden_states=texts.tokens, added_cond_kwargs=added
        ).sample
