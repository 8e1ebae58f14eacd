"""What the larger models read: a text encoder's states before its last layer, and one vector per text."""

from collections.abc import Sequence

import torch

from cadam3d.io.pretrained import Pretrained
from cadam3d.prior.latent import Texts, tokenize


@torch.no_grad()
def penultimate(
    found: Pretrained, encoder: str, texts: Sequence[str], dtype: torch.dtype, device: torch.device
) -> Texts:
    """CLIP's hidden states before its last layer, and its projected text (None where it projects none).

    ``encoder`` is a part such as ``"text_encoder_2"``; its tokenizer is the part of the same number. Both are
    loaded, used and let go of.
    """
    numbers = tokenize(found.part(encoder.replace("text_encoder", "tokenizer")), texts).to(device)
    network = found.part(encoder, dtype).to(device)
    output = network(numbers, output_hidden_states=True)
    return Texts(output.hidden_states[-2], getattr(output, "text_embeds", None))
