"""The line before training says what happens when."""

import pytest
import torch

from cadam3d.build import build_trainer, component
from cadam3d.commands.timetable import describe
from cadam3d.settings.compose import compose

CPU = torch.device("cpu")


def line(*words: str) -> str:
    # Options on the line replace those of a recipe, whose prior needs weights.
    return describe(build_trainer(compose(["prompt=a red cube", *words, "prior=tiny"]), CPU))


def test_the_default_run_grows_resets_and_anneals():
    assert line() == (
        "6 refinements (steps 150 to 400, every 50), 1 opacity reset (step 300), "
        "the last 200 of 600 steps only optimise, learning rates change until step 600."
    )


def test_a_skipped_reset_is_named_with_the_setting_that_skips_it():
    explicit = ["refine.reset_interval=150", "refine.reset_from=1", "refine.reset_until=600"]
    assert "2 opacity resets (steps 150 and 300), 1 reset (step 450) is skipped (" in line(
        *explicit, "refine.recovery=151"
    )
    assert "less than refine.recovery=96 steps before the end" in line("steps=100")
    assert "skipped" not in line(*explicit)


def test_a_densifier_without_resets_has_none_and_none_that_is_skipped():
    for words in (["densifier=none"], ["densifier=cadam_no_reset"], ["densifier=mcmc"], ["densifier=random"]):
        text = line(*words, "steps=100")
        assert "no opacity reset" in text
        assert "skipped" not in text
    assert "1 opacity reset" in line("densifier=cadam_global_reset")


@pytest.mark.parametrize("name", ["none", "mcmc", "random", "random_annealed", "cadam_no_reset"])
def test_a_densifier_that_claims_to_reset_nothing_marks_no_gaussian(name):
    densifier = component(compose(["prompt=a red cube", f"densifier={name}"]).densifier)
    assert not densifier.resets
    state = densifier.init_state(5, CPU)
    assert not densifier.unreliable(state).any()


def test_a_run_in_which_nothing_grows_says_so():
    for words in (["refine.start=450"], ["refine.interval=451"], ["refine.end=0"], ["steps=2"], ["steps=20"]):
        assert "Nothing will grow" in line(*words)
    assert "Nothing will grow" in line("densifier.min_age=2000")
    assert "Nothing will grow" not in line()


def test_a_run_that_is_meant_not_to_grow_gets_no_advice():
    assert "Nothing will grow" not in line("densifier=none", "refine.end=0")


def test_a_schedule_that_does_not_follow_the_length_names_its_own():
    published = ["refine.made_for=5000", "refine.start=100", "refine.end=3000", "refine.interval=100"]
    published += ["refine.reset_interval=300", "refine.reset_from=500", "refine.reset_until=3000"]
    text = line("experiment=luciddreamer", "steps=600", *published, "guidance.t_max.steps=1500")
    assert (
        "5 refinements (steps 200 to 600, every 100), no opacity reset, 1 reset (step 600) is skipped" in text
    )
    assert "made for 5000 steps, which have 28." in text
    assert "guidance.t_max (until step 1500)" in text


RECIPES = (
    "luciddreamer",
    "flowdreamer",
    "flowdreamer_ucm",
    "gaussiandreamer",
    "dreamgaussian",
    "gcs_beg",
    "mvdream",
)


@pytest.mark.parametrize("recipe", RECIPES)
def test_every_schedule_of_a_recipe_follows_its_length(recipe):
    for steps in (100, 400):
        text = line(f"experiment={recipe}", f"steps={steps}")
        assert "made for" not in text
        # GaussianDreamer's rates, which this sentence leaves out, fall over 25 times the run, as published.
        assert "ends before" not in text
        assert "Nothing will grow" not in text
        assert "refinements (steps" in text


def test_a_last_pruning_is_announced():
    assert "a last pruning, the last step refines" in line("experiment=dreamgaussian")
    assert "pruning" not in line()


def test_a_recipe_of_its_published_length_misses_nothing():
    for recipe in ("luciddreamer", "flowdreamer", "gaussiandreamer", "dreamgaussian", "gcs_beg", "smoke"):
        text = line(f"experiment={recipe}")
        assert "made for" not in text
        assert "skipped" not in text


def test_constant_learning_rates_are_called_constant():
    rates = [f"optimizer.{part}_lr=0.01" for part in ("means", "sh_dc", "scale", "quat")]
    assert line(*rates).endswith("constant learning rates.")
    assert "learning rates change until step 360." in line("optimizer=dreamgaussian")
