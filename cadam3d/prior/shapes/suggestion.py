"""Suggestion: the sentence of the grammar that is nearest to a prompt which cannot be parsed.

Known words keep their places. An unknown word is replaced by a known one of similar spelling or meaning, or
else left out. What is still missing or superfluous, such as a noun or a third colour, is added or left out.
"""

import difflib
import unicodedata
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache, lru_cache
from itertools import pairwise

from cadam3d.prior.shapes.vocabulary import (
    ARTICLES,
    COLOUR_ALIASES,
    COLOURS,
    FILLERS,
    IGNORED_WORDS,
    NEAR_WORDS,
    NUMBERS,
    PATTERNS,
    RELATIONS,
    SIZES,
    STRETCHES,
)
from cadam3d.prior.shapes.words import (
    ADJECTIVES,
    SHADES,
    is_known,
    is_plural,
    noun_of,
    plural_of,
    vocabulary,
    with_article,
    words_of,
)

SIMILAR = 0.78  # of difflib's ratio, in [0, 1]; one letter of five may differ, but not one of four
SIMILAR_NOUN = 0.6  # if a noun is needed
LEAST_LETTERS = 3  # of a word that may be misspelt
LONGEST_WORD = 40  # letters; a longer one is not compared
MAX_WORDS = 200  # of a prompt
MAX_PHRASES = 20  # of the suggestion
ANY_NOUN = "cube"  # if no noun is near
AND = "and"


@dataclass(frozen=True)
class _Word:
    """A word of the prompt, or a known word in its place."""

    text: str
    is_typed: bool  # False: a known word that replaces the typed one
    is_known: bool
    begins: bool = False  # an article is before it
    follows_of: bool = False


@dataclass
class _Draft:
    """A noun phrase under construction."""

    relation: str = ""  # to the phrase before
    is_relation_typed: bool = True
    adjectives: list[str] = field(default_factory=list)
    noun: _Word | None = None
    trailing: list[str] = field(default_factory=list)  # adjectives behind the noun
    unknown: str = ""  # the last unknown word, which may be its noun

    @property
    def is_described(self) -> bool:
        return self.noun is None and not self.unknown and bool(self.adjectives)

    @property
    def is_empty(self) -> bool:
        has_word = bool(self.noun or self.adjectives)
        # "in tudor style" adds nothing, but "on a tudor" needs an object.
        return not has_word and not (self.unknown and self.is_relation_typed)


def near_spelling(word: str) -> tuple[str, ...]:
    """Return at most two known words of which an unknown word may be a misspelling, the nearest first."""
    plain = _plain(word)
    if is_known(plain):
        return (plain,)
    return () if plain in IGNORED_WORDS else _similar(plain, SIMILAR, 2)


def near_meaning(word: str) -> str | None:
    """Return the known words that the table suggests for an unknown word; None if it has none."""
    plain = _plain(word)
    for form in (plain, plain.removesuffix("'s"), plain.removesuffix("s"), plain.removesuffix("es")):
        if known := _meanings().get(form):
            is_many = form != plain and not plain.endswith("'s") and noun_of(known) is not None
            return plural_of(known) if is_many else known
    return None


def nearest_prompt(prompt: str) -> str | None:
    """Return a prompt near to ``prompt`` that the grammar can parse; None if no word gives a clue."""
    words = list(_replaced(words_of(prompt[: MAX_WORDS * LONGEST_WORD])[:MAX_WORDS]))
    if not any(word.is_known for word in words):
        return None
    drafts = _completed(_drafts(words))[:MAX_PHRASES]
    relations = [draft.relation for draft in drafts[1:]]
    for i, (relation, following) in enumerate(pairwise([*relations, ""])):
        # "between" needs two objects that are joined by "and".
        if relation == "between" and following != AND:
            relations[i] = "next to"
    if not drafts:
        return None
    pairs = zip(["", *relations], drafts, strict=True)
    return " ".join(f"{relation} {_written(draft)}" for relation, draft in pairs).strip()


def _replaced(words: Sequence[str]) -> Iterator[_Word]:
    """Yield the words that matter, each unknown one replaced by a near one if there is any."""
    begins = follows_of = False
    for word in words:
        if word in ARTICLES:
            begins = True
        elif word in FILLERS:
            follows_of = word == "of"
        else:
            if is_known(word):
                yield _Word(word, is_typed=True, is_known=True, begins=begins, follows_of=follows_of)
            elif near := near_meaning(word) or next(iter(near_spelling(word)), None):
                for text in near.split():
                    yield _Word(text, is_typed=False, is_known=True, begins=begins, follows_of=follows_of)
            elif _plain(word) not in IGNORED_WORDS:
                yield _Word(word, is_typed=False, is_known=False, begins=begins, follows_of=follows_of)
            begins = follows_of = False


def _drafts(words: Sequence[_Word]) -> list[_Draft]:
    """Return the phrases of a sentence as far as its words go."""
    drafts = [_Draft()]
    texts = [word.text for word in words]
    i = 0
    while i < len(words):
        draft, word = drafts[-1], words[i]
        relation = next((each for each, _ in RELATIONS if tuple(texts[i : i + len(each)]) == each), ())
        if relation == (AND,) and draft.noun is None:
            # Between adjectives, unless an unknown noun is before and another phrase behind it.
            follows_noun = i > 0 and not words[i - 1].is_known
            relation = relation if follows_noun and i + 1 < len(words) and words[i + 1].begins else ()
        if relation:
            of = " of" if relation in (("on", "top"), ("in", "front")) else ""
            drafts.append(_Draft(" ".join(relation) + of, is_relation_typed=word.is_typed))
        elif word.text in ADJECTIVES:
            (draft.adjectives if draft.noun is None else draft.trailing).append(word.text)
        elif noun_of(word.text) is not None:
            _add_noun(drafts, word)
        elif not word.is_known:
            draft.unknown = word.text
        i += len(relation) or 1
    return drafts


def _add_noun(drafts: list[_Draft], word: _Word) -> None:
    """Add a noun to the last phrase, or a phrase of its own if that has a noun already.

    Of two nouns in a row, such as "robot dog", the one that was typed is kept, or else the last one.
    """
    draft = drafts[-1]
    if draft.noun is None:
        draft.noun = word
    elif (word.begins and not word.follows_of) or (draft.noun.is_typed and word.is_typed):
        drafts.append(_Draft(AND, adjectives=draft.trailing, noun=word))
        draft.trailing = []
    elif word.is_typed or not (draft.noun.is_typed or word.follows_of):
        draft.noun = word


def _completed(drafts: Sequence[_Draft]) -> list[_Draft]:
    """Return the phrases without empty ones; adjectives behind a noun are moved to it."""
    kept: list[_Draft] = []
    for draft in drafts:
        if kept and draft.is_described and (draft.relation == AND or not draft.is_relation_typed):
            kept[-1].adjectives += draft.adjectives
        elif not draft.is_empty:
            draft.adjectives += draft.trailing
            kept.append(draft)
    return kept


def _written(draft: _Draft) -> str:
    """Return a phrase that the grammar can parse, with an article where English needs one."""
    noun = draft.noun.text if draft.noun else next(iter(_similar_nouns(draft.unknown)), ANY_NOUN)
    number = [word for word in draft.adjectives if word in NUMBERS][:1]
    stretch = [word for word in draft.adjectives if word in STRETCHES][:1]
    pattern = [word for word in draft.adjectives if word in PATTERNS][:1]
    sizes = [word for word in draft.adjectives if word in SIZES]
    colours = [
        f"{before} {word}" if before in SHADES else word
        for before, word in pairwise(["", *draft.adjectives])
        if word in COLOURS or word in COLOUR_ALIASES
    ][:2]
    words = [*number, *sizes, *stretch, *([" and ".join(colours)] if colours else []), *pattern, noun]
    if number or is_plural(noun):
        return " ".join(words)
    return with_article(" ".join(words))


@cache
def _meanings() -> dict[str, str]:
    """Return the table of near words by unknown word."""
    return {word: known for known, words in NEAR_WORDS.items() for word in words.split()}


@lru_cache(maxsize=MAX_WORDS)
def _similar(word: str, least: float, count: int) -> tuple[str, ...]:
    """Return known words of similar spelling, the most similar first."""
    if not (LEAST_LETTERS <= len(word) <= LONGEST_WORD and word.isalpha()):
        return ()
    # Sorted, since the order of a set differs between processes and decides between equally near words.
    candidates = sorted(vocabulary() - ARTICLES - FILLERS)
    return tuple(difflib.get_close_matches(word, candidates, n=count, cutoff=least))


def _similar_nouns(word: str) -> tuple[str, ...]:
    """Return the nouns of similar spelling, the most similar first."""
    return tuple(known for known in _similar(_plain(word), SIMILAR_NOUN, 5) if noun_of(known) is not None)


def _plain(word: str) -> str:
    """Return a word without accents, as the table and the vocabulary are written."""
    apart = unicodedata.normalize("NFKD", word.replace("ß", "ss"))
    return "".join(letter for letter in apart if not unicodedata.combining(letter))
