"""The words of the grammar, and how a prompt is split into words. Objects are in objects.py."""

import re
import unicodedata
from functools import cache

from cadam3d.prior.shapes.objects import ALIASES, PLAIN, known_objects, known_primitives

# Albedo in [0, 1]. The colours are saturated but never 0 or 1, so that shading and over-saturation stay
# visible.
COLOURS: dict[str, tuple[float, float, float]] = {
    "red": (0.86, 0.12, 0.12),
    "orange": (0.95, 0.50, 0.10),
    "yellow": (0.95, 0.82, 0.14),
    "green": (0.16, 0.62, 0.22),
    "cyan": (0.16, 0.76, 0.80),
    "blue": (0.14, 0.30, 0.84),
    "purple": (0.52, 0.20, 0.72),
    "pink": (0.95, 0.48, 0.68),
    "white": (0.95, 0.95, 0.95),
    "grey": (0.52, 0.53, 0.55),
    "black": (0.10, 0.10, 0.11),
    "brown": (0.46, 0.28, 0.15),
    "beige": (0.90, 0.82, 0.66),
    "cream": (0.96, 0.92, 0.80),
    "gold": (0.85, 0.65, 0.18),
    "silver": (0.75, 0.77, 0.80),
    "turquoise": (0.20, 0.72, 0.66),
    "lime": (0.60, 0.86, 0.20),
    "olive": (0.46, 0.48, 0.16),
    "maroon": (0.46, 0.08, 0.12),
    "navy": (0.08, 0.12, 0.40),
    "violet": (0.48, 0.28, 0.86),
    "magenta": (0.86, 0.16, 0.62),
    "teal": (0.06, 0.46, 0.48),
    "charcoal": (0.22, 0.23, 0.25),
}
COLOUR_ALIASES = {"gray": "grey", "golden": "gold", "tan": "beige", "crimson": "maroon", "aqua": "cyan"}

# The equally likely colours of an object without a given colour; each gives one mode of the mixture.
OPEN_PALETTE = ("red", "orange", "yellow", "green", "cyan", "blue", "purple", "pink")

PATTERNS = {
    "plain": PLAIN,
    "striped": "striped",
    "stripy": "striped",
    "banded": "striped",
    "checkered": "checkered",
    "chequered": "checkered",
    "checked": "checkered",
    "spotted": "spotted",
    "dotted": "spotted",
    "spotty": "spotted",
}

# Factors of the natural size of an object. They are visible only if a scene has several objects.
SIZES = {"tiny": 0.4, "small": 0.65, "little": 0.65, "medium": 1.0, "large": 1.5, "big": 1.5, "huge": 2.2}
# Factors along x, y and z.
STRETCHES = {
    "tall": (1.0, 1.0, 1.5),
    "short": (1.0, 1.0, 0.65),
    "flat": (1.0, 1.0, 0.45),
    "wide": (1.0, 1.5, 1.0),
    "long": (1.5, 1.0, 1.0),
    "thin": (0.65, 0.65, 1.0),
}
NUMBERS = {"one": 1, "two": 2, "three": 3, "four": 4, "five": 5}

# Longest first, since the first match is taken; "of" is a filler.
RELATIONS: tuple[tuple[tuple[str, ...], str], ...] = (
    (("on", "top"), "on"),
    (("in", "front"), "in front of"),
    (("next", "to"), "next to"),
    (("beside",), "next to"),
    (("near",), "next to"),
    (("on",), "on"),
    (("atop",), "on"),
    (("above",), "above"),
    (("over",), "above"),
    (("under",), "under"),
    (("below",), "under"),
    (("beneath",), "under"),
    (("underneath",), "under"),
    (("behind",), "behind"),
    (("between",), "between"),
    (("and",), "next to"),
)
ARTICLES = frozenset({"a", "an", "the", "some"})
# Words that are common in prompts and do not describe the scene, as in "a 3d model of a ...".
FILLERS = frozenset({"photo", "picture", "image", "render", "rendering", "model", "3d", "of"})

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
