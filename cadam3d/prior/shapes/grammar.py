"""From a prompt to a sentence: noun phrases joined by relations.

sentence = phrase (relation phrase)*          relation = on | under | above | next to | in front of | behind | and
         | phrase "between" phrase "and" phrase
phrase   = (article | number | size | colour | "and" | pattern)* noun
"""

import difflib
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
    """``phrases[i + 1]`` is what ``relations[i]`` relates ``phrases[i]`` to; "between" takes two."""

    phrases: tuple[Phrase, ...]
    relations: tuple[str, ...]


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
    words = [word for word in words if word not in FILLERS or word == "of"]
    reader = _Reader(prompt, words)
    phrases, relations = [reader.phrase()], []
    while not reader.done():
        relation = reader.relation()
        relations.append(relation)
        phrases.append(reader.phrase())
        if relation == "between":
            reader.expect("and")
            phrases.append(reader.phrase())
            relations.append("and of between")
    return Sentence(tuple(phrases), tuple(relations))


def noun_of(word: str) -> str | None:
    """The catalogue name behind a noun, singular or plural; None if it is not a noun."""
    nouns = {*known_primitives(), *known_objects()}
    irregular = {"tori": "torus", "boxes": "box", "torches": "torch", "arches": "arch", "dice": "cube"}
    for form in (irregular.get(word, word), word.removesuffix("s"), word.removesuffix("es")):
        name = ALIASES.get(form, form)
        if name in nouns:
            return name
    return None


def is_plural(word: str) -> bool:
    """Whether a noun is in the plural."""
    return word not in ALIASES and word not in {*known_primitives(), *known_objects()}


class _Reader:
    """A cursor over the words of one prompt."""

    def __init__(self, prompt: str, words: list[str]) -> None:
        self.prompt, self.words, self.position = prompt, words, 0

    def done(self) -> bool:
        return all(word in ARTICLES or word == "of" for word in self.words[self.position :])

    def fail(self, reason: str) -> UserError:
        return UserError(f"prompt {self.prompt!r}: {reason}. {TRY}")

    def peek(self) -> str | None:
        return self.words[self.position] if self.position < len(self.words) else None

    def expect(self, word: str) -> None:
        if self.peek() != word:
            raise self.fail(f"wanted {word!r} after {self.words[self.position - 1]!r}")
        self.position += 1

    def relation(self) -> str:
        for words, name in RELATIONS:
            if tuple(self.words[self.position : self.position + len(words)]) == words:
                self.position += len(words)
                return name
        if self.peek() == "and":
            self.position += 1
            return "next to"
        raise self.fail(f"wanted a relation such as 'on' or 'next to' before {self.peek()!r}")

    def phrase(self) -> Phrase:
        colours: list[str] = []
        pattern, size, stretch, count, shade = None, 1.0, (1.0, 1.0, 1.0), None, None
        while (word := self.peek()) is not None:
            self.position += 1
            colour = COLOUR_ALIASES.get(word, word)
            if (noun := noun_of(word)) is not None:
                break
            if colour in COLOURS:
                colours.append(f"{shade} {colour}" if shade else colour)
                shade = None
            elif word in SHADES:
                shade = word
            elif word in PATTERNS:
                pattern = PATTERNS[word]
            elif word in SIZES:
                size = SIZES[word]
            elif word in STRETCHES:
                stretch = STRETCHES[word]
            elif word in NUMBERS:
                count = NUMBERS[word]
            elif not (word in ARTICLES or word == "of" or (word == "and" and colours)):
                raise self.fail(f"wanted an object before {word!r}")
        else:
            raise self.fail("no object named" if not self.words else "an object is missing at the end")
        if len(colours) > MAX_COLOURS:
            raise self.fail(f"at most {MAX_COLOURS} colours for one object, got {', '.join(colours)}")
        if shade:
            raise self.fail(f"{shade!r} wants a colour after it")
        count = count or (2 if is_plural(word) else 1)
        return Phrase(noun, tuple(colours), pattern, size, stretch, count)


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
    vocabulary = {part for group in known_words().values() for words_ in group for part in words_.split()}
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
        f"prompt {prompt!r}: prior=shapes does not know {', '.join(named)}. It knows\n{listed}\n{FREE_TEXT} {TRY}"
    )
