"""The words of a trained model: unknown ones are refused with the nearest prompt that the model can read."""

import random
import re

import pytest
from pipelines import VOCABULARY

from cadam3d.core.errors import UserError
from cadam3d.prior.shapes import known_objects, known_primitives, known_words
from cadam3d.prior.shapes.lexicon import JOINTS, Lexicon
from cadam3d.prior.shapes.objects import ALIASES
from cadam3d.prior.shapes.vocabulary import IGNORED_WORDS, NEAR_WORDS, SIMILAR_NOUNS

LEXICON = Lexicon.read(VOCABULARY, "prior=shapes_sd", "prior.path")


def refusal(prompt, key="prompt"):
    with pytest.raises(UserError) as caught:
        LEXICON.require_known(key, prompt)
    return str(caught.value)


def advice(prompt, key="prompt"):
    found = re.search(rf'Try: {key}="([a-z ,]*)"$', refusal(prompt, key))
    assert found is not None
    return found.group(1)


@pytest.mark.parametrize(
    "prompt",
    [
        "a red cube",
        "A Red-and-blue CHECKERED torus",
        "an orange mushroom next to a grey house",
        "sphere red",
        "a star, front right view from above",
        "",
    ],
)
def test_known_words_are_accepted_in_any_order(prompt):
    LEXICON.require_known("prompt", prompt)


@pytest.mark.parametrize(
    ("prompt", "nearest"),
    [
        ("a red ball", "a red sphere"),
        ("a gray cube", "a grey cube"),
        ("a castle", "a house"),
        ("a donut", "a torus"),
        ("a turquoise cone", "a cyan cone"),
        ("a dark green car", "a green car"),
        ("the dotted toadstool", "a spotted mushroom"),
        ("two small cubes", "a cube"),
        ("a redd mushrom", "a red mushroom"),
        ("a cube on top of a car", "a cube on a car"),
        ("a cube above a shelf", "a cube on a cube"),
        ("a cube under a car behind a tree", "a cube next to a car"),
        ("a cat", "a snowman"),
        ("ein roter W\u00fcrfel", "a red cube"),
        ("a pine tree house", "a tree next to a house"),
        ("xyzzy", "a red sphere"),
    ],
)
def test_the_advice_is_the_nearest_sentence_of_the_model(prompt, nearest):
    assert advice(prompt) == nearest
    LEXICON.require_known("prompt", nearest)


@pytest.mark.parametrize("prompt", ["\U0001f344", "...", "!?"])
def test_a_prompt_without_any_word_is_refused(prompt):
    assert advice(prompt) == "a red sphere"
    assert f"Unknown: '{prompt}'" in refusal(prompt)
    LEXICON.require_known("negative_prompt", prompt)


def test_a_list_that_is_too_long_for_a_message_is_refused():
    with pytest.raises(
        UserError, match=r"^prior\.path: expected a model with a list of at most 1000 nouns"
    ) as caught:
        Lexicon.read({**VOCABULARY, "nouns": [f"w{i}" for i in range(10**5)]}, "prior=mine", "prior.path")
    assert len(str(caught.value)) < 200


def test_the_message_names_unknown_and_known_words():
    message = refusal("a Big gray ball and the xyzzy")
    assert message.startswith("prompt: expected words that prior=shapes_sd knows, got 'a Big gray ball")
    assert (
        "Unknown: 'Big', 'gray' (nearest: grey), 'ball' (nearest: sphere), 'the' (nearest: a), 'xyzzy'."
        in message
    )
    for kind in ("nouns", "colours", "patterns", "relations", "views", "qualities"):
        assert f"\n  {kind}: {', '.join(VOCABULARY[kind])}\n" in message
    assert "held_out" not in message
    assert len(refusal(" ".join(f"word{i}" for i in range(5000)))) < 4000


@pytest.mark.parametrize(
    ("negative", "nearest"),
    [
        ("ugly, bad anatomy, low quality", "ugly, low quality"),
        ("worst", ""),
        ("a red ball", "a red sphere"),
    ],
)
def test_a_negative_prompt_keeps_the_parts_that_are_known(negative, nearest):
    assert advice(negative, "negative_prompt") == nearest


def test_the_advice_for_any_words_is_accepted_and_like_the_captions():
    rng = random.Random(0)
    known = [word for group in known_words().values() for entry in group for word in entry.split()]
    near = [word for words in NEAR_WORDS.values() for word in words.split()]
    own = [
        word for kind in VOCABULARY.values() for entry in kind if isinstance(entry, str) for word in [entry]
    ]
    rare = [
        "of",
        "DRAGON",
        "8k",
        '"',
        "$HOME",
        "\u7acb\u65b9\u4f53",
        "\U0001f642",
        "\x00",
        "x-wing",
        "between",
    ]
    for _ in range(300):
        words = rng.choices([*known, *near, *own, *sorted(IGNORED_WORDS), *rare], k=rng.randrange(1, 9))
        prompt = rng.choice([" ", ", "]).join(words)
        nearest = LEXICON.nearest(prompt)
        LEXICON.require_known("prompt", nearest)
        assert LEXICON.hint(nearest) is None, (prompt, nearest)


def test_every_object_of_the_world_has_similar_ones_that_exist():
    names = {*known_primitives(), *known_objects()}
    assert set(SIMILAR_NOUNS) == names
    for name, words in SIMILAR_NOUNS.items():
        similar = words.split()
        assert set(similar) <= names - {name}
        assert len(set(similar)) == len(similar) >= 2
    for name in ALIASES:
        assert advice(f"a {name}").split()[-1] in VOCABULARY["nouns"]


@pytest.mark.parametrize(
    ("prompt", "nearest"),
    [
        ("sphere red", "a red sphere"),
        ("a cube and a sphere", "a cube next to a sphere"),
        ("a cube on a car on a house", "a cube on a car"),
        ("a red cube!", "a red cube"),
        ("front view", "a red sphere"),
        ("red striped and blue cube, front view", "a red and blue striped cube"),
    ],
)
def test_a_sentence_unlike_the_captions_gets_a_hint(prompt, nearest):
    LEXICON.require_known("prompt", prompt)
    assert LEXICON.hint(prompt).endswith(f'prompt="{nearest}".')


@pytest.mark.parametrize(
    "prompt", ["a red cube", "Red cube", "a striped cone on a star, back view from above"]
)
def test_a_sentence_like_the_captions_gets_no_hint(prompt):
    assert LEXICON.hint(prompt) is None


def test_the_words_of_captions_are_always_known():
    LEXICON.require_known("prompt", " ".join(JOINTS))


@pytest.mark.parametrize("content", [{}, {"nouns": ["cube"]}, VOCABULARY | {"patterns": "striped"}])
def test_a_file_without_lists_of_words_is_refused(content):
    with pytest.raises(UserError, match=r"^prior\.path: expected a model with a list of at most 1000 \w+ in"):
        Lexicon.read(content, "the model DIR", "prior.path")
