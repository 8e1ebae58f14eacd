"""Lexicon: the words that a trained model knows, and the nearest prompt that is made of them.

A network that has learned a part of this world lists its words in the file ``vocabulary.json`` of its folder.
A word that it has never seen would become arbitrary numbers, so it is refused. The nearest prompt is found by
the grammar of the whole world first, and then reduced to what the model knows.
"""

import difflib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from cadam3d.core.checks import require
from cadam3d.prior.shapes.grammar import Phrase, parse, shown, unknown_words
from cadam3d.prior.shapes.suggestion import SIMILAR, near_meaning, near_spelling, nearest_prompt
from cadam3d.prior.shapes.vocabulary import (
    ARTICLES,
    COLOUR_ALIASES,
    COLOURS,
    PATTERNS,
    RELATIONS,
    SIMILAR_NOUNS,
)
from cadam3d.prior.shapes.words import is_known, noun_of, typed_words, with_article

# Parts of speech in vocabulary.json. Views and qualities describe pictures, not objects.
NEEDED = ("nouns", "colours")
KINDS = (*NEEDED, "patterns", "relations", "views", "qualities")
ABOUT_PICTURES = ("views", "qualities")
# Words that every model knows.
JOINTS = frozenset({"a", "an", "and"})
# Messages list all words of a model, so a file that has more per part of speech is not a list of such words.
MOST_ENTRIES = 1000
# Signs that no caption has.
PUNCTUATION = re.compile(r"[^\w\s,]|_")


@dataclass(frozen=True)
class Lexicon:
    """The words of a model by part of speech; an entry may have several words, such as "next to"."""

    reader: str  # the model in messages, such as "prior=shapes_sd"
    entries: Mapping[str, Sequence[str]]

    @classmethod
    def read(cls, content: Mapping[str, Any], reader: str, key: str) -> "Lexicon":
        """Return the words in the content of ``vocabulary.json``; other entries of the file are not used.

        Raises ``UserError`` unless they are lists of words. ``key`` is the setting that names the model.
        """
        entries = {kind: content.get(kind, []) for kind in KINDS}
        for kind, words in entries.items():
            is_list = isinstance(words, list) and all(isinstance(word, str) and word for word in words)
            count = len(words) if isinstance(words, list) else 0
            require(
                is_list and (kind not in NEEDED or count > 0) and count <= MOST_ENTRIES,
                key,
                expected=f"a model with a list of at most {MOST_ENTRIES} {kind} in its vocabulary.json",
                got=words if count <= MOST_ENTRIES else f"{count} of them",
                example=f"{key}=DIR",
            )
        return cls(reader, entries)

    def require_known(self, key: str, prompt: str) -> None:
        """Raise ``UserError`` if the model has never seen a word of the prompt in the setting ``key``.

        The message names every unknown word with the nearest known one, and a line that works.
        """
        typed = {word.lower(): word for word in typed_words(prompt)}
        unknown = [word for lower, word in typed.items() if lower not in self._words]
        # A text of signs alone, such as an emoji, says as little as a word that the model has never seen.
        if not typed and prompt.strip() and key == "prompt":
            unknown = [prompt]
        if unknown:
            near = self._negative(prompt) if key == "negative_prompt" else self.nearest(prompt)
            known = {kind: words for kind, words in self.entries.items() if words}
            raise unknown_words(key, prompt, unknown, self.reader, known, self._named, f'{key}="{near}"')

    def hint(self, prompt: str) -> str | None:
        """Return the nearest sentence as it is in the captions of training; None if the prompt is like one.

        The words may have any order, but a network reads best what it has learned.
        """
        about = {word for kind in ABOUT_PICTURES for entry in self.entries[kind] for word in entry.split()}
        words = [word for word in map(str.lower, typed_words(prompt)) if word not in about - self._naming]
        nearest = self.nearest(" ".join(words))
        is_like = _content(typed_words(nearest)) == _content(words) and not PUNCTUATION.search(prompt)
        if is_like:
            return None
        return (
            f"{self.reader} has learned sentences such as {nearest!r}, and the prompt {shown(prompt)!r} is "
            f'not like them. If the result is poor, try prompt="{nearest}".'
        )

    def nearest(self, prompt: str) -> str:
        """Return the nearest sentence of one or two objects, in words of the model."""
        world = nearest_prompt(prompt)
        if world is None:
            return f"a {self.entries['colours'][0]} {self.entries['nouns'][0]}"
        sentence = parse(world)
        relation = self._relation(sentence.relation or "")
        objects = [sentence.phrase, *([sentence.others[0].phrase] if relation else [])]
        return f" {relation} ".join(map(self._phrase, objects))

    @cached_property
    def _words(self) -> frozenset[str]:
        """Return every single word."""
        listed = (word for entries in self.entries.values() for entry in entries for word in entry.split())
        return frozenset(listed) | JOINTS

    @cached_property
    def _naming(self) -> frozenset[str]:
        """Return the single words that describe objects."""
        kinds = [kind for kind in KINDS if kind not in ABOUT_PICTURES]
        return frozenset(word for kind in kinds for entry in self.entries[kind] for word in entry.split())

    def _negative(self, prompt: str) -> str:
        """Return the parts between commas that the model knows, or else the nearest sentence."""
        parts = [part.strip() for part in re.split(r"[,;.\n]", prompt)]
        known = [part for part in parts if (words := typed_words(part.lower())) and self._words >= {*words}]
        plain = [" ".join(typed_words(part)) for part in known]
        if not plain and nearest_prompt(prompt) is not None:
            return self.nearest(prompt)
        return ", ".join(plain)

    def _named(self, word: str) -> str:
        """Return an unknown word with the nearest one that the model knows."""
        near = self._near(word.lower())
        return f"{shown(word)!r}" + (f" (nearest: {near})" if near else "")

    def _near(self, word: str) -> str | None:
        meaning = word if is_known(word) else near_meaning(word)
        if meaning is not None:
            return self._reduced(meaning)
        similar = difflib.get_close_matches(word, sorted(self._words), n=1, cutoff=SIMILAR)
        return similar[0] if similar else next(filter(None, map(self._reduced, near_spelling(word))), None)

    def _reduced(self, known: str) -> str | None:
        """Return the nearest word of the model for a word or a relation of the world; None without one."""
        if (noun := noun_of(known)) is not None:
            return self._noun(noun)
        if (colour := COLOUR_ALIASES.get(known, known)) in COLOURS:
            return self._colour(colour)
        if known in ARTICLES:
            return "a"
        relation = next(
            (name for words, name in RELATIONS if words[: len(known.split())] == (*known.split(),)), ""
        )
        pattern = PATTERNS.get(known, "")
        return self._relation(relation) or (pattern if pattern in self.entries["patterns"] else None)

    def _noun(self, name: str) -> str:
        """Return an object of the world if the model knows it, or else one of similar shape."""
        nouns = self.entries["nouns"]
        return next((each for each in (name, *SIMILAR_NOUNS[name].split()) if each in nouns), nouns[0])

    def _colour(self, name: str) -> str:
        """Return the colour of the model that is nearest in RGB; shades such as "dark" are left out."""
        wanted = COLOURS[name.rpartition(" ")[2]]
        known = [colour for colour in self.entries["colours"] if colour in COLOURS]

        def distance(colour: str) -> float:
            return sum((a - b) ** 2 for a, b in zip(COLOURS[colour], wanted, strict=True))

        return min(known, key=distance, default=self.entries["colours"][0])

    def _relation(self, name: str) -> str:
        """Return a relation of the model: the same, or "on" for "above", or "next to"; "" without one."""
        candidates = (name, "on" if name == "above" else "next to", "next to") if name else ()
        return next((each for each in candidates if each in self.entries["relations"]), "")

    def _phrase(self, phrase: Phrase) -> str:
        """Return a phrase in words of the model, without sizes and numbers."""
        colours = dict.fromkeys(map(self._colour, phrase.colours))
        pattern = phrase.pattern if phrase.pattern in self.entries["patterns"] else None
        words = filter(None, (" and ".join(colours), pattern, self._noun(phrase.noun)))
        return with_article(" ".join(words))


def _content(words: Sequence[str]) -> list[str]:
    """Return the words in lower case without articles."""
    return [word for word in map(str.lower, words) if word not in ARTICLES]
