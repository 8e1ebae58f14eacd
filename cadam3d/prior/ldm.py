"""Networks with the tensor names of latent diffusion (Rombach et al. 2022), read into classes of diffusers.

Files of this kind contain tensors but no configuration. The configuration follows from the shapes of the
tensors. Everything else is constant in the family of Stable Diffusion 2, the only one that is supported.
"""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from cadam3d.core.errors import UserError
from cadam3d.io.pretrained import (
    LIBRARIES,
    ModelSource,
    Pretrained,
    fetch_file,
    read_tensors,
    require_extra,
    short,
)

HEAD = 64  # channels of one attention head, in the UNet and in the text encoder
SCALING = 0.18215  # factor of the latents
# For each part its class, and the prefix of its tensors' names in a file with a whole model.
PARTS = {
    "unet": (("diffusers", "UNet2DConditionModel"), "model.diffusion_model."),
    "vae": (("diffusers", "AutoencoderKL"), "first_stage_model."),
    "text_encoder": (("transformers", "CLIPTextModel"), "cond_stage_model.model."),
}


@dataclass(frozen=True)
class LatentDiffusion(Pretrained):
    """A model in which some parts have the names of latent diffusion, and the others those of diffusers."""

    # For each such part, the file of its tensors and the prefix of their names.
    files: Mapping[str, tuple[Path, str]]

    def part(self, name: str, dtype: torch.dtype | None = None) -> Any:
        """Load one part, frozen, on the CPU. Raises ``UserError`` if it is missing or damaged."""
        if name not in self.files:
            return super().part(name, dtype)
        tensors = self._tensors(name)
        network = self._empty(name)
        try:
            converted = CONVERSIONS[name](tensors, network)
            cast = {k: tensor if dtype is None else tensor.to(dtype) for k, tensor in converted.items()}
            network.load_state_dict(cast, assign=True)
        except (KeyError, RuntimeError, ValueError) as error:
            raise self._unlike(name, error) from error
        return network.requires_grad_(False).eval()

    def config(self, name: str) -> dict[str, Any]:
        """Return the configuration of one part."""
        if name not in self.files:
            return super().config(name)
        try:
            return CONFIGURATIONS[name](self._tensors(name))
        except (KeyError, IndexError) as error:
            raise self._unlike(name, error) from error

    def _empty(self, name: str) -> nn.Module:
        """Return the network without memory for its parameters."""
        from accelerate import init_empty_weights

        kind, config = self._kind(name), self.config(name)
        with init_empty_weights(include_buffers=False):
            if hasattr(kind, "from_config"):
                return kind.from_config(config)
            return kind(kind.config_class.from_dict(config))

    def _tensors(self, name: str) -> dict[str, Tensor]:
        file, prefix = self.files[name]
        tensors = read_tensors(f"{self.source.key}.path", file)
        return {k.removeprefix(prefix): tensor for k, tensor in tensors.items() if k.startswith(prefix)}

    def _unlike(self, name: str, error: Exception) -> UserError:
        return UserError(
            f"{self.source.key}: {self.files[name][0]} contains no {name} of the Stable Diffusion 2 family "
            f"({short(error)}). Try: another {self.source.key}.path"
        )


@dataclass(frozen=True)
class SingleFile(LatentDiffusion):
    """A whole model in one file. The file has neither a tokenizer nor a noise schedule; both are given."""

    scheduler: Mapping[str, Any]  # configuration of the noise schedule
    tokenizer: str  # folder or name on the hub, with CLIP's vocabulary

    @staticmethod
    def open(source: ModelSource, scheduler: Mapping[str, Any], tokenizer: str) -> "SingleFile":
        """Return the model in ``source.path``. Its tensors are read when a part is loaded."""
        require_extra(source.key)
        file = Path(str(source.path)).expanduser()
        return SingleFile(
            source=source,
            where=str(file),
            revision=None,
            file=file,
            index={name: list(kind) for name, (kind, _) in PARTS.items()},
            files={name: (file, prefix) for name, (_, prefix) in PARTS.items()},
            scheduler=scheduler,
            tokenizer=tokenizer,
        )

    def part(self, name: str, dtype: torch.dtype | None = None) -> Any:
        """Load one part; see :meth:`Pretrained.part`. The tokenizer pads with zeros, as OpenCLIP does."""
        return self._load_tokenizer() if name == "tokenizer" else super().part(name, dtype)

    def config(self, name: str) -> dict[str, Any]:
        """Return the configuration of one part; see :meth:`Pretrained.config`."""
        return dict(self.scheduler) if name == "scheduler" else super().config(name)

    @property
    def identity(self) -> str:
        """Return a text that changes with the name, size or time of the file, or with the tokenizer."""
        facts = self.file.stat()
        return json.dumps([str(self.file.resolve()), facts.st_size, facts.st_mtime_ns, self.tokenizer])

    def _load_tokenizer(self) -> Any:
        from transformers import CLIPTokenizer

        config = self.config("text_encoder")
        pieces, length = config["vocab_size"], config["max_position_embeddings"]
        try:
            loaded = CLIPTokenizer.from_pretrained(self.tokenizer, model_max_length=length)
        except (OSError, ValueError) as error:
            raise self._no_tokenizer(pieces, short(error)) from error
        # If the files are missing, transformers silently makes a tokenizer that knows no word.
        if len(loaded) != pieces:
            raise self._no_tokenizer(pieces, f"it knows {len(loaded)}")
        loaded.pad_token_id = 0
        return loaded

    def _no_tokenizer(self, pieces: int, reason: str) -> UserError:
        key = f"{self.source.key}.tokenizer"
        return UserError(
            f"{key}: expected the {pieces} pieces that the text encoder of {self.file} reads, got "
            f"{self.tokenizer!r} ({reason}). Try: {key}=DIR, a folder with CLIP's vocab.json and merges.txt"
        )


def with_ldm_unet(found: Pretrained) -> Pretrained:
    """Return ``found``, or a model that reads its UNet by these names if the UNet has a foreign class."""
    library = str((found.index.get("unet") or [None])[0])
    if library in LIBRARIES:
        return found
    index = found.index | {"unet": list(PARTS["unet"][0])}
    file = _weights_file(found, "unet")
    return LatentDiffusion(found.source, found.where, found.revision, found.file, index, {"unet": (file, "")})


def _weights_file(found: Pretrained, part: str) -> Path:
    """Return the file with the tensors of one part of a model in the layout of diffusers."""
    stems = [f"{part}/diffusion_pytorch_model{v}" for v in (f".{found.source.variant}", "")]
    stems = stems[found.source.variant is None :]
    names = [stem + suffix for suffix in (".safetensors", ".bin") for stem in stems]
    reason = "no such file"
    for name in names:
        file = Path(found.where) / name
        if not Path(found.where).is_dir():
            file, reason, _ = fetch_file(found.where, name, found.revision, True)
        if file is not None and file.is_file():
            return file
    raise UserError(
        f"{found.source.key}: {found.where} has none of {', '.join(names)} ({reason}). "
        f"Try: download it again, or another {found.source.key}.path"
    )


# --- configurations from shapes -----------------------------------------------------------------------------


def _unet_config(tensors: Mapping[str, Tensor]) -> dict[str, Any]:
    # Every level except the last ends with a downsampling block.
    shrinks = _numbers(tensors, "input_blocks.", ".0.op.weight")
    layers = min(shrinks) - 1
    starts = [1 + level * (layers + 1) for level in range(len(shrinks) + 1)]
    channels = [tensors[f"input_blocks.{i}.0.out_layers.3.weight"].shape[0] for i in starts]
    attends = [f"input_blocks.{i}.1.norm.weight" in tensors for i in starts]
    attention = "middle_block.1.transformer_blocks.0.attn2.to_k.weight"
    config = {
        "in_channels": tensors["input_blocks.0.0.weight"].shape[1],
        "out_channels": tensors["out.2.weight"].shape[0],
        "block_out_channels": channels,
        "layers_per_block": layers,
        "down_block_types": ["CrossAttnDownBlock2D" if each else "DownBlock2D" for each in attends],
        "up_block_types": ["CrossAttnUpBlock2D" if each else "UpBlock2D" for each in reversed(attends)],
        "cross_attention_dim": tensors[attention].shape[1],
        # In diffusers, this key is the number of heads.
        "attention_head_dim": [max(width // HEAD, 1) for width in channels],
        "use_linear_projection": tensors["middle_block.1.proj_in.weight"].ndim == 2,
    }
    if "camera_embed.0.weight" in tensors:
        dim = tensors["camera_embed.0.weight"].shape[1]
        config |= {"class_embed_type": "projection", "projection_class_embeddings_input_dim": dim}
    return config


def _vae_config(tensors: Mapping[str, Tensor]) -> dict[str, Any]:
    levels = 1 + max(_numbers(tensors, "encoder.down.", ".block.0.conv2.weight"))
    widths = [tensors[f"encoder.down.{i}.block.0.conv2.weight"].shape[0] for i in range(levels)]
    return {
        "block_out_channels": widths,
        "down_block_types": ["DownEncoderBlock2D"] * levels,
        "up_block_types": ["UpDecoderBlock2D"] * levels,
        "layers_per_block": 1 + max(_numbers(tensors, "encoder.down.0.block.", ".conv2.weight")),
        "latent_channels": tensors["quant_conv.weight"].shape[0] // 2,
        "scaling_factor": SCALING,
    }


def _text_config(tensors: Mapping[str, Tensor]) -> dict[str, Any]:
    """Return the configuration without the last layer, because the model uses the states before it."""
    width, pieces = tensors["ln_final.weight"].shape[0], tensors["token_embedding.weight"].shape[0]
    return {
        "vocab_size": pieces,
        "max_position_embeddings": tensors["positional_embedding"].shape[0],
        "hidden_size": width,
        "intermediate_size": tensors["transformer.resblocks.0.mlp.c_fc.weight"].shape[0],
        "num_hidden_layers": max(_numbers(tensors, "transformer.resblocks.", ".ln_1.weight")),
        "num_attention_heads": max(width // HEAD, 1),
        "hidden_act": "gelu",
        "bos_token_id": pieces - 2,
        "eos_token_id": pieces - 1,
    }


def _numbers(tensors: Mapping[str, Tensor], before: str, after: str) -> list[int]:
    """Return the numbers between ``before`` and ``after`` in the names of tensors."""
    found = [k.removeprefix(before).removesuffix(after) for k in tensors if k.startswith(before)]
    numbers = [int(number) for number in found if number.isdigit()]
    if not numbers:
        raise KeyError(f"{before}0{after} is missing")
    return numbers


# --- names in diffusers -------------------------------------------------------------------------------------


def _convert_unet(tensors: Mapping[str, Tensor], network: Any) -> dict[str, Tensor]:
    from diffusers.loaders.single_file_utils import convert_ldm_unet_checkpoint

    prefix = PARTS["unet"][1]
    named = {prefix + k.replace("camera_embed.", "label_emb.0."): tensor for k, tensor in tensors.items()}
    return convert_ldm_unet_checkpoint(named, network.config)


def _convert_vae(tensors: Mapping[str, Tensor], network: Any) -> dict[str, Tensor]:
    from diffusers.loaders.single_file_utils import convert_ldm_vae_checkpoint

    prefix = PARTS["vae"][1]
    return convert_ldm_vae_checkpoint({prefix + k: tensor for k, tensor in tensors.items()}, network.config)


def _convert_text_encoder(tensors: Mapping[str, Tensor], network: Any) -> dict[str, Tensor]:
    from diffusers.loaders.single_file_utils import convert_open_clip_checkpoint

    unused = f"transformer.resblocks.{network.config.num_hidden_layers}."
    ignored = (unused, "text_projection")
    wanted = {name: tensor for name, tensor in tensors.items() if not name.startswith(ignored)}
    converted = convert_open_clip_checkpoint(network, wanted, prefix="")
    is_wrapped = hasattr(network, "text_model")  # in older versions of transformers
    return converted if is_wrapped else {k.removeprefix("text_model."): t for k, t in converted.items()}


CONFIGURATIONS: dict[str, Callable[[Mapping[str, Tensor]], dict[str, Any]]] = {
    "unet": _unet_config,
    "vae": _vae_config,
    "text_encoder": _text_config,
}
CONVERSIONS: dict[str, Callable[[Mapping[str, Tensor], Any], dict[str, Tensor]]] = {
    "unet": _convert_unet,
    "vae": _convert_vae,
    "text_encoder": _convert_text_encoder,
}
