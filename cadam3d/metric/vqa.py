"""Vqa: how sure a vision-language model is that a picture shows the prompt."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.checks import one_of
from cadam3d.core.number import Number
from cadam3d.io.image import to_uint8
from cadam3d.io.pretrained import DTYPES
from cadam3d.metric import transformer
from cadam3d.metric.scoring import ModelMetric, Scorer
from cadam3d.metric.transformer import TransformerFolder, kept

# Chat templates and the vocabularies of older models are in separate files.
NEEDED = (*transformer.NEEDED, "*.jinja", "tokenizer.model")
PLACE = "{}"  # of the text in the question
# The characters with which tokenizers mark that a token begins a word.
WORD_STARTS = "▁Ġ "
YES = "yes"


@dataclass(frozen=True)
class Answerer:
    """A vision-language model with the tokens that count as yes."""

    model: Any  # of transformers, frozen
    processor: Any
    yes: tuple[int, ...]
    facts: Mapping[str, Any]  # for the record of a number

    def yes_to(self, question: str, image: Float[Tensor, "h w 3"]) -> float:
        """Return the probability that the answer to a question about a picture begins with yes."""
        from PIL import Image

        picture = {"type": "image", "image": Image.fromarray(to_uint8(image))}
        inputs = self.processor.apply_chat_template(
            [{"role": "user", "content": [picture, {"type": "text", "text": question}]}],
            add_generation_prompt=True,
            tokenize=True,
            return_dict=True,
            return_tensors="pt",
        )
        ready = inputs.to(self.model.device, self.model.dtype)
        # Unlike a plain call of the model, this also starts the answer of an encoder with a decoder.
        output = self.model.generate(
            **ready, max_new_tokens=1, do_sample=False, return_dict_in_generate=True, output_logits=True
        )
        return float(output.logits[0][0].float().softmax(dim=-1)[list(self.yes)].sum())


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
    needed: ClassVar[tuple[str, ...]] = NEEDED

    question: str  # {} is the text of the protocol
    dtype: Annotated[str, one_of(DTYPES)]  # of the weights

    def __post_init__(self) -> None:
        super().__post_init__()
        is_question = self.question.count(PLACE) == 1
        self.expect(is_question, "question", f"a text with {PLACE} once")

    def check_model(self, found: TransformerFolder) -> None:
        """Read the processor, and check that there are a chat template and tokens that spell yes."""
        _reader(found)

    def scorer(self, device: torch.device) -> Scorer:
        """Return the model, which gives each picture a score in [0, 1]."""
        found = self.find()
        answerer = kept(_loaded, found, found.facts()["weights_sha256"], self.dtype, device)

        def score(images: Tensor, text: str) -> Tensor:
            # One picture at a time, because a model may cut each into another number of tiles.
            scores = [answerer.yes_to(self.question.replace(PLACE, text), image) for image in images]
            return torch.tensor(scores, dtype=torch.float64)

        return Scorer(score=score, facts={**answerer.facts, "question": self.question})


def _loaded(found: TransformerFolder, _sha256: str, dtype: str, device: torch.device) -> Answerer:
    from transformers import AutoModelForImageTextToText

    processor, yes = _reader(found)
    model = found.load(AutoModelForImageTextToText, DTYPES[dtype]).to(device)
    facts = {**found.facts(), "dtype": dtype, "yes_tokens": list(yes)}
    return Answerer(model, processor, tuple(yes.values()), facts)


def _reader(found: TransformerFolder) -> tuple[Any, dict[str, int]]:
    """Return the processor of a model, and the tokens that spell yes, in increasing order.

    Raises ``UserError`` if one of them or the chat template is missing.
    """
    from transformers import AutoProcessor

    processor = found.read(AutoProcessor)
    if not getattr(processor, "chat_template", None):
        raise found.damaged("it has no chat template")
    vocabulary = sorted(processor.tokenizer.get_vocab().items(), key=lambda item: item[1])
    yes = {piece: number for piece, number in vocabulary if piece.lstrip(WORD_STARTS).lower() == YES}
    if not yes:
        raise found.damaged(f"its tokenizer has no token for {YES}")
    return processor, yes
