"""Lexicon: the words that a trained model knows.

A network that has learned a part of this world lists its words in the file ``vocabulary.json`` of its folder.
A word that it has never seen would become arbitrary numbers, so it is refused.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from cadam3d.core.checks import require
from cadam3d.core.errors import UserError
from cadam3d.prior.shapes.grammar import parse, shown, unknown_words
from cadam3d.prior.shapes.words import typed_words

# Parts of speech in vocabulary.json. Views and qualities describe pictures, not objects.
NEEDED = ("nouns", "colours")
ABOUT_OBJECTS = (*NEEDED, "patterns", "relations")
ABOUT_PICTURES = ("views", "qualities")
# Words that every model knows.
JOINTS = frozenset({"a", "an", "and"})


@dataclass(frozen=True)
class Lexicon:
    """The words of a model by part of speech; an entry may have several words, such as "next to"."""

    reader: str  # the model in messages, such as "prior=shapes_sd"
    file: str  # with the words
    entries: Mapping[str, Sequence[str]]

    @classmethod
    def read(cls, content: Mapping[str, Any], reader: str, file: str) -> "Lexicon":
        """Return the words in the content of ``file``; its other entries are not used.

        Raises ``UserError`` unless they are lists of words.
        """
        entries = {kind: content.get(kind, []) for kind in (*ABOUT_OBJECTS, *ABOUT_PICTURES)}
        for kind, words in entries.items():
            require(
                isinstance(words, list)
                and all(isinstance(word, str) and word for word in words)
                and (kind not in NEEDED or len(words) > 0),
                "prior.path",
                expected=f"a model with a list of {kind} in {file}",
                got=words,
                example="prior.path=DIR",
            )
        return cls(reader, file, entries)

    def require_known(self, key: str, prompt: str) -> None:
        """Raise ``UserError`` if the model has never seen a word of the prompt in the setting ``key``."""
        typed = {word.lower(): word for word in typed_words(prompt)}
        unknown = [word for lower, word in typed.items() if lower not in self._words]
        # A text of signs alone, such as an emoji, says as little as a word that the model has never seen.
        if not typed and prompt.strip() and key == "prompt":
            unknown = [prompt]
        if unknown:
            known = [entry for entries in self.entries.values() for entry in entries]
            usual = self._example if key == "prompt" else ", ".join(self.entries["qualities"])
            raise unknown_words(key, unknown, known, self.reader, self.file, f'{key}="{usual}"')

    def hint(self, prompt: str) -> str | None:
        """Return a note on a prompt that is no sentence of one or two objects; None if it is one.

        The words may have any order, but a network reads best what it has learned.
        """
        about_pictures = _words_in(self.entries, ABOUT_PICTURES) - _words_in(self.entries, ABOUT_OBJECTS)
        words = [word for word in typed_words(prompt) if word.lower() not in about_pictures]
        try:
            others = parse(" ".join(words)).others
        except UserError:
            is_like = False
        else:
            is_like = not any(other.others for other in others)
        if is_like:
            return None
        return (
            f"{self.reader} has learned sentences of one or two objects, such as {self._example!r}, and the "
            f"prompt {shown(prompt)!r} is not like them, so the result may be poor."
        )

    @property
    def _example(self) -> str:
        return f"a {self.entries['colours'][0]} {self.entries['nouns'][0]}"

    @cached_property
    def _words(self) -> frozenset[str]:
        """Return every single word."""
        return _words_in(self.entries, tuple(self.entries)) | JOINTS


def _words_in(entries: Mapping[str, Sequence[str]], kinds: Sequence[str]) -> frozenset[str]:
    return frozenset(word for kind in kinds for entry in entries[kind] for word in entry.split())
