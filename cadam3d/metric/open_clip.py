"""Weights of CLIP models under the names of OpenCLIP, read into the class of transformers."""

from collections.abc import Iterator, Mapping
from typing import Any

import torch
from torch import Tensor

# Of one layer of a transformer; both libraries have a weight and a bias under each name.
LAYER = {
    "ln_1": "layer_norm1",
    "ln_2": "layer_norm2",
    "attn.out_proj": "self_attn.out_proj",
    "mlp.c_fc": "mlp.fc1",
    "mlp.c_proj": "mlp.fc2",
}
WHOLE = {
    "ln_final.weight": "text_model.final_layer_norm.weight",
    "ln_final.bias": "text_model.final_layer_norm.bias",
    "token_embedding.weight": "text_model.embeddings.token_embedding.weight",
    "positional_embedding": "text_model.embeddings.position_embedding.weight",
    "visual.class_embedding": "vision_model.embeddings.class_embedding",
    "visual.positional_embedding": "vision_model.embeddings.position_embedding.weight",
    "visual.conv1.weight": "vision_model.embeddings.patch_embedding.weight",
    "visual.ln_pre.weight": "vision_model.pre_layrnorm.weight",
    "visual.ln_pre.bias": "vision_model.pre_layrnorm.bias",
    "visual.ln_post.weight": "vision_model.post_layernorm.weight",
    "visual.ln_post.bias": "vision_model.post_layernorm.bias",
    "logit_scale": "logit_scale",
}
# OpenCLIP multiplies with these from the right.
TRANSPOSED = {"text_projection": "text_projection.weight", "visual.proj": "visual_projection.weight"}
TOWERS = {"transformer.": "text_model.", "visual.transformer.": "vision_model."}
BLOCKS = "resblocks."
# A constant that OpenCLIP may store.
IGNORED = ("attn_mask",)


def clip_model(tensors: Mapping[str, Tensor], config: Mapping[str, Any]) -> Any:
    """Return a ``CLIPModel`` of transformers with weights under the names of OpenCLIP: on the CPU, frozen.

    The weights are converted to 32 bits. Raises ``ValueError`` or ``RuntimeError`` if they do not fit the
    configuration, which is that of transformers.
    """
    from accelerate import init_empty_weights
    from transformers import CLIPConfig, CLIPModel

    with init_empty_weights(include_buffers=False):
        model = CLIPModel(CLIPConfig.from_dict(dict(config)))
    renamed = dict(pair for name, tensor in tensors.items() for pair in _renamed(name, tensor.float()))
    model.load_state_dict(renamed, assign=True)
    return model.requires_grad_(False).eval()


def _renamed(name: str, tensor: Tensor) -> Iterator[tuple[str, Tensor]]:
    """Yield the tensors of transformers that one tensor of OpenCLIP becomes."""
    if name in IGNORED:
        return
    if name in WHOLE:
        yield WHOLE[name], tensor
    elif name in TRANSPOSED:
        yield TRANSPOSED[name], tensor.T.contiguous()
    else:
        yield from _of_layer(name, tensor)


def _of_layer(name: str, tensor: Tensor) -> Iterator[tuple[str, Tensor]]:
    tower, _, rest = name.partition(BLOCKS)
    number, _, inner = rest.partition(".")
    if tower not in TOWERS or not number.isdigit():
        raise ValueError(f"{name} is no weight of an OpenCLIP model")
    layer = f"{TOWERS[tower]}encoder.layers.{number}."
    # One matrix projects to queries, keys and values.
    if inner in ("attn.in_proj_weight", "attn.in_proj_bias"):
        kind = inner.removeprefix("attn.in_proj_")
        for part, values in zip("qkv", torch.chunk(tensor, 3), strict=True):
            yield f"{layer}self_attn.{part}_proj.{kind}", values.contiguous()
        return
    stem, _, kind = inner.rpartition(".")
    if stem not in LAYER:
        raise ValueError(f"{name} is no weight of an OpenCLIP model")
    yield f"{layer}{LAYER[stem]}.{kind}", tensor
