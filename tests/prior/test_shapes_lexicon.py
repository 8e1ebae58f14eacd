"""The words of a trained model: others are refused."""

import pytest
from pipelines import VOCABULARY

from cadam3d.core.errors import UserError
from cadam3d.prior.shapes.lexicon import JOINTS, Lexicon

LEXICON = Lexicon.read(VOCABULARY, "prior=shapes_sd", "DIR/vocabulary.json")


def refusal(prompt, key="prompt"):
    with pytest.raises(UserError) as caught:
        LEXICON.require_known(key, prompt)
    return str(caught.value)


@pytest.mark.parametrize(
    "prompt",
    [
        "a red cube",
        "A Red-and-blue CHECKERED torus",
        "an orange mushroom next to a grey house",
        "sphere red",
        "a star, front right view from above",
        "",
        " ".join(sorted(JOINTS)),
    ],
)
def test_known_words_are_accepted_in_any_order(prompt):
    LEXICON.require_known("prompt", prompt)


@pytest.mark.parametrize("prompt", ["\U0001f344", "...", "!?"])
def test_a_prompt_without_any_word_is_refused(prompt):
    assert f"got '{prompt}'." in refusal(prompt)


def test_the_message_names_the_unknown_words():
    message = refusal("a Big mushrom and the xyzzy")
    assert message.startswith(
        "prompt: expected words of prior=shapes_sd, got 'big', 'mushrom' (nearest: mushroom), "
    )
    assert message.endswith('Try: prompt="a red sphere"')
    assert refusal("ugly, bad", "negative_prompt").endswith(
        'Try: negative_prompt="ugly, blurry, low quality"'
    )
    assert len(refusal(" ".join(f"word{i}" for i in range(5000)))) < 4000


@pytest.mark.parametrize("content", [{}, {"nouns": ["cube"]}, VOCABULARY | {"patterns": "striped"}])
def test_a_file_without_lists_of_words_is_refused(content):
    with pytest.raises(UserError, match=r"^prior\.path: expected a model with nouns and colours in"):
        Lexicon.read(content, "the model DIR", "DIR/vocabulary.json")
