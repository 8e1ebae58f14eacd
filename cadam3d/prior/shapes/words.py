"""Words: split a prompt into words, and look up which of them the grammar knows."""

import re
import unicodedata
from functools import cache

from cadam3d.prior.shapes.objects import ALIASES, known_objects, known_primitives
from cadam3d.prior.shapes.vocabulary import (
    ARTICLES,
    COLOUR_ALIASES,
    COLOURS,
    FILLERS,
    NUMBERS,
    PATTERNS,
    RELATIONS,
    SIZES,
    STRETCHES,
)

SHADES = ("dark", "light")
# The words that may describe a noun.
ADJECTIVES = frozenset({*COLOURS, *COLOUR_ALIASES, *SHADES, *PATTERNS, *SIZES, *STRETCHES, *NUMBERS})
# Nouns that are often written as two words.
COMPOUNDS = {
    ("light", "house"): "lighthouse",
    ("ice", "cream"): "icecream",
    ("pine", "tree"): "pine",
    ("fir", "tree"): "pine",
    ("wind", "mill"): "windmill",
    ("snow", "man"): "snowman",
    ("sail", "boat"): "boat",
}
IRREGULAR_PLURALS = {"tori": "torus", "boxes": "box", "arches": "arch"}
WORD = re.compile(r"[^\W_]+(?:'s\b)?", re.IGNORECASE)


def typed_words(prompt: str) -> list[str]:
    """Return the words of a prompt as they were typed.

    A word is made of letters and digits of any script, and may end in an apostrophe and an s.
    """
    return WORD.findall(unicodedata.normalize("NFC", prompt))


def words_of(prompt: str) -> list[str]:
    """Return the words of a prompt in lower case, with compounds such as "ice cream" joined."""
    joined: list[str] = []
    for word in map(str.lower, typed_words(prompt)):
        if joined and (joined[-1], word) in COMPOUNDS:
            joined[-1] = COMPOUNDS[joined[-1], word]
        else:
            joined.append(word)
    return joined


def known_words() -> dict[str, tuple[str, ...]]:
    """Return all words that the grammar knows, by part of speech."""
    return {
        "primitives": known_primitives(),
        "objects": known_objects(),
        "other names": tuple(ALIASES),
        "colours": (*COLOURS, *COLOUR_ALIASES, *SHADES),
        "patterns": tuple(PATTERNS),
        "sizes": (*SIZES, *STRETCHES),
        "numbers": tuple(NUMBERS),
        "relations": tuple(dict.fromkeys(" ".join(words) for words, _ in RELATIONS)),
    }


def is_known(word: str) -> bool:
    """Return whether the grammar knows a word, as whatever part of speech."""
    return word in vocabulary() or noun_of(word) is not None


@cache
def vocabulary() -> frozenset[str]:
    """Return every known word, also the parts of relations such as "next to"; of nouns only the singular."""
    words = {part for group in known_words().values() for entry in group for part in entry.split()}
    return frozenset(words | ARTICLES | FILLERS | {"and"})


def noun_of(word: str) -> str | None:
    """Return the name of the object that a noun, singular or plural, denotes; None for other words."""
    for form in (IRREGULAR_PLURALS.get(word, word), word.removesuffix("s"), word.removesuffix("es")):
        name = ALIASES.get(form, form)
        if name in _nouns():
            return name
    return None


def is_plural(word: str) -> bool:
    """Return whether a noun is in the plural."""
    return word not in ALIASES and word not in _nouns()


@cache
def _nouns() -> frozenset[str]:
    return frozenset({*known_primitives(), *known_objects()})
