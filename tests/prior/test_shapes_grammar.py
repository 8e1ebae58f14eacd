"""The grammar of prompts and its error messages."""

import re
from pathlib import Path

import pytest

from cadam3d.core.errors import UserError
from cadam3d.prior.shapes.grammar import EXAMPLE, MAX_OBJECTS, Phrase, Sentence, parse
from cadam3d.prior.shapes.objects import ALIASES, known_objects, known_primitives
from cadam3d.prior.shapes.scene import build
from cadam3d.prior.shapes.words import (
    COLOURS,
    NUMBERS,
    PATTERNS,
    SIZES,
    STRETCHES,
    known_words,
    noun_of,
)

PAGE = "docs/exact.md"


def refusal(prompt: str, key: str = "prompt") -> str:
    with pytest.raises(UserError) as caught:
        parse(prompt, key)
    return str(caught.value)


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


def test_relations_group_as_in_english() -> None:
    def pair(left: Sentence | str, relation: str, right: Sentence | str) -> Sentence:
        others = right if isinstance(right, Sentence) else Sentence(Phrase(right))
        return Sentence(left if isinstance(left, Sentence) else Phrase(left), relation, (others,))

    stack, rank = pair("cone", "on", "cube"), pair("sphere", "in front of", "pyramid")
    assert parse("a cone on a cube next to a ball in front of a pyramid") == pair(stack, "next to", rank)
    assert parse("a ball in front of a pyramid and a cone on a cube") == pair(rank, "next to", stack)
    assert parse("a cone on a cube behind a tree on a box") == pair(
        stack, "behind", pair("tree", "on", "box")
    )
    assert parse("a ball under a table next to a chair") == pair(
        pair("sphere", "under", "table"), "next to", "chair"
    )
    assert parse("a cube and a ball and a cone") == pair("cube", "next to", pair("sphere", "next to", "cone"))


def test_what_stands_on_an_object_of_a_group_stands_over_its_middle() -> None:
    scene = build("a cone on a cube next to a ball in front of a pyramid")
    place = {kind.name: at.tolist() for (kind, _), at in zip(scene.kinds, scene.centres, strict=True)}
    cone, cube, ball, pyramid = (place[name] for name in ("frustum", "box", "ball", "pyramid"))
    assert cone[:2] == pytest.approx(cube[:2], abs=1e-6)
    assert cone[2] > cube[2]
    assert ball[1] > cube[1]
    assert ball[0] > pyramid[0]
    assert len(set(scene.paints[:, 0].tolist())) == 4, "open colours differ"


def test_nouns_in_two_words_and_words_about_pictures_are_read() -> None:
    assert parse("a 3D model of a light-house") == Sentence(Phrase("lighthouse"))
    assert parse("a photo of an ice cream") == Sentence(Phrase("icecream"))


@pytest.mark.parametrize(
    ("prompt", "named"),
    [
        (
            "a fluffy lighthous on a redd cube",
            ["'fluffy'", "'lighthous' (nearest: lighthouse)", "'redd' (nearest: red)"],
        ),
        ("a red dragon", ["'dragon'"]),  # and no other animal or machine
        # The accent as a character of its own.
        ("ein roter wu\u0308rfel", ["'ein'", "'roter'", "'w\u00fcrfel'"]),
    ],
)
def test_unknown_words_are_named_with_the_nearest_spelling(prompt: str, named: list[str]) -> None:
    message = refusal(prompt, "negative_prompt")
    assert message.startswith("negative_prompt: expected words of prior=shapes")
    assert f"got {', '.join(named)}. " in message
    assert PAGE in message
    assert "\n" not in message


def test_the_page_that_messages_name_lists_all_words() -> None:
    page = (Path(__file__).parents[2] / PAGE).read_text(encoding="utf-8")
    words = [
        word for line in page.splitlines() if line.startswith("| ") for word in re.findall(r"[\w ]+", line)
    ]
    listed = {word.strip() for word in words}
    assert not [word for group in known_words().values() for word in group if word not in listed]


@pytest.mark.parametrize(
    "prompt", ["a red cube \u2764\ufe0f!", "\u201ea red cube\u201c", "a red\u2014cube\ufe0f"]
)
def test_signs_and_pictures_between_words_do_not_matter(prompt: str) -> None:
    assert parse(prompt) == parse("a red cube")


def test_every_known_word_is_one_part_of_speech() -> None:
    adjectives = [*COLOURS, *PATTERNS, *SIZES, *STRETCHES, *NUMBERS]
    assert len(set(adjectives)) == len(adjectives)
    assert not [word for word in adjectives if noun_of(word)]


@pytest.mark.parametrize("joint", [" and ", " on "])
def test_a_prompt_of_too_many_objects_is_refused(joint: str) -> None:
    parse(joint.join(["a cube"] * MAX_OBJECTS))
    for count in (MAX_OBJECTS + 1, 20_000):
        message = refusal(joint.join(["a cube"] * count))
        assert message.startswith(f"prompt: expected at most {MAX_OBJECTS} objects, got 'a cube")
        assert len(message) < 1000


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
    assert refusal(prompt) == f'prompt: expected {expected}, got {prompt!r}. Try: prompt="{EXAMPLE}"'
    parse(EXAMPLE)
