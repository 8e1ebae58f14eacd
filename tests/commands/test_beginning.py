"""The line before training says what happens when."""

import pytest
import torch

from cadam3d.build import build_trainer, component
from cadam3d.commands.beginning import describe_schedule
from cadam3d.settings.compose import compose

CPU = torch.device("cpu")


def line(*words: str) -> str:
    # Options on the line replace those of a recipe, whose prior needs weights.
    return describe_schedule(build_trainer(compose(["prompt=a red cube", *words, "prior=tiny"]), CPU))


@pytest.mark.parametrize("name", ["none", "mcmc", "random", "random_annealed", "cadam_no_reset"])
def test_a_densifier_without_resets_announces_none_and_marks_no_gaussian(name):
    densifier = component(compose(["prompt=a red cube", f"densifier={name}"]).densifier)
    assert not densifier.resets
    assert not densifier.unreliable(densifier.init_state(5, CPU)).any()
    if name == "mcmc":
        assert "no opacity reset" in line(f"densifier={name}")


@pytest.mark.parametrize("words", [("refine.end=0",), ("steps=2",), ("densifier.min_age=2000",)])
def test_a_run_in_which_nothing_grows_says_so(words):
    assert "Nothing will grow" in line(*words)


def test_a_run_that_is_meant_not_to_grow_gets_no_advice():
    assert "Nothing will grow" not in line("densifier=none", "refine.end=0")


@pytest.mark.parametrize("recipe", ["luciddreamer", "gaussiandreamer", "dreamgaussian", "gcs_beg"])
def test_a_short_run_of_a_recipe_still_grows(recipe):
    text = line(f"experiment={recipe}", "steps=100")
    assert "Nothing will grow" not in text
    assert ("a last pruning" in text) == (recipe == "dreamgaussian")
