"""Embedded texts: how the text encoders make them, and their cache on the disk."""

import hashlib
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.checks import require
from cadam3d.core.errors import UserError
from cadam3d.io.atomic import replacing
from cadam3d.io.pretrained import Pretrained

# Tokens per text, of CLIP and of T5.
TOKENS, T5_TOKENS = 77, 256
MOST_TOKENS = 10_000  # per text, of any tokenizer


@dataclass(frozen=True)
class Texts:
    """Embedded texts, one per row."""

    tokens: Float[Tensor, "k n d"]
    pooled: Float[Tensor, "k p"] | None  # one vector per text, for networks that read it

    def mixed(self, weights: Float[Tensor, "b k"]) -> "Texts":
        """Return weighted sums of the rows, one for each row of ``weights``."""
        tokens = torch.einsum("bk,knd->bnd", weights.to(self.tokens), self.tokens)
        return Texts(tokens, None if self.pooled is None else weights.to(self.pooled) @ self.pooled)

    def rows(self) -> "list[Texts]":
        """Return each text alone."""
        pooled = [None] * len(self.tokens) if self.pooled is None else self.pooled.split(1)
        return [Texts(*row) for row in zip(self.tokens.split(1), pooled, strict=True)]

    def to(self, device: torch.device) -> "Texts":
        """Return the same rows on ``device``."""
        return Texts(self.tokens.to(device), None if self.pooled is None else self.pooled.to(device))


@dataclass(frozen=True)
class TextCache:
    """Embedded texts in a folder, one file each."""

    folder: Path
    identity: tuple[str, ...]  # everything that an embedded text depends on, except the text

    def embedded(self, texts: Sequence[str], embed: Callable[[Sequence[str]], Texts]) -> Texts:
        """Return the rows of ``texts``, in order, on the CPU, after ``embed`` made those without a file."""
        rows = {text: self._read(text) for text in texts}
        missing = [text for text, row in rows.items() if row is None]
        if missing:
            made = embed(missing).to(torch.device("cpu")).rows()
            rows |= zip(missing, made, strict=True)
            for text, row in zip(missing, made, strict=True):
                self._write(text, row)
        chosen = [row for text in texts if (row := rows[text]) is not None]
        pooled = [row.pooled for row in chosen if row.pooled is not None]
        return Texts(torch.cat([row.tokens for row in chosen]), torch.cat(pooled) if pooled else None)

    def has(self, text: str) -> bool:
        """Return whether there is a file for ``text``."""
        return self._file(text).is_file()

    def _read(self, text: str) -> Texts | None:
        from safetensors import SafetensorError
        from safetensors.torch import load_file

        if not self.has(text):
            return None
        try:
            kept = load_file(self._file(text))
            return Texts(kept["tokens"], kept.get("pooled"))
        except (OSError, KeyError, SafetensorError):
            return None  # truncated by a crash

    def _write(self, text: str, row: Texts) -> None:
        from safetensors.torch import save_file

        kept = {"tokens": row.tokens} | ({} if row.pooled is None else {"pooled": row.pooled})
        # A cache that cannot be written only costs time.
        with suppress(UserError), replacing(self._file(text)) as temporary:
            save_file({name: value.contiguous() for name, value in kept.items()}, temporary)

    def _file(self, text: str) -> Path:
        digest = hashlib.sha256(repr((*self.identity, text)).encode()).hexdigest()
        return self.folder / f"{digest[:32]}.safetensors"


def tokenize(tokenizer: Any, texts: Sequence[str], length: int | None = None) -> Tensor:
    """Return token numbers, cut or padded to ``length`` (None = the length that the tokenizer defines)."""
    longest = length or tokenizer.model_max_length
    require(
        type(longest) is int and 0 < longest <= MOST_TOKENS,
        "prior.path",
        expected=f"a tokenizer with a model_max_length of at most {MOST_TOKENS}",
        got=longest,
        example="prior.path=DIR",
    )
    return tokenizer(
        list(texts),
        padding="max_length",
        max_length=longest,
        truncation=True,
        return_tensors="pt",
    ).input_ids


@torch.no_grad()
def penultimate(
    found: Pretrained, encoder: str, texts: Sequence[str], dtype: torch.dtype, device: torch.device
) -> Texts:
    """Return CLIP's hidden states before the last layer, and its projected text if it has a projection.

    ``encoder`` is a part such as ``"text_encoder_2"``; its tokenizer is the part with the same number. Both
    are loaded, used and freed. The larger models read CLIP in this way.
    """
    numbers = tokenize(found.part(encoder.replace("text_encoder", "tokenizer")), texts).to(device)
    network = found.part(encoder, dtype).to(device)
    output = network(numbers, output_hidden_states=True)
    return Texts(output.hidden_states[-2], getattr(output, "text_embeds", None))
