"""CLIP text encoders as the larger models read them: states before the last layer, and a pooled vector."""

from collections.abc import Sequence

import torch

from cadam3d.io.pretrained import Pretrained
from cadam3d.prior.latent import Texts, tokenize


@torch.no_grad()
def penultimate(
    found: Pretrained, encoder: str, texts: Sequence[str], dtype: torch.dtype, device: torch.device
) -> Texts:
    """Return CLIP's hidden states before the last layer, and its projected text if it has a projection.

    ``encoder`` is a part such as ``"text_encoder_2"``; its tokenizer is the part with the same number. Both
    are loaded, used and freed.
    """
    numbers = tokenize(found.part(encoder.replace("text_encoder", "tokenizer")), texts).to(device)
    network = found.part(encoder, dtype).to(device)
    output = network(numbers, output_hidden_states=True)
    return Texts(output.hidden_states[-2], getattr(output, "text_embeds", None))
