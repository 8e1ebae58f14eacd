"""Parser of prompts: noun phrases joined by relations, read from left to right.

sentence = phrase | phrase relation sentence | phrase "between" phrase "and" sentence
relation = "on" | "under" | "above" | "next to" | "in front of" | "behind" | "and", which means next to
phrase   = (article | number | size | colour | "and" | pattern)* noun
"""

import difflib
import math
import re
from contextlib import suppress
from dataclasses import dataclass

from cadam3d.core.checks import fail
from cadam3d.core.errors import UserError
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

EXAMPLE = "a red and yellow checkered torus"
FREE_TEXT = "Other priors read free text; `cadam3d doctor` lists those that are ready to use here."
MAX_COLOURS = 2
SHADES = ("dark", "light")


@dataclass(frozen=True)
class Phrase:
    """One object, or a row of equal objects."""

    noun: str
    colours: tuple[str, ...] = ()  # at most two; "dark green" and "light blue" are colours
    pattern: str | None = None
    size: float = 1.0
    stretch: tuple[float, float, float] = (1.0, 1.0, 1.0)
    count: int = 1


@dataclass(frozen=True)
class Sentence:
    """A phrase and its relation to the rest of the sentence: "a cube on (a ball on a table)"."""

    phrase: Phrase
    relation: str | None = None
    others: tuple["Sentence", ...] = ()  # two for "between", one for other relations


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


def parse(prompt: str, key: str = "prompt") -> Sentence:
    """Parse the prompt that the setting ``key`` holds.

    Raises ``UserError`` that names every unknown word, with the nearest known words, or the missing part of
    the sentence.
    """
    words = _join_compounds(re.findall(r"[a-z0-9]+", prompt.lower()))
    _reject_unknown(key, prompt, words)
    return _Reader(key, prompt, [word for word in words if word not in FILLERS | ARTICLES]).sentence()


def noun_of(word: str) -> str | None:
    """Return the name of the object that a noun, singular or plural, denotes; None for other words."""
    nouns = {*known_primitives(), *known_objects()}
    irregular = {"tori": "torus", "boxes": "box", "arches": "arch"}
    for form in (irregular.get(word, word), word.removesuffix("s"), word.removesuffix("es")):
        name = ALIASES.get(form, form)
        if name in nouns:
            return name
    return None


def is_plural(word: str) -> bool:
    """Return whether a noun is in the plural."""
    return word not in ALIASES and word not in {*known_primitives(), *known_objects()}


class _Reader:
    """A cursor over the words of one prompt, without articles and fillers."""

    def __init__(self, key: str, prompt: str, words: list[str]) -> None:
        self.key, self.prompt, self.words, self.position = key, prompt, words, 0

    def sentence(self) -> Sentence:
        phrase = self.phrase()
        relation = self.relation()
        if relation is None:
            return Sentence(phrase)
        if relation != "between":
            return Sentence(phrase, relation, (self.sentence(),))
        first = Sentence(self.phrase())
        if not self.take("and"):
            raise self.fail("two objects joined by 'and' after 'between'")
        return Sentence(phrase, relation, (first, self.sentence()))

    def phrase(self) -> Phrase:
        start = self.position
        while (word := self.peek()) is not None and noun_of(word) is None:
            self.position += 1
        if word is None:
            raise self.fail("an object at the end" if self.words else "an object")
        self.position += 1
        described = self.words[start : self.position - 1]
        return Phrase(
            noun=noun_of(word) or word,
            colours=self.colours(described),
            pattern=next((PATTERNS[near] for near in described if near in PATTERNS), None),
            size=math.prod(SIZES.get(near, 1.0) for near in described),
            stretch=next((STRETCHES[near] for near in described if near in STRETCHES), (1.0, 1.0, 1.0)),
            count=next((NUMBERS[near] for near in described if near in NUMBERS), 2 if is_plural(word) else 1),
        )

    def colours(self, described: list[str]) -> tuple[str, ...]:
        """Return the colours among the words before a noun. Raises ``UserError`` for misplaced words."""
        adjectives = {*COLOURS, *COLOUR_ALIASES, *SHADES, *PATTERNS, *SIZES, *STRETCHES, *NUMBERS, "and"}
        for word in described:
            if word not in adjectives:
                raise self.fail(f"an object before {word!r}")
        colours = []
        for before, word in zip(["", *described], [*described, "end"], strict=True):
            colour = COLOUR_ALIASES.get(word, word)
            if colour in COLOURS:
                colours.append(f"{before} {colour}" if before in SHADES else colour)
            elif before in SHADES:
                raise self.fail(f"a colour after {before!r}")
        if len(colours) > MAX_COLOURS:
            raise self.fail(f"at most {MAX_COLOURS} colours for one object")
        return tuple(colours)

    def relation(self) -> str | None:
        """Step over the relation at the cursor and return its name, or None at the end of the prompt."""
        for words, name in RELATIONS:
            if self.take(*words):
                return name
        if self.peek() is not None:
            raise self.fail(f"a relation such as 'on' or 'next to' before {self.peek()!r}")
        return None

    def take(self, *words: str) -> bool:
        """Step over ``words`` if they come next, and return whether they do."""
        is_next = tuple(self.words[self.position : self.position + len(words)]) == words
        self.position += len(words) * is_next
        return is_next

    def peek(self) -> str | None:
        return self.words[self.position] if self.position < len(self.words) else None

    def fail(self, expected: str) -> UserError:
        return fail(self.key, expected=expected, got=self.prompt, example=f'{self.key}="{EXAMPLE}"')


def _join_compounds(words: list[str]) -> list[str]:
    """Join nouns that are often written as two words, such as "light house" or "ice cream"."""
    pairs = {
        ("light", "house"): "lighthouse",
        ("ice", "cream"): "icecream",
        ("pine", "tree"): "pine",
        ("fir", "tree"): "pine",
        ("wind", "mill"): "windmill",
        ("snow", "man"): "snowman",
        ("sail", "boat"): "boat",
    }
    joined: list[str] = []
    for word in words:
        if joined and (joined[-1], word) in pairs:
            joined[-1] = pairs[joined[-1], word]
        else:
            joined.append(word)
    return joined


def _reject_unknown(key: str, prompt: str, words: list[str]) -> None:
    vocabulary = {part for group in known_words().values() for entry in group for part in entry.split()}
    vocabulary |= ARTICLES | FILLERS | {"and"}
    unknown = [word for word in dict.fromkeys(words) if word not in vocabulary and noun_of(word) is None]
    if not unknown:
        return
    # Sorted, since the order of a set differs between processes and decides between equally near words.
    candidates = sorted(vocabulary - ARTICLES)
    near = {word: difflib.get_close_matches(word, candidates, n=2, cutoff=0.7) for word in unknown}
    named = ", ".join(
        f"{word!r}" + (f" (did you mean {' or '.join(known)}?)" if known else "")
        for word, known in near.items()
    )
    listed = "\n".join(f"  {group}: {', '.join(known)}" for group, known in known_words().items())
    raise UserError(
        f"{key}: expected words that prior=shapes knows, got {prompt!r}. Unknown: {named}. Known words:\n"
        f'{listed}\n{FREE_TEXT} Try: {key}="{_corrected(words, near) or EXAMPLE}"'
    )


def _corrected(words: list[str], near: dict[str, list[str]]) -> str | None:
    """Return the prompt with every unknown word replaced by its nearest known word, if that can be parsed."""
    if not all(near.values()):
        return None
    prompt = " ".join(near[word][0] if word in near else word for word in words)
    with suppress(UserError):
        parse(prompt)
        return prompt
    return None
