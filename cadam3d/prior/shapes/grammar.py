"""From a prompt to a sentence: noun phrases joined by relations, read from the left.

sentence = phrase | phrase relation sentence | phrase "between" phrase "and" sentence
relation = "on" | "under" | "above" | "next to" | "in front of" | "behind" | "and", which means next to
phrase   = (article | number | size | colour | "and" | pattern)* noun
"""

import difflib
import math
import re
from dataclasses import dataclass

from cadam3d.core.checks import UserError
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

TRY = 'Try: prompt="a red and yellow checkered torus"'
FREE_TEXT = "Other words need a prior that reads free text: `cadam3d doctor` shows which ones are ready here."
MAX_COLOURS = 2
SHADES = ("dark", "light")


@dataclass(frozen=True)
class Phrase:
    """One object, or a row of equal ones."""

    noun: str
    colours: tuple[str, ...] = ()  # at most two; "dark green" and "light blue" are colours
    pattern: str | None = None
    size: float = 1.0
    stretch: tuple[float, float, float] = (1.0, 1.0, 1.0)
    count: int = 1


@dataclass(frozen=True)
class Sentence:
    """A phrase, and how it stands to what follows: "a cube on (a ball on a table)"."""

    phrase: Phrase
    relation: str | None = None
    others: tuple["Sentence", ...] = ()  # two for "between", none without a relation, else one


def known_words() -> dict[str, tuple[str, ...]]:
    """Everything the grammar knows, by part of speech."""
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


def parse(prompt: str) -> Sentence:
    """Read a prompt.

    Raises ``UserError`` that names every unknown word, with the nearest known ones, or says what is missing.
    """
    words = _join_compounds(re.findall(r"[a-z0-9]+", prompt.lower()))
    _reject_unknown(prompt, words)
    return _Reader(prompt, [word for word in words if word not in FILLERS | ARTICLES]).sentence()


def noun_of(word: str) -> str | None:
    """The catalogue name behind a noun, singular or plural; None if it is not a noun."""
    nouns = {*known_primitives(), *known_objects()}
    irregular = {"tori": "torus", "boxes": "box", "arches": "arch"}
    for form in (irregular.get(word, word), word.removesuffix("s"), word.removesuffix("es")):
        name = ALIASES.get(form, form)
        if name in nouns:
            return name
    return None


def is_plural(word: str) -> bool:
    """Whether a noun is in the plural."""
    return word not in ALIASES and word not in {*known_primitives(), *known_objects()}


class _Reader:
    """A cursor over the words of one prompt, articles and fillers left out."""

    def __init__(self, prompt: str, words: list[str]) -> None:
        self.prompt, self.words, self.position = prompt, words, 0

    def sentence(self) -> Sentence:
        phrase = self.phrase()
        relation = self.relation()
        if relation is None:
            return Sentence(phrase)
        if relation != "between":
            return Sentence(phrase, relation, (self.sentence(),))
        first = Sentence(self.phrase())
        if not self.take("and"):
            raise self.fail("'between' wants two objects joined by 'and'")
        return Sentence(phrase, relation, (first, self.sentence()))

    def phrase(self) -> Phrase:
        start = self.position
        while (word := self.peek()) is not None and noun_of(word) is None:
            self.position += 1
        if word is None:
            raise self.fail("an object is missing" + (" at the end" if self.words else ""))
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
        """The colours among the words before a noun; refuses words that cannot stand there."""
        adjectives = {*COLOURS, *COLOUR_ALIASES, *SHADES, *PATTERNS, *SIZES, *STRETCHES, *NUMBERS, "and"}
        for word in described:
            if word not in adjectives:
                raise self.fail(f"an object is missing before {word!r}")
        colours = []
        for before, word in zip(["", *described], [*described, "end"], strict=True):
            colour = COLOUR_ALIASES.get(word, word)
            if colour in COLOURS:
                colours.append(f"{before} {colour}" if before in SHADES else colour)
            elif before in SHADES:
                raise self.fail(f"{before!r} wants a colour after it")
        if len(colours) > MAX_COLOURS:
            raise self.fail(f"at most {MAX_COLOURS} colours for one object, got {', '.join(colours)}")
        return tuple(colours)

    def relation(self) -> str | None:
        """Step over the relation at the cursor; None at the end."""
        for words, name in RELATIONS:
            if self.take(*words):
                return name
        if self.peek() is not None:
            raise self.fail(f"expected a relation such as 'on' or 'next to' before {self.peek()!r}")
        return None

    def take(self, *words: str) -> bool:
        """Step over ``words`` if they come next."""
        is_next = tuple(self.words[self.position : self.position + len(words)]) == words
        self.position += len(words) * is_next
        return is_next

    def peek(self) -> str | None:
        return self.words[self.position] if self.position < len(self.words) else None

    def fail(self, reason: str) -> UserError:
        return UserError(f"prompt {self.prompt!r}: {reason}. {TRY}")


def _join_compounds(words: list[str]) -> list[str]:
    """Nouns that people write in two words: "light house", "ice cream", "pine tree"."""
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


def _reject_unknown(prompt: str, words: list[str]) -> None:
    vocabulary = {part for group in known_words().values() for entry in group for part in entry.split()}
    vocabulary |= ARTICLES | FILLERS | {"and"}
    unknown = [word for word in dict.fromkeys(words) if word not in vocabulary and noun_of(word) is None]
    if not unknown:
        return
    named = []
    for word in unknown:
        near = difflib.get_close_matches(word, vocabulary - ARTICLES, n=2, cutoff=0.7)
        named.append(f"{word!r}" + (f" (did you mean {' or '.join(near)}?)" if near else ""))
    listed = "\n".join(f"  {group}: {', '.join(known)}" for group, known in known_words().items())
    raise UserError(
        f"prompt {prompt!r}: prior=shapes does not know {', '.join(named)}. It knows\n{listed}\n"
        f"{FREE_TEXT} {TRY}"
    )
