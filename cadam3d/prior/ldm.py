"""MVDream as its authors published it: the tensor names of latent diffusion, read into classes of diffusers.

The published file contains tensors but no configuration. The configuration equals Stable Diffusion 2.1's
with an input for cameras, and it is written down here.
"""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from cadam3d.core.checks import fail, require
from cadam3d.core.errors import UserError
from cadam3d.io.pretrained import (
    LIBRARIES,
    ModelSource,
    Pretrained,
    empty,
    fetch_file,
    read_tensors,
    require_extra,
    short,
)

# For each part its class, and the prefix of its tensors' names in a file with a whole model.
PARTS = {
    "unet": (("diffusers", "UNet2DConditionModel"), "model.diffusion_model."),
    "vae": (("diffusers", "AutoencoderKL"), "first_stage_model."),
    "text_encoder": (("transformers", "CLIPTextModel"), "cond_stage_model.model."),
}
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
}


@dataclass(frozen=True)
class LatentDiffusion(Pretrained):
    """A model in which some parts have latent diffusion's names, and the others have diffusers' names."""

    # For each such part, the file of its tensors and the prefix of their names.
    files: Mapping[str, tuple[Path, str]]

    def part(self, name: str, dtype: torch.dtype | None = None) -> Any:
        """Load one part, frozen, on the CPU. Raises ``UserError`` if it is missing or damaged."""
        if name not in self.files:
            return super().part(name, dtype)
        from accelerate import init_empty_weights

        kind, tensors = self._kind(name), self._tensors(name)
        with init_empty_weights(include_buffers=False):
            network = empty(kind, self.config(name))
        try:
            converted = CONVERSIONS[name](tensors, network)
            cast = {k: tensor if dtype is None else tensor.to(dtype) for k, tensor in converted.items()}
            network.load_state_dict(cast, assign=True)
        except (KeyError, RuntimeError, ValueError) as error:
            raise UserError(
                f"{self.source.key}: {self.files[name][0]} contains no {name} of MVDream ({short(error)}). "
                f"Try: another {self.source.key}.path"
            ) from error
        return network.requires_grad_(False).eval()

    def config(self, name: str) -> dict[str, Any]:
        """Return the configuration of one part."""
        return CONFIGURATIONS[name] if name in self.files else super().config(name)

    def _tensors(self, name: str) -> dict[str, Tensor]:
        file, prefix = self.files[name]
        tensors = read_tensors(f"{self.source.key}.path", file)
        return {k.removeprefix(prefix): tensor for k, tensor in tensors.items() if k.startswith(prefix)}


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

        config, key = self.config("text_encoder"), f"{self.source.key}.tokenizer"
        expected = f"a folder or name on the hub with the {config['vocab_size']} pieces of CLIP's vocabulary"
        try:
            loaded = CLIPTokenizer.from_pretrained(
                self.tokenizer, model_max_length=config["max_position_embeddings"]
            )
        except (OSError, ValueError) as error:
            raise fail(key, expected=expected, got=self.tokenizer, example=f"{key}=DIR") from error
        # If the files are missing, transformers silently makes a tokenizer that knows no word.
        fits = len(loaded) == config["vocab_size"]
        require(fits, key, expected=expected, got=self.tokenizer, example=f"{key}=DIR")
        loaded.pad_token_id = 0
        return loaded


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
    variant = f".{found.source.variant}" if found.source.variant else ""
    stem = f"{part}/diffusion_pytorch_model{variant}"
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


CONVERSIONS: dict[str, Callable[[Mapping[str, Tensor], Any], dict[str, Tensor]]] = {
    "unet": _convert_unet,
    "vae": _convert_vae,
    "text_encoder": _convert_text_encoder,
}
