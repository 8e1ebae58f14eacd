"""Weights of CLIP models under the names of OpenCLIP, read into the class of transformers."""

import re
from collections.abc import Iterator, Mapping
from typing import Any

import torch
from torch import Tensor

# From a pattern of OpenCLIP's names to the name in transformers, in this order.
RENAMED = (
    (r"^visual\.transformer\.resblocks\.", "vision_model.encoder.layers."),
    (r"^transformer\.resblocks\.", "text_model.encoder.layers."),
    (r"\.ln_([12])\.", r".layer_norm\1."),
    (r"\.attn\.", ".self_attn."),
    (r"\.mlp\.c_fc\.", ".mlp.fc1."),
    (r"\.mlp\.c_proj\.", ".mlp.fc2."),
    (r"^ln_final\.", "text_model.final_layer_norm."),
    (r"^token_embedding\.", "text_model.embeddings.token_embedding."),
    (r"^positional_embedding$", "text_model.embeddings.position_embedding.weight"),
    (r"^visual\.class_embedding$", "vision_model.embeddings.class_embedding"),
    (r"^visual\.positional_embedding$", "vision_model.embeddings.position_embedding.weight"),
    (r"^visual\.conv1\.", "vision_model.embeddings.patch_embedding."),
    (r"^visual\.ln_pre\.", "vision_model.pre_layrnorm."),
    (r"^visual\.ln_post\.", "vision_model.post_layernorm."),
    (r"^text_projection$", "text_projection.weight"),
    (r"^visual\.proj$", "visual_projection.weight"),
)
# OpenCLIP multiplies with these from the right.
TRANSPOSED = ("text_projection", "visual.proj")
# One matrix of OpenCLIP projects to queries, keys and values.
STACKED = re.compile(r"(.*)\.in_proj_(weight|bias)")
# A constant that OpenCLIP may store.
IGNORED = ("attn_mask",)


def clip_model(tensors: Mapping[str, Tensor], config: Mapping[str, Any]) -> Any:
    """Return a ``CLIPModel`` of transformers with weights under the names of OpenCLIP: on the CPU, frozen.

    The weights are converted to 32 bits. Raises ``RuntimeError`` if they do not fit the configuration, which
    is transformers' own.
    """
    from accelerate import init_empty_weights
    from transformers import CLIPConfig, CLIPModel

    with init_empty_weights(include_buffers=False):
        model = CLIPModel(CLIPConfig.from_dict(dict(config)))
    known = {name: tensor.float() for name, tensor in tensors.items() if name not in IGNORED}
    model.load_state_dict(dict(_renamed(known)), assign=True)
    return model.requires_grad_(False).eval()


def _renamed(tensors: Mapping[str, Tensor]) -> Iterator[tuple[str, Tensor]]:
    """Yield the tensors of transformers with their names."""
    for name, tensor in tensors.items():
        new = name
        for pattern, replacement in RENAMED:
            new = re.sub(pattern, replacement, new)
        if stacked := STACKED.fullmatch(new):
            for part, values in zip("qkv", torch.chunk(tensor, 3), strict=True):
                yield f"{stacked[1]}.{part}_proj.{stacked[2]}", values.contiguous()
        else:
            yield new, tensor.T.contiguous() if name in TRANSPOSED else tensor
