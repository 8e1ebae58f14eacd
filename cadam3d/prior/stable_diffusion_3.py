"""Stable Diffusion 3 and 3.5: a transformer on the straight path, which reads up to three text encoders."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F  # noqa: N812  (the usual name)

from cadam3d.core.cameras import Cameras
from cadam3d.core.checks import require, require_choice
from cadam3d.io.pretrained import Pretrained
from cadam3d.prior.clip import penultimate
from cadam3d.prior.latent import T5_TOKENS, LatentPrior, Texts, tokenize
from cadam3d.prior.path import NoisePath, Prediction, RectifiedFlow

T5 = "text_encoder_3"


@dataclass(frozen=True, kw_only=True)
class StableDiffusion3(LatentPrior):
    """Esser et al. 2024. The model predicts the velocity, noise - clean; the CAdam paper uses 3.5 for VFDS.

    The noise path applies the model's own ``shift`` to ``t``, so that a uniform ``t`` is a uniform row of the
    table of sigmas in the model's scheduler.
    """

    t5: bool

    kinds: ClassVar = ("StableDiffusion3Pipeline",)
    network_part: ClassVar = "transformer"
    half: ClassVar = "bfloat16"
    upcasts: ClassVar = False

    def __post_init__(self) -> None:
        super().__post_init__()
        require_choice("prior.t5", self.t5, (True, False))

    @property
    def encoders(self) -> tuple[str, ...]:
        """Return the parts that embed text, with T5 if it is requested and available."""
        third = (T5,) if self.t5 and self.found.has(T5) else ()
        return ("text_encoder", "text_encoder_2", *third)

    @cached_property
    def noise_path(self) -> NoisePath:
        """Return the straight path with the model's shift. Raises ``UserError`` for a dynamic shift."""
        is_shifted = not self.scheduler.get("use_dynamic_shifting")
        require(
            is_shifted,
            "prior.path",
            expected="a model with one shift for all image sizes",
            got="dynamic shifting",
            example="prior.path=DIR",
        )
        return self.at_levels(RectifiedFlow(shift=float(self.scheduler.get("shift", 1.0))))

    def complete(
        self, noisy: Float[Tensor, "v c h w"], output: Float[Tensor, "v c h w"], t: Float[Tensor, "v"]
    ) -> Prediction:
        """Complete the network's output, which is the velocity."""
        return self.noise_path.from_velocity(noisy, output, t)

    @torch.no_grad()
    def embed_texts(self, found: Pretrained, texts: Sequence[str], device: torch.device) -> Texts:
        """Concatenate both CLIP encoders' states, padded to T5's width, and append T5's tokens or zeros."""
        dtype = self.torch_dtype
        clip = [penultimate(found, part, texts, dtype, device) for part in ("text_encoder", "text_encoder_2")]
        both = torch.cat([each.tokens for each in clip], dim=-1)
        width = found.config(self.network_part)["joint_attention_dim"]
        long = both.new_zeros(len(texts), T5_TOKENS, width)
        if T5 in self.encoders:
            numbers = tokenize(found.part("tokenizer_3"), texts, T5_TOKENS).to(device)
            long = found.part(T5, dtype).to(device)(numbers)[0].to(dtype)
        tokens = torch.cat([F.pad(both, (0, width - both.shape[-1])), long], dim=1)
        return Texts(tokens, torch.cat([each.pooled for each in clip if each.pooled is not None], dim=-1))

    def denoise(
        self, noisy: Float[Tensor, "b c h w"], timestep: Float[Tensor, "b"], texts: Texts, cameras: Cameras
    ) -> Float[Tensor, "b c h w"]:
        """Run the transformer over image and text tokens together."""
        return self.network(
            hidden_states=noisy,
            timestep=timestep,
            encoder_hidden_states=texts.tokens,
            pooled_projections=texts.pooled,
        ).sample
