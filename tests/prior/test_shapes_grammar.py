"""The grammar of prompts and its error messages."""

import random
import re
import string

import pytest

from cadam3d.core.errors import UserError
from cadam3d.prior.shapes.grammar import EXAMPLE, MAX_OBJECTS, Phrase, Sentence, parse
from cadam3d.prior.shapes.objects import ALIASES, known_objects, known_primitives
from cadam3d.prior.shapes.suggestion import nearest_prompt
from cadam3d.prior.shapes.vocabulary import (
    COLOURS,
    IGNORED_WORDS,
    NEAR_WORDS,
    NUMBERS,
    PATTERNS,
    RELATIONS,
    SIZES,
    STRETCHES,
)
from cadam3d.prior.shapes.words import is_known, known_words, noun_of

NOUNS = (*known_primitives(), *known_objects(), *ALIASES)


def refusal(prompt: str, key: str = "prompt") -> str:
    with pytest.raises(UserError) as caught:
        parse(prompt, key)
    return str(caught.value)


def advice(prompt: str) -> str:
    """Return the prompt that the message for a refused prompt suggests."""
    found = re.search(r'Try: prompt="([a-z0-9 ]+)"$', refusal(prompt))
    assert found is not None
    return found.group(1)


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
    assert message.endswith('Try: prompt="a lighthouse on a red cube"')
    assert "'cube'" not in message


@pytest.mark.parametrize(
    ("prompt", "corrected"),
    [
        ("a redd chiar, please on a tabel", "a red chair on a table"),
        ("A Redd chiar", "a red chair"),
        ("a lihgthouse on a bal", "a lighthouse on a ball"),
        ("a blu", "a blue cube"),
    ],
)
def test_the_advice_for_misspelt_words_can_be_parsed(prompt: str, corrected: str) -> None:
    message = refusal(prompt, "negative_prompt")
    assert message.startswith("negative_prompt: expected words")
    assert message.endswith(f'Try: negative_prompt="{corrected}"')
    parse(corrected)


@pytest.mark.parametrize(
    ("prompt", "nearest"),
    [
        ("a red dragon", "a red robot"),
        ("two red dragons", "two red robots"),
        ("A highly detailed DSLR photo of a corgi, 8k, photorealistic", "a robot"),
        ("an astronaut riding a horse", "a robot on a robot"),
        ("a robot dog", "a robot"),
        ("a delicious hamburger on a plate", "a cake on a plate"),
        ("6 cats next to a hat", "five robots next to a cone"),
        ("ein roter Würfel", "a red cube"),
        ("grüne Kugel neben einem roten Haus", "a green sphere next to a red house"),
        ("une voiture rouge", "a red car"),
        ("a red \u043a\u0443\u0431", "a red cube"),
        ("a cube with red and blue stripes", "a red and blue striped cube"),
        ("a purple zorblax and a cube", "a purple orb and a cube"),
        ("a red xyzzy", "a red cube"),
        # Broken sentences of known words.
        ("red", "a red cube"),
        ("a cube on", "a cube"),
        ("on a cube", "a cube"),
        ("a cube red", "a red cube"),
        ("a cube sphere", "a cube and a sphere"),
        ("a dark small red cube", "a small red cube"),
        ("a red, green and blue cube", "a red and green cube"),
        ("a cube between a sphere", "a cube next to a sphere"),
        # Nothing to build on.
        ("xyzzy", EXAMPLE),
        ("", EXAMPLE),
    ],
)
def test_the_advice_is_the_nearest_sentence(prompt: str, nearest: str) -> None:
    assert advice(prompt) == nearest


@pytest.mark.parametrize(
    ("prompt", "named"),
    [
        ("ein roter W\u00fcrfel", "'W\u00fcrfel' (nearest: cube)"),
        ("ein roter Wu\u0308rfel", "'W\u00fcrfel' (nearest: cube)"),  # the accent as a character of its own
        ("a \u0932\u093e\u0932 cube", "'\u0932\u093e\u0932'"),  # a vowel sign is part of the word
        ("\u7acb\u65b9\u4f53", "'\u7acb\u65b9\u4f53'"),
        ("a child's cube", '"child\'s" (nearest: robot)'),
        ("a lihgthouse", "'lihgthouse' (did you mean lighthouse?)"),
        ("a red dragon", "'dragon' (nearest: robot)"),
    ],
)
def test_unknown_words_are_named_whole_and_as_typed(prompt: str, named: str) -> None:
    assert f"Unknown: {named}. Known words" in refusal(prompt).replace("'ein', 'roter' (nearest: red), ", "")


@pytest.mark.parametrize(
    "prompt", ["a red cube \u2764\ufe0f!", "\u201ea red cube\u201c", "a red\u2014cube\ufe0f"]
)
def test_signs_and_pictures_between_words_do_not_matter(prompt: str) -> None:
    assert parse(prompt) == parse("a red cube")


def test_the_advice_for_any_words_in_any_order_can_be_parsed() -> None:
    rng = random.Random(0)
    known = [word for group in known_words().values() for entry in group for word in entry.split()]
    near = [word for words in NEAR_WORDS.values() for word in words.split()]
    rare = [
        *("a", "an", "the", "of", "and", "and", "between", "top", "dark", "DRAGON", "x-wing"),
        '"',
        "$HOME",
    ]
    rare += [
        "8k",
        "3",
        "'s",
        "--",
        "\u00dcber",
        "\u7acb\u65b9\u4f53",
        "\u0932\u093e\u0932",
        "\U0001f642",
        "\ud800",
        "a\tb\n",
        "\x00",
        "\u0130",
    ]
    for _ in range(1000):
        words = rng.choices([*known, *near, *sorted(IGNORED_WORDS), *rare * 8], k=rng.randrange(12))
        if rng.random() < 0.3:
            words.append("".join(rng.choices(string.printable, k=6)))
        try:
            parse(rng.choice([" ", " ", ", ", "-"]).join(words))
        except UserError as error:
            found = re.search(r'Try: prompt="([a-z0-9 ]+)"$', str(error))
            assert found is not None, words
            parse(found.group(1))


def test_a_sentence_that_can_be_parsed_is_its_own_nearest_sentence() -> None:
    rng = random.Random(1)
    described = (
        "",
        "two",
        "tiny",
        "tall",
        "red",
        "dark green",
        "light tan and olive",
        "spotted",
        "big flat gold striped",
    )
    joints = (*(" ".join(words) for words, _ in RELATIONS), "between a cube and")
    for _ in range(200):
        phrases = [f"a {rng.choice(described)} {rng.choice(NOUNS)}" for _ in range(rng.randrange(1, 5))]
        prompt = phrases[0]
        for phrase in phrases[1:]:
            joint = rng.choice([each for each in joints if each != "between"])
            prompt += f" {joint} {phrase}"
        assert parse(nearest_prompt(prompt) or "") == parse(prompt), prompt
        noisy = prompt.replace("a ", "a highly detailed 8k ")
        assert parse(nearest_prompt(noisy) or "") == parse(prompt), noisy


def test_the_tables_of_near_words_hold_unknown_words_and_suggest_known_ones() -> None:
    words = [word for line in NEAR_WORDS.values() for word in line.split()]
    assert len(words) == len(set(words))
    assert not [word for word in (*words, *IGNORED_WORDS) if is_known(word) and word != "on"]
    assert all(is_known(word) for known in NEAR_WORDS for word in known.split())
    assert not set(words) & IGNORED_WORDS


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
    "prompt", ["x" * 30_000, " ".join(f"word{i}" for i in range(5_000)), "\u00e9 " * 15_000]
)
def test_the_message_for_a_long_prompt_is_short(prompt: str) -> None:
    assert len(refusal(prompt)) < 4000
    assert advice(prompt) == EXAMPLE


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
