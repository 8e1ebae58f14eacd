"""The grammar of prompts and its error messages."""

import pytest

from cadam3d.core.errors import UserError
from cadam3d.prior.shapes.grammar import Phrase, Sentence, known_words, parse
from cadam3d.prior.shapes.objects import ALIASES, known_objects, known_primitives
from cadam3d.prior.shapes.vocabulary import COLOURS


def test_the_world_has_at_least_twelve_primitives_and_ten_objects() -> None:
    assert len(known_primitives()) >= 12
    assert len(known_objects()) >= 10


@pytest.mark.parametrize("noun", [*known_primitives(), *known_objects(), *ALIASES])
def test_every_noun_is_read_alone_and_described(noun: str) -> None:
    name = ALIASES.get(noun, noun)
    assert parse(noun) == Sentence(Phrase(name))
    assert parse(f"A small, dark-green {noun}!") == Sentence(Phrase(name, ("dark green",), size=0.65))


@pytest.mark.parametrize("noun", [*known_primitives(), *known_objects()])
def test_plurals_make_several(noun: str) -> None:
    plural = {"torus": "tori", "box": "boxes", "arch": "arches"}.get(noun, f"{noun}s")
    assert parse(f"three {plural}").phrase == Phrase(noun, count=3)
    assert parse(plural).phrase == Phrase(noun, count=2)


def test_every_colour_is_read() -> None:
    for colour in COLOURS:
        assert parse(f"a {colour} cube").phrase.colours == (colour,)


def test_colours_pattern_and_noun_of_the_demo() -> None:
    expected = Sentence(Phrase("torus", ("red", "yellow"), "checkered"))
    assert parse("a red and yellow checkered torus") == expected
    assert parse("Red-and-yellow CHEQUERED torus") == expected
    assert parse("red, yellow checkered torus") == expected


@pytest.mark.parametrize(
    ("prompt", "relation"),
    [
        ("a cube on a sphere", "on"),
        ("a cube on top of a sphere", "on"),
        ("a cube next to a sphere", "next to"),
        ("a cube beside the sphere", "next to"),
        ("a cube and a sphere", "next to"),
        ("a cube underneath a sphere", "under"),
        ("a cube in front of a sphere", "in front of"),
        ("a cube behind a sphere", "behind"),
        ("a cube above a sphere", "above"),
    ],
)
def test_relations(prompt: str, relation: str) -> None:
    assert parse(prompt) == Sentence(Phrase("cube"), relation, (Sentence(Phrase("sphere")),))


def test_between_takes_two_objects_and_chains_nest_to_the_right() -> None:
    red, blue = Phrase("cube", ("red",)), Phrase("cube", ("blue",))
    between = parse("a white sphere between a red cube and a blue cube")
    assert between == Sentence(Phrase("sphere", ("white",)), "between", (Sentence(red), Sentence(blue)))
    chain = parse("a red cube on a blue cube on a table")
    assert chain == Sentence(red, "on", (Sentence(blue, "on", (Sentence(Phrase("table")),)),))


def test_nouns_in_two_words_and_words_about_pictures_are_read() -> None:
    assert parse("a 3D model of a light-house") == Sentence(Phrase("lighthouse"))
    assert parse("a photo of an ice cream") == Sentence(Phrase("icecream"))


def test_all_unknown_words_are_named_with_near_words_and_alternatives() -> None:
    with pytest.raises(UserError) as caught:
        parse("a fluffy lighthous on a redd cube")
    message = str(caught.value)
    assert all(word in message for word in ("'fluffy'", "'lighthous'", "'redd'"))
    assert message.startswith("prompt: expected words that prior=shapes knows, got 'a fluffy lighthous")
    assert "did you mean lighthouse" in message
    assert all(word in message for group in known_words().values() for word in group)
    assert "cadam3d doctor" in message
    assert message.endswith('Try: prompt="a red and yellow checkered torus"')
    assert "'cube'" not in message


@pytest.mark.parametrize(
    ("prompt", "corrected"),
    [
        ("a redd chiar, please on a tabel", "a red and yellow checkered torus"),  # "please" has no near word
        ("A Redd chiar", "a red chair"),
        ("a lihgthouse on a bal", "a lighthouse on a ball"),
        ("a blu", "a red and yellow checkered torus"),  # "a blue" is not a sentence
    ],
)
def test_the_advice_for_misspelt_words_can_be_parsed(prompt: str, corrected: str) -> None:
    with pytest.raises(UserError) as caught:
        parse(prompt, "negative_prompt")
    assert str(caught.value).startswith("negative_prompt: expected words")
    assert str(caught.value).endswith(f'Try: negative_prompt="{corrected}"')
    parse(corrected)


@pytest.mark.parametrize(
    ("prompt", "expected"),
    [
        ("red", "an object at the end"),
        ("  ", "an object"),
        ("a cube on", "an object at the end"),
        ("on a cube", "an object before 'on'"),
        ("a cube sphere", "a relation such as 'on' or 'next to' before 'sphere'"),
        ("a cube red", "a relation such as 'on' or 'next to' before 'red'"),
        ("a dark cube", "a colour after 'dark'"),
        ("a dark small red cube", "a colour after 'dark'"),
        ("a red, green and blue cube", "at most 2 colours for one object"),
        ("a cube between a sphere", "two objects joined by 'and' after 'between'"),
    ],
)
def test_broken_sentences_are_refused_with_what_was_expected(prompt: str, expected: str) -> None:
    with pytest.raises(UserError) as caught:
        parse(prompt)
    assert str(caught.value).startswith(f"prompt: expected {expected}, got {prompt!r}. Try: prompt=")
