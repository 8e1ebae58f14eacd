"""Lexicon: the words that a trained model knows.

A network that has learned a part of this world lists its words in the file ``vocabulary.json`` of its folder.
A word that it has never seen would become arbitrary numbers, so it is refused.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pydantic import TypeAdapter, ValidationError

from cadam3d.core.checks import fail
from cadam3d.prior.shapes.grammar import require_words
from cadam3d.prior.shapes.words import typed_words

# Parts of speech in vocabulary.json.
KINDS = ("nouns", "colours", "patterns", "relations", "views", "qualities")
# Words that every model knows.
JOINTS = frozenset({"a", "an", "and"})


@dataclass(frozen=True)
class Lexicon:
    """The words of a model by part of speech; an entry may have several words, such as "next to"."""

    reader: str  # the model in messages, such as "prior=shapes_sd"
    entries: Mapping[str, Sequence[str]]
    example: str  # a prompt

    @classmethod
    def read(cls, content: Mapping[str, Any], reader: str, file: str) -> "Lexicon":
        """Return the words in the content of ``file``; its other entries are not used.

        Raises ``UserError`` unless they are lists of words.
        """
        try:
            entries = TypeAdapter(dict[str, list[str]]).validate_python(
                {kind: content.get(kind, []) for kind in KINDS}, strict=True
            )
            return cls(reader, entries, f"a {entries['colours'][0]} {entries['nouns'][0]}")
        except (ValidationError, IndexError) as error:
            expected = f"a model with nouns and colours in {file}"
            raise fail("prior.path", expected=expected, got=content, example="prior.path=DIR") from error

    def require_known(self, key: str, prompt: str) -> None:
        """Raise ``UserError`` if the model has never seen a word of the prompt in the setting ``key``."""
        known = [entry for entries in self.entries.values() for entry in entries]
        words = {*JOINTS, *(word for entry in known for word in entry.split())}
        typed = [word.lower() for word in typed_words(prompt)]
        # A text of signs alone, such as an emoji, says as little as a word that the model has never seen.
        unknown = [word for word in typed if word not in words] if typed else [prompt] * bool(prompt.strip())
        example = self.example if key == "prompt" else ", ".join(self.entries["qualities"])
        require_words(key, unknown, known, self.reader, example)
