"""Parser of prompts: noun phrases joined by relations, which group as in English.

sentence = phrase | sentence relation sentence | sentence "between" phrase "and" sentence
relation = "on" | "under" | "above" | "next to" | "in front of" | "behind" | "and", which means next to
phrase   = (article | number | size | colour | "and" | pattern)* noun

What is on, under or above an object belongs to it most closely, then what is in front of it or behind it,
then what is beside it. So "a cone on a cube next to a ball in front of a pyramid" is (a cone on a cube) next
to (a ball in front of a pyramid). Equally close relations group to the right.
"""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass

from cadam3d.core.checks import fail, nearest
from cadam3d.core.errors import UserError
from cadam3d.prior.shapes.words import (
    ADJECTIVES,
    ARTICLES,
    COLOUR_ALIASES,
    COLOURS,
    FILLERS,
    NUMBERS,
    PATTERNS,
    RELATIONS,
    SHADES,
    SIZES,
    STRETCHES,
    is_plural,
    known_words,
    noun_of,
    vocabulary,
    words_of,
)

MOST_NAMED = 20  # unknown words in one message
EXAMPLE = "a red and yellow checkered torus"
MAX_COLOURS = 2
MAX_OBJECTS = 200  # of one prompt; sentences nest, and Python limits how deeply
# How closely a relation binds; those beside one another bind least.
CLOSENESS = {"on": 2, "under": 2, "above": 2, "in front of": 1, "behind": 1, "next to": 0, "between": 0}
SIMILAR = 0.78  # of difflib's ratio, in [0, 1]; one letter of five may differ, but not one of four


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
    """A phrase or a group, and its relation to the rest of the sentence: "a cube on (a ball on a table)"."""

    phrase: "Phrase | Sentence"
    relation: str | None = None
    others: tuple["Sentence", ...] = ()  # two for "between", one for other relations


def parse(prompt: str, key: str = "prompt") -> Sentence:
    """Parse the prompt that the setting ``key`` holds.

    Raises ``UserError`` that names the unknown words, each with the nearest known one, or the missing part of
    the sentence.
    """
    words = words_of(prompt)
    unknown = [word for word in words if word not in vocabulary() and noun_of(word) is None]
    known = [word for group in known_words().values() for word in group]
    require_words(key, unknown, known, "prior=shapes (docs/exact.md)", EXAMPLE)
    reader = _Reader(key, prompt, [word for word in words if word not in FILLERS | ARTICLES])
    if sum(noun_of(word) is not None for word in words) > MAX_OBJECTS:
        raise reader.fail(f"at most {MAX_OBJECTS} objects")
    return reader.sentence()


class _Reader:
    """A cursor over the words of one prompt, without articles and fillers."""

    def __init__(self, key: str, prompt: str, words: list[str]) -> None:
        self.key, self.prompt, self.words, self.position = key, prompt, words, 0

    def sentence(self, closeness: int = 0) -> Sentence:
        """Read as far as the relations have at least this closeness."""
        found = Sentence(self.phrase())
        while (relation := self.relation(closeness)) is not None:
            others: list[Sentence] = []
            if relation == "between":
                others.append(Sentence(self.phrase()))
                if not self.take("and"):
                    raise self.fail("two objects joined by 'and' after 'between'")
            others.append(self.sentence(CLOSENESS[relation]))
            found = Sentence(found if found.relation else found.phrase, relation, tuple(others))
        return found

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
        for word in described:
            if word not in ADJECTIVES and word != "and":
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

    def relation(self, closeness: int) -> str | None:
        """Step over the relation at the cursor and return its name; None if none is as close."""
        before = self.position
        for words, name in RELATIONS:
            if self.take(*words):
                if CLOSENESS[name] >= closeness:
                    return name
                self.position = before
                return None
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


def require_words(
    key: str, unknown: Sequence[str], known: Collection[str], reader: str, example: str
) -> None:
    """Raise ``UserError`` with the known words of the nearest spelling if there are ``unknown`` words.

    ``reader`` is what reads the prompt in the setting ``key``, and ``example`` is another prompt.
    """
    if not unknown:
        return
    # Sorted, since the order of a set differs between processes and decides between equally near words.
    words = sorted(known)
    names = []
    for word in [*dict.fromkeys(unknown)][:MOST_NAMED]:
        near = nearest(word, words, least=SIMILAR)
        names.append(f"{word!r} (nearest: {near})" if near else repr(word))
    raise UserError(f'{key}: expected words of {reader}, got {", ".join(names)}. Try: {key}="{example}"')
