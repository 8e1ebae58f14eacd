"""MVDream as its authors published it: the tensor names of latent diffusion, read into classes of diffusers.

The published file contains tensors but neither configuration nor noise schedule. Both equal Stable Diffusion
2.1's, with an input for cameras, and are written down here.
"""

import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from cadam3d.core.checks import fail, require_extra
from cadam3d.core.errors import UserError
from cadam3d.io.pretrained import (
    EXTRA,
    LIBRARIES,
    ModelSource,
    Pretrained,
    empty,
    fetch_file,
    read_model,
    read_tensors,
    short,
)

# The class of each part.
PARTS = {
    "unet": ("diffusers", "UNet2DConditionModel"),
    "vae": ("diffusers", "AutoencoderKL"),
    "text_encoder": ("transformers", "CLIPTextModel"),
}
# The beginning of the names of the UNet's tensors in a file with a whole model.
UNET = "model.diffusion_model."
CONFIGURATIONS: dict[str, dict[str, Any]] = {
    "unet": {
        "block_out_channels": [320, 640, 1280, 1280],
        "cross_attention_dim": 1024,
        "attention_head_dim": [5, 10, 20, 20],  # in diffusers, the number of heads
        "use_linear_projection": True,
        "class_embed_type": "projection",
        "projection_class_embeddings_input_dim": 16,  # of a camera
    },
    "vae": {
        "block_out_channels": [128, 256, 512, 512],
        "down_block_types": ["DownEncoderBlock2D"] * 4,
        "up_block_types": ["UpDecoderBlock2D"] * 4,
        "layers_per_block": 2,
        "latent_channels": 4,
    },
    # Without the last of 24 layers, because the model uses the states before it.
    "text_encoder": {
        "vocab_size": 49408,
        "max_position_embeddings": 77,
        "hidden_size": 1024,
        "intermediate_size": 4096,
        "num_hidden_layers": 23,
        "num_attention_heads": 16,
        "hidden_act": "gelu",
        "bos_token_id": 49406,
        "eos_token_id": 49407,
    },
    "scheduler": {
        "beta_schedule": "scaled_linear",
        "beta_start": 0.00085,
        "beta_end": 0.012,
        "num_train_timesteps": 1000,
        "prediction_type": "epsilon",
    },
}


@dataclass(frozen=True)
class LatentDiffusion(Pretrained):
    """A model in which some parts have latent diffusion's names, and the others have diffusers' names."""

    # For each such part, the file of its tensors, and what their names lack at the beginning.
    files: Mapping[str, tuple[Path, str]]

    def part(self, name: str, dtype: torch.dtype | None = None) -> Any:
        """Load one part, frozen, on the CPU. Raises ``UserError`` if it is missing or damaged."""
        if name not in self.files:
            return super().part(name, dtype)
        from accelerate import init_empty_weights

        with init_empty_weights(include_buffers=False):
            network = empty(self._kind(name), self.config(name))
        file, lacking = self.files[name]
        tensors = read_tensors(f"{self.source.key}.path", file)
        # Older versions of transformers put the text encoder into another module.
        names = {own.removeprefix("text_model."): own for own in network.state_dict()}
        try:
            converted = _convert(name, {lacking + k: tensor for k, tensor in tensors.items()}, network)
            found = {k.removeprefix("text_model."): tensor.to(dtype) for k, tensor in converted.items()}
            # The file has one more layer of the text encoder, which the model does not use.
            loaded = {names[k]: tensor for k, tensor in found.items() if k in names}
            network.load_state_dict(loaded, assign=True)
        except (KeyError, RuntimeError, ValueError) as error:
            problem = f"{self.source.key}: {file} contains no {name} of MVDream ({short(error)})"
            raise UserError(f"{problem}. Try: another {self.source.key}.path") from error
        return network.requires_grad_(False).eval()

    def config(self, name: str) -> dict[str, Any]:
        """Return the configuration of one part."""
        return CONFIGURATIONS[name] if name in self.files else super().config(name)


@dataclass(frozen=True)
class SingleFile(LatentDiffusion):
    """A whole model in one file, which has no tokenizer."""

    tokenizer: str  # folder or name on the hub, with CLIP's vocabulary

    @staticmethod
    def open(source: ModelSource, tokenizer: str) -> "SingleFile":
        """Return the model in ``source.path``. Its tensors are read when a part is loaded."""
        require_extra(source.key, "diffusers", *EXTRA)
        file = Path(str(source.path)).expanduser()
        index = {name: list(kind) for name, kind in PARTS.items()}
        files = dict.fromkeys(PARTS, (file, ""))
        return SingleFile(source, str(file), None, file, index, files, tokenizer)

    def part(self, name: str, dtype: torch.dtype | None = None) -> Any:
        """Load one part; see :meth:`Pretrained.part`. The tokenizer pads with zeros, as OpenCLIP does."""
        return self._load_tokenizer() if name == "tokenizer" else super().part(name, dtype)

    def config(self, name: str) -> dict[str, Any]:
        """Return the configuration of one part; see :meth:`Pretrained.config`."""
        return CONFIGURATIONS[name]

    @property
    def identity(self) -> str:
        """Return a text that changes with the name, size or time of the file, or with the tokenizer."""
        facts = self.file.stat()
        return json.dumps([str(self.file.resolve()), facts.st_size, facts.st_mtime_ns, self.tokenizer])

    def _load_tokenizer(self) -> Any:
        from transformers import CLIPTokenizer

        config, key = self.config("text_encoder"), f"{self.source.key}.tokenizer"
        length, pieces = config["max_position_embeddings"], config["vocab_size"]
        with suppress(UserError):
            loaded = read_model(CLIPTokenizer, self.tokenizer, UserError, model_max_length=length)
            # If the files are missing, transformers may silently make a tokenizer that knows no word.
            if len(loaded) == pieces:
                loaded.pad_token_id = 0
                return loaded
        expected = f"a folder or name on the hub with the {pieces} pieces of CLIP's vocabulary"
        raise fail(key, expected=expected, got=self.tokenizer, example=f"{key}=DIR")


def with_ldm_unet(found: Pretrained) -> Pretrained:
    """Return ``found``, or a model that reads its UNet by these names if the UNet has a foreign class."""
    entry = found.entry("unet")
    if entry is None or entry[0] in LIBRARIES:
        return found
    index = found.index | {"unet": list(PARTS["unet"])}
    files = {"unet": (_unet_file(found), UNET)}
    return LatentDiffusion(found.source, found.where, found.revision, found.file, index, files)


def _unet_file(found: Pretrained) -> Path:
    """Return the file with the tensors of the UNet of a model in the layout of diffusers."""
    variant = found.variant("unet")
    stem = f"unet/diffusion_pytorch_model{f'.{variant}' if variant else ''}"
    reason = "no such file"
    for name in (f"{stem}.safetensors", f"{stem}.bin"):
        file = Path(found.where) / name
        if not Path(found.where).is_dir():
            file, reason, _ = fetch_file(found.where, name, found.revision, True)
        if file is not None and file.is_file():
            return file
    raise UserError(
        f"{found.source.key}: {found.where} has no {stem}.safetensors ({reason}). "
        f"Try: another {found.source.key}.path"
    )


def _convert(name: str, tensors: Mapping[str, Tensor], network: Any) -> dict[str, Tensor]:
    """Return the tensors of one part under their names in diffusers or transformers."""
    from diffusers.loaders import single_file_utils as names

    if name == "unet":
        named = {k.replace("camera_embed.", "label_emb.0."): tensor for k, tensor in tensors.items()}
        return names.convert_ldm_unet_checkpoint(named, network.config)
    if name == "vae":
        return names.convert_ldm_vae_checkpoint(tensors, network.config)
    return names.convert_open_clip_checkpoint(network, tensors)
