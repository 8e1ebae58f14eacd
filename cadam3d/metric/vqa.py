"""Vqa: how sure a vision-language model is that a picture shows the prompt."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.checks import require, require_choice
from cadam3d.core.errors import UserError
from cadam3d.core.number import Number
from cadam3d.io.image import to_uint8
from cadam3d.io.pretrained import DTYPES
from cadam3d.metric import transformer
from cadam3d.metric.scoring import ModelMetric, Scorer
from cadam3d.metric.transformer import TransformerFolder, TransformerSource, kept

# Chat templates and the vocabularies of older models are in separate files.
NEEDED = (*transformer.NEEDED, "*.jinja", "tokenizer.model")
PLACE = "{}"  # of the text in the question, and of the question in the template
# The characters with which tokenizers mark that a token begins a word.
WORD_STARTS = "▁Ġ "
YES, NO = "yes", "no"


@dataclass(frozen=True)
class Answerer:
    """A vision-language model with the tokens that count as yes and as no."""

    model: Any  # of transformers, frozen
    processor: Any
    yes: tuple[int, ...]
    no: tuple[int, ...]
    facts: Mapping[str, Any]  # for the record of a number

    def probabilities(self, inputs: Any) -> tuple[float, float]:
        """Return the probabilities that the next token is a yes and that it is a no."""
        ready = inputs.to(self.model.device, self.model.dtype)
        # Unlike a plain call of the model, this also starts the answer of an encoder with a decoder.
        output = self.model.generate(
            **ready, max_new_tokens=1, do_sample=False, return_dict_in_generate=True, output_logits=True
        )
        shares = output.logits[0][0].float().softmax(dim=-1)
        return float(shares[list(self.yes)].sum()), float(shares[list(self.no)].sum())


@dataclass(frozen=True, kw_only=True)
class Vqa(ModelMetric):
    """The probability that a vision-language model answers a question about a picture with yes.

    This is VQAScore (Lin et al. 2024) with any model of transformers. The answer is the first token. The
    probabilities of all tokens that spell "yes" are added: in upper or lower case, with or without the mark
    that begins a word.
    """

    node: ClassVar[str] = "metric.vqa"
    numbers: ClassVar[tuple[Number, ...]] = (
        Number(
            name="vqa",
            label="VQA score",
            digits=3,
            is_more_better=True,
            explained="Probability that a vision-language model answers yes",
            preference=30,
        ),
    )
    kind: ClassVar[str] = "vqa"

    question: str  # {} is the text of the protocol
    template: str | None  # the text around the question, which is {} in it; None = the model's chat template
    normalize: bool  # whether to divide by the probability of yes or no
    dtype: str  # of the weights

    def __post_init__(self) -> None:
        for name, text in (("question", self.question), ("template", self.template)):
            is_known = text is None or text.count(PLACE) == 1
            require(is_known, f"{self.node}.{name}", expected=f"a text with {PLACE} once", got=text)
        require_choice(f"{self.node}.dtype", self.dtype, tuple(DTYPES))

    def source(self) -> TransformerSource:
        """Return the place of the model. Raises ``UserError`` if neither metric nor protocol names one."""
        return replace(super().source(), needed=NEEDED)

    def check_model(self, found: TransformerFolder) -> None:
        """Read the processor, and check that there are a template and tokens for both answers."""
        processor = _reader(found)[0]
        if self.template is None and not getattr(processor, "chat_template", None):
            raise UserError(
                f"{self.node}.template: expected a text with {PLACE} for the question, because "
                f"{found.source.model} has no chat template, got None. "
                f"Try: {self.node}.template='\"<image>{PLACE}\"'"
            )

    def scorer(self, device: torch.device) -> Scorer:
        """Return the model, which gives each picture a score in [0, 1]."""
        found = self.source().find()
        self.check_model(found)
        answerer = kept(_loaded, found, found.facts()["weights_sha256"], self.dtype, device)
        asked = {"question": self.question, "template": self.template, "normalized": self.normalize}
        return Scorer(
            score=lambda images, text: self._scores(answerer, images, text), facts={**answerer.facts, **asked}
        )

    def _scores(self, answerer: Answerer, images: Float[Tensor, "v h w 3"], text: str) -> Float[Tensor, "v"]:
        question = self.question.replace(PLACE, text)
        scores = []
        # One picture at a time, because a model may cut each into another number of tiles.
        for image in images:
            yes, no = answerer.probabilities(self._inputs(answerer.processor, image, question))
            scores.append(yes / (yes + no) if self.normalize else yes)
        return torch.tensor(scores, dtype=torch.float64)

    def _inputs(self, processor: Any, image: Float[Tensor, "h w 3"], question: str) -> Any:
        from PIL import Image

        picture = Image.fromarray(to_uint8(image))
        if self.template is not None:
            text = self.template.replace(PLACE, question)
            return processor(images=[picture], text=[text], return_tensors="pt")
        parts = [{"type": "image", "image": picture}, {"type": "text", "text": question}]
        return processor.apply_chat_template(
            [{"role": "user", "content": parts}],
            add_generation_prompt=True,
            tokenize=True,
            return_dict=True,
            return_tensors="pt",
        )


def _loaded(found: TransformerFolder, _sha256: str, dtype: str, device: torch.device) -> Answerer:
    from transformers import AutoModelForImageTextToText

    processor, vocabulary, yes, no = _reader(found)
    model = found.load(AutoModelForImageTextToText, DTYPES[dtype]).to(device)
    names = {number: piece for piece, number in vocabulary.items()}
    facts = {**found.facts(), "dtype": dtype, "yes_tokens": [names[number] for number in yes]}
    return Answerer(model, processor, yes, no, facts)


def _reader(found: TransformerFolder) -> tuple[Any, dict[str, int], tuple[int, ...], tuple[int, ...]]:
    """Return the processor of a model, its vocabulary, and the tokens that spell yes and no.

    Raises ``UserError`` if one of them is missing.
    """
    from transformers import AutoProcessor

    processor = found.read(AutoProcessor)
    vocabulary = processor.tokenizer.get_vocab()
    yes, no = (_spelling(word, vocabulary) for word in (YES, NO))
    if not yes or not no:
        raise found.damaged(f"its tokenizer has no token for {YES} or for {NO}")
    return processor, vocabulary, yes, no


def _spelling(word: str, vocabulary: Mapping[str, int]) -> tuple[int, ...]:
    """Return the tokens that spell a word, in increasing order."""
    spelled = [number for piece, number in vocabulary.items() if piece.lstrip(WORD_STARTS).lower() == word]
    return tuple(sorted(spelled))
