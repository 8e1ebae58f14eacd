"""The words that the models know: a tokenizer in CLIP's format, and what captions say about views."""

import itertools
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from prior_training.views import Groups
from prior_training.world import COLOURS, HELD_OUT_EVERY, NOUNS, PATTERNS, RELATIONS, is_held_out
from torch import Tensor

from cadam3d.core.cameras import orbit
from cadam3d.prior.prompting import HEIGHTS, SIDES, SUFFIXES, Compass, Discrete, Prompting

LENGTH = 32  # tokens
# The words of the negative prompts of the published recipes. Such a list stands for the empty caption.
QUALITIES = (
    "ugly",
    "blurry",
    "deformed",
    "low quality",
    "low resolution",
    "oversaturated",
    "cropped",
    "watermark",
)
START, END = "<|startoftext|>", "<|endoftext|>"
# The share of captions that are left out, so that the model learns the empty prompt (Ho and Salimans 2022).
EMPTY = 0.1
# The share of empty captions that name qualities.
NAMED_QUALITIES = 0.5


@dataclass(frozen=True)
class Wording:
    """The shares of captions with the words of prompting=compass, of discrete, and without any."""

    compass: float
    discrete: float


SINGLE = Wording(compass=0.5, discrete=0.35)
# These models read the cameras.
MULTIVIEW = Wording(compass=0.1, discrete=0.1)


def words() -> list[str]:
    """Return every word of the captions, each once."""
    phrases = (*NOUNS, *COLOURS, *PATTERNS, *RELATIONS, *SUFFIXES, *SIDES, *HEIGHTS, *QUALITIES, "a an and ,")
    return list(dict.fromkeys(word for phrase in phrases for word in phrase.replace(",", " , ").split()))


def vocabulary() -> dict[str, Any]:
    """Return what ``vocabulary.json`` says of a model: its words by part of speech."""
    return {
        "nouns": NOUNS,
        "colours": COLOURS,
        "patterns": PATTERNS,
        "relations": RELATIONS,
        "views": list(dict.fromkeys(" ".join((*SUFFIXES, *SIDES, *HEIGHTS)).replace(",", "").split())),
        "qualities": QUALITIES,
        "held_out": [[c, n] for n in NOUNS for c in COLOURS if is_held_out(c, n)],
        "held_out_every": HELD_OUT_EVERY,
    }


def tokenizer(folder: Path) -> Any:
    """Return a CLIP tokenizer in ``folder`` that makes one token of every word of the captions.

    Its byte pairs are merged in the order in which the words are listed. Merges for a later word have a lower
    priority, so they cannot change how an earlier word is split.
    """
    from tokenizers.pre_tokenizers import ByteLevel
    from transformers import CLIPTokenizer

    merges: dict[tuple[str, str], int] = {}
    for word in words():
        pieces = _split(word, merges)
        while len(pieces) > 1:
            merges[pieces[0], pieces[1]] = len(merges)
            pieces = _split(word, merges)
    letters = sorted(ByteLevel.alphabet())
    tokens = [*letters, *(f"{letter}</w>" for letter in letters), *("".join(pair) for pair in merges)]
    numbers = {token: i for i, token in enumerate([*dict.fromkeys(tokens), START, END])}
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "vocab.json").write_text(json.dumps(numbers), encoding="utf-8")
    lines = "".join(f"{left} {right}\n" for left, right in merges)
    (folder / "merges.txt").write_text(f"#version: 0.2\n{lines}", encoding="utf-8")
    return CLIPTokenizer.from_pretrained(folder, model_max_length=LENGTH)


def _split(word: str, merges: dict[tuple[str, str], int]) -> list[str]:
    """Return the pieces of a word after all merges, the ones that were added first being applied first."""
    pieces = [*word[:-1], f"{word[-1]}</w>"]
    while True:
        pairs = [pair for pair in itertools.pairwise(pieces) if pair in merges]
        if not pairs:
            return pieces
        first = min(pairs, key=merges.__getitem__)
        joined: list[str] = []
        for piece in pieces:
            if joined and (joined[-1], piece) == first:
                joined[-1] += piece
            else:
                joined.append(piece)
        pieces = joined


class Captions:
    """The texts of views, with their words for the side and the height."""

    def __init__(self, views: Groups, wording: Wording, tokenizer: Any) -> None:
        self.captions, self.wording = views.captions, wording
        azimuth, elevation = views.azimuth_deg.flatten(), views.elevation_deg.flatten()
        self.suffixes = [
            _suffixes(prompting, azimuth, elevation)
            for prompting in (
                Compass(below_deg=-5.0, above_deg=35.0),
                Discrete(front_deg=45.0, back_deg=45.0, overhead_deg=60.0),
            )
        ]
        self.tokenizer = tokenizer
        self.known: dict[str, Tensor] = {}

    def texts(self, views: Tensor, together: int, generator: torch.Generator) -> list[str]:
        """Return one text per view, of which some are empty.

        ``views`` counts all views of all groups. Views that are denoised ``together`` are worded alike.
        """
        shares = torch.rand(len(views) // together, 3, generator=generator).tolist()
        return [self._text(view, *shares[i // together]) for i, view in enumerate(views.tolist())]

    def right(self, views: Tensor) -> list[str]:
        """Return the text of each view: with the words of prompting=compass, if they are the usual ones."""
        words = self.suffixes[0] if self.wording.compass >= 0.5 else [""] * len(self.suffixes[0])
        return [self.captions[view // 4] + words[view] for view in views.tolist()]

    def numbers(self, texts: list[str]) -> Tensor:
        """Return the tokens of texts, "n 32"."""
        for text in {*texts} - self.known.keys():
            read = self.tokenizer(text, padding="max_length", truncation=True, return_tensors="pt")
            self.known[text] = read.input_ids[0]
        return torch.stack([self.known[text] for text in texts])

    def _text(self, view: int, kept: float, named: float, wording: float) -> str:
        if kept < EMPTY:
            count = int(named / NAMED_QUALITIES * (len(QUALITIES) + 1))
            return ", ".join(QUALITIES[:count]) if named < NAMED_QUALITIES else ""
        caption = self.captions[view // 4]
        if wording < self.wording.compass:
            return caption + self.suffixes[0][view]
        if wording < self.wording.compass + self.wording.discrete:
            return caption + self.suffixes[1][view]
        return caption


def _suffixes(prompting: Prompting, azimuth_deg: Tensor, elevation_deg: Tensor) -> list[str]:
    """Return what a prompting adds to the prompt for each view."""
    one = torch.ones_like(azimuth_deg)
    which = prompting.mix(orbit(azimuth_deg, elevation_deg, 3 * one, 45 * one, 8, 8)).positive.argmax(1)
    texts = prompting.texts("")
    return [texts[i] for i in which.tolist()]
