"""Clip: pictures and texts in the shared space of a CLIP model (Radford et al. 2021)."""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from cadam3d.metric.scoring import ModelMetric, Scorer, too_long
from cadam3d.metric.transformer import TransformerFolder, kept

# The settings of an image processor that change the pixels.
PREPROCESSING = ("size", "resample", "crop_size", "do_center_crop", "image_mean", "image_std")


@dataclass(frozen=True)
class Clip:
    """A loaded model with its tokenizer and the preprocessing of its pictures."""

    model: Any  # a CLIPModel of transformers, frozen
    tokenizer: Any
    preprocess: Any  # an image processor of transformers
    facts: dict[str, Any]  # for the record of a number

    def pictures(self, images: Float[Tensor, "v h w 3"]) -> Float[Tensor, "v d"]:
        """Return a unit vector for each picture. Pictures are rounded to 8 bits first, as in a file."""
        rounded = (images.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()
        pixels = self.preprocess(images=list(rounded), return_tensors="pt", input_data_format="channels_last")
        pixel_values = pixels["pixel_values"].to(self._device)
        return normalize(self.model.get_image_features(pixel_values=pixel_values).pooler_output, dim=-1)

    def texts(self, texts: Sequence[str]) -> Float[Tensor, "t d"]:
        """Return a unit vector for each text. Long texts are cut off (see :meth:`complaints`)."""
        tokens = self.tokenizer(
            list(texts), padding=True, truncation=True, max_length=self.longest, return_tensors="pt"
        ).to(self._device)
        features = self.model.get_text_features(
            input_ids=tokens["input_ids"], attention_mask=tokens["attention_mask"]
        )
        return normalize(features.pooler_output, dim=-1)

    def complaints(self, text: str) -> tuple[str, ...]:
        """Return a warning about a text that is too long for the model; none if it reads all of it."""
        return too_long(len(self.tokenizer(text, verbose=False)["input_ids"]), self.longest)

    def scorer(self, factor: float = 1.0) -> Scorer:
        """Return what gives each picture ``factor`` times its cosine with the text."""
        direction = cache(lambda text: self.texts([text])[0])
        return Scorer(
            score=lambda images, text: factor * self.pictures(images) @ direction(text),
            facts=self.facts,
            complaints=self.complaints,
        )

    @property
    def longest(self) -> int:
        """Return the number of tokens that the model reads, 77 for the published ones."""
        return int(self.model.config.text_config.max_position_embeddings)

    @property
    def logit_scale(self) -> float:
        """Return the factor by which the model was trained to multiply cosines."""
        return math.exp(float(self.model.logit_scale))

    @property
    def _device(self) -> torch.device:
        return self.model.logit_scale.device


@dataclass(frozen=True, kw_only=True)
class ClipMetric(ModelMetric):
    """A score by a CLIP model."""

    def check_model(self, found: TransformerFolder) -> None:
        """Read the tokenizer and the preprocessing."""
        check_clip(found)


def load_clip(found: TransformerFolder, device: torch.device) -> Clip:
    """Return the CLIP model in a folder, on ``device``. Raises ``UserError`` if it cannot be used."""
    return kept(_loaded, found, found.facts()["weights_sha256"], device)


def _loaded(found: TransformerFolder, _sha256: str, device: torch.device) -> Clip:
    import transformers

    return assembled(found, found.load(transformers.CLIPModel), found.facts(), device)


def assembled(found: TransformerFolder, model: Any, facts: dict[str, Any], device: torch.device) -> Clip:
    """Return a CLIP model, on ``device``, with the tokenizer and the preprocessing in a folder."""
    tokenizer, preprocess = check_clip(found)
    known = preprocess.to_dict()
    activations = {model.config.text_config.hidden_act, model.config.vision_config.hidden_act}
    # What is not in the weights and changes a score.
    settings = {
        # With lists instead of tuples, as the record has them in a file.
        "preprocessing": json.loads(json.dumps({name: known.get(name) for name in PREPROCESSING})),
        "activation": " and ".join(sorted(activations)),
    }
    return Clip(model.to(device), tokenizer, preprocess, facts | settings)


def check_clip(found: TransformerFolder) -> tuple[Any, Any]:
    """Return the tokenizer and the preprocessing in the folder of a CLIP model.

    Raises ``UserError`` if the folder has another kind of model, or if one of them is missing or damaged.
    """
    import transformers

    if found.entries().get("model_type") != "clip":
        raise found.damaged("it is not a CLIP model (model_type: clip) of transformers")
    tokenizer = found.read(transformers.CLIPTokenizer)
    # If the files of a tokenizer are missing, transformers silently makes one that knows no word.
    if len(tokenizer) < found.read(transformers.CLIPConfig).text_config.vocab_size / 2:
        raise found.damaged("files of its tokenizer are missing")
    # This class resizes with Pillow, as the published models were trained. With torchvision, transformers
    # would prefer another class that rounds differently.
    return tokenizer, found.read(transformers.CLIPImageProcessorPil)
