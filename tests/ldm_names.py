"""Rename tensors from the names of diffusers to those of latent diffusion, as in published files."""

import re

import torch

IN_RESNET = {
    "norm1": "in_layers.0",
    "conv1": "in_layers.2",
    "time_emb_proj": "emb_layers.1",
    "norm2": "out_layers.0",
    "conv2": "out_layers.3",
    "conv_shortcut": "skip_connection",
}
IN_ATTENTION = {"group_norm": "norm", "to_q": "q", "to_k": "k", "to_v": "v", "to_out.0": "proj_out"}
IN_TEXT = {"layer_norm1": "ln_1", "layer_norm2": "ln_2", "mlp.fc1": "mlp.c_fc", "mlp.fc2": "mlp.c_proj"}


def single_file(unet, vae, text_encoder) -> dict[str, torch.Tensor]:
    """Return all tensors of the three networks, as one published file contains them."""
    parts = {
        "model.diffusion_model.": unet_names(unet),
        "first_stage_model.": vae_names(vae),
        "cond_stage_model.model.": text_names(text_encoder),
    }
    tensors = {prefix + name: t for prefix, named in parts.items() for name, t in named.items()}
    return tensors | {"betas": torch.zeros(1000), "alphas_cumprod": torch.ones(1000)}


def unet_names(unet) -> dict[str, torch.Tensor]:
    per_level = unet.config.layers_per_block + 1
    attends = [kind.startswith("CrossAttn") for kind in unet.config.up_block_types]

    def place(name: str) -> str:
        fixed = {
            "time_embedding.linear_1": "time_embed.0",
            "time_embedding.linear_2": "time_embed.2",
            "class_embedding.linear_1": "camera_embed.0",
            "class_embedding.linear_2": "camera_embed.2",
            "conv_in": "input_blocks.0.0",
            "conv_norm_out": "out.0",
            "conv_out": "out.2",
            "mid_block.resnets.0": "middle_block.0",
            "mid_block.attentions.0": "middle_block.1",
            "mid_block.resnets.1": "middle_block.2",
        }
        for old, new in fixed.items():
            if name.startswith(old + "."):
                return new + name.removeprefix(old)
        side, level, kind, index, rest = re.fullmatch(
            r"(down|up)_blocks\.(\d+)\.(\w+)\.(\d+)\.(.*)", name
        ).groups()
        level, index = int(level), int(index)
        if kind == "downsamplers":
            return f"input_blocks.{(level + 1) * per_level}.0.op.{rest.removeprefix('conv.')}"
        if kind == "upsamplers":
            return f"output_blocks.{(level + 1) * per_level - 1}.{1 + attends[level]}.{rest}"
        block = level * per_level + index
        start = f"input_blocks.{1 + block}" if side == "down" else f"output_blocks.{block}"
        return f"{start}.{int(kind == 'attentions')}.{rest}"

    named = {}
    for name, tensor in unet.state_dict().items():
        placed = place(name)
        named[inside(placed, IN_RESNET) if ".resnets." in name else placed] = tensor
    return named


def vae_names(vae) -> dict[str, torch.Tensor]:
    last = len(vae.config.block_out_channels) - 1

    def place(name: str) -> str:
        name = name.replace("conv_norm_out", "norm_out").replace("conv_shortcut", "nin_shortcut")
        name = re.sub(r"mid_block\.resnets\.(\d)", lambda m: f"mid.block_{int(m[1]) + 1}", name)
        name = name.replace("mid_block.attentions.0", "mid.attn_1")
        name = re.sub(r"down_blocks\.(\d)\.resnets", r"down.\1.block", name)
        name = re.sub(r"down_blocks\.(\d)\.downsamplers\.0", r"down.\1.downsample", name)
        name = re.sub(r"up_blocks\.(\d)\.resnets", lambda m: f"up.{last - int(m[1])}.block", name)
        return re.sub(r"up_blocks\.(\d)\.upsamplers\.0", lambda m: f"up.{last - int(m[1])}.upsample", name)

    named = {}
    for name, tensor in vae.state_dict().items():
        placed = place(name)
        if ".attn_1." in placed:
            placed = inside(placed, IN_ATTENTION)
            # Published files store these matrices as 1 x 1 convolutions.
            named[placed] = tensor[:, :, None, None] if tensor.ndim == 2 else tensor
        else:
            named[placed] = tensor
    return named


def text_names(text_encoder) -> dict[str, torch.Tensor]:
    """Return the tensors of the text encoder with one more layer at the end, which the model does not use."""
    own = {name.removeprefix("text_model."): t for name, t in text_encoder.state_dict().items()}
    layers = text_encoder.config.num_hidden_layers
    named = {
        "token_embedding.weight": own["embeddings.token_embedding.weight"],
        "positional_embedding": own["embeddings.position_embedding.weight"],
        "ln_final.weight": own["final_layer_norm.weight"],
        "ln_final.bias": own["final_layer_norm.bias"],
        "text_projection": torch.eye(text_encoder.config.hidden_size),
        "logit_scale": torch.tensor(4.6),
    }
    for layer in range(layers):
        for kind in ("weight", "bias"):
            block = f"encoder.layers.{layer}.self_attn"
            three = [own[f"{block}.{which}_proj.{kind}"] for which in "qkv"]
            named[f"transformer.resblocks.{layer}.attn.in_proj_{kind}"] = torch.cat(three)
            named[f"transformer.resblocks.{layer}.attn.out_proj.{kind}"] = own[f"{block}.out_proj.{kind}"]
            for old, new in IN_TEXT.items():
                named[f"transformer.resblocks.{layer}.{new}.{kind}"] = own[
                    f"encoder.layers.{layer}.{old}.{kind}"
                ]
    last = f"transformer.resblocks.{layers - 1}."
    extra = {
        k.replace(last, f"transformer.resblocks.{layers}."): t + 1 for k, t in named.items() if last in k
    }
    return named | extra


def inside(name: str, names: dict[str, str]) -> str:
    """Rename the second to last piece of a name if ``names`` contains it."""
    for old, new in names.items():
        name = re.sub(rf"\.{re.escape(old)}\.(weight|bias)$", rf".{new}.\1", name)
    return name
