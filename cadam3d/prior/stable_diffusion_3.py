"""Stable Diffusion 3 and 3.5: a transformer on the straight path, which reads up to three text encoders."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F  # noqa: N812  (the usual name)

from cadam3d.core.cameras import Cameras
from cadam3d.core.checks import require
from cadam3d.io.pretrained import Pretrained
from cadam3d.prior.latent import LatentPrior, number_in
from cadam3d.prior.path import Latents, NoisePath, PerView, Prediction, RectifiedFlow
from cadam3d.prior.texts import T5_TOKENS, Texts, penultimate, tokenize

T5 = "text_encoder_3"
MOST_WIDTH = 100_000  # of a token


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
    upcasts: ClassVar = True

    @property
    def encoders(self) -> tuple[str, ...]:
        """Return the parts that embed text, with T5 if it is requested and available."""
        third = (T5,) if self.t5 and self.found.has(T5) else ()
        return ("text_encoder", "text_encoder_2", *third)

    @cached_property
    def network(self) -> Any:
        """Return the denoiser, frozen and on the device."""
        network = super().network
        return network if T5 in self.encoders else counting_zeros(network)

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
        return self.at_levels(
            RectifiedFlow(shift=number_in({"shift": 1.0, **self.scheduler}, "shift", 0.01, 100))
        )

    def complete(self, noisy: Latents, output: Latents, t: PerView) -> Prediction:
        """Complete the network's output, which is the velocity."""
        return self.noise_path.from_velocity(noisy, output, t)

    @torch.no_grad()
    def embed_texts(self, found: Pretrained, texts: Sequence[str], device: torch.device) -> Texts:
        """Concatenate both CLIP encoders' states, padded to T5's width, and append T5's tokens or a zero."""
        dtype = self.torch_dtype
        clip = [penultimate(found, part, texts, dtype, device) for part in ("text_encoder", "text_encoder_2")]
        both = torch.cat([each.tokens for each in clip], dim=-1)
        width = int(
            number_in(found.config(self.network_part), "joint_attention_dim", both.shape[-1], MOST_WIDTH)
        )
        long = both.new_zeros(len(texts), 1, width)
        if T5 in self.encoders:
            numbers = tokenize(found.part("tokenizer_3"), texts, T5_TOKENS).to(device)
            long = found.part(T5, dtype).to(device)(numbers)[0].to(dtype)
        tokens = torch.cat([F.pad(both, (0, width - both.shape[-1])), long], dim=1)
        return Texts(tokens, torch.cat([each.pooled for each in clip if each.pooled is not None], dim=-1))

    def denoise(self, noisy: Latents, timestep: PerView, texts: Texts, cameras: Cameras) -> Latents:
        """Run the transformer over image and text tokens together."""
        return self.network(
            hidden_states=noisy,
            timestep=timestep,
            encoder_hidden_states=texts.tokens,
            pooled_projections=texts.pooled,
        ).sample

    @property
    def _identity(self) -> tuple[str, ...]:
        """Return everything that an embedded text depends on; without T5, it ends in a single zero token."""
        return super()._identity if T5 in self.encoders else (*super()._identity, "one zero token")


class CountingZeros:
    """An attention processor that counts the last text token as often as T5 has tokens.

    Without T5, Stable Diffusion 3 reads ``T5_TOKENS`` zeros in its place. Text tokens have no positions, so
    all of them have the same states in every layer, and one is enough: an attention weight that is multiplied
    with their number before the normalisation is the sum of theirs. The output stays the same.
    """

    def __init__(self, processor: Any) -> None:
        self.processor = processor

    def __call__(
        self,
        attention: Any,
        hidden_states: Float[Tensor, "b n c"],
        encoder_hidden_states: Float[Tensor, "b m c"] | None = None,
        *args: Any,
        **kwargs: Any,
    ) -> Any:
        """Return the output of the layer, for images or for images and texts."""
        if encoder_hidden_states is None:
            return self.processor(attention, hidden_states, None, *args, **kwargs)
        image, text = hidden_states, encoder_hidden_states

        def heads(states: Tensor, layer: Any, norm: Any) -> Tensor:
            split = layer(states).unflatten(-1, (attention.heads, -1)).transpose(1, 2)
            return split if norm is None else norm(split)

        query, key, value = (
            torch.cat([heads(image, *ours), heads(text, *theirs)], dim=2)
            for ours, theirs in (
                ((attention.to_q, attention.norm_q), (attention.add_q_proj, attention.norm_added_q)),
                ((attention.to_k, attention.norm_k), (attention.add_k_proj, attention.norm_added_k)),
                ((attention.to_v, None), (attention.add_v_proj, None)),
            )
        )
        counts = query.new_zeros(key.shape[2])
        counts[-1] = math.log(T5_TOKENS)
        mixed = F.scaled_dot_product_attention(query, key, value, attn_mask=counts.expand(1, 1, 1, -1))
        both = mixed.transpose(1, 2).flatten(2).to(query.dtype)
        image, text = both.split([image.shape[1], text.shape[1]], dim=1)
        image = attention.to_out[1](attention.to_out[0](image))
        return image, text if attention.context_pre_only else attention.to_add_out(text)


def counting_zeros(network: Any) -> Any:
    """Make ``network`` count the last text token as T5's zeros; changes and returns ``network``."""
    processors = {name: CountingZeros(each) for name, each in network.attn_processors.items()}
    network.set_attn_processor(processors)
    return network
