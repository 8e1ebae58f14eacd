"""Laws of the simplified baseline: the baseline before the step, and the chosen number after it."""

from dataclasses import replace
from functools import cache

import pytest
import torch
from splats import make_gaussians

from cadam3d.build import component
from cadam3d.core.gaussians import FIELDS
from cadam3d.settings.compose import compose

CPU = torch.device("cpu")


@cache
def built(name: str, *lines: str):
    cfg = compose(["prompt=a red cube", f"densifier={name}", *lines])
    return component(cfg.densifier), replace(component(cfg.refine), max_scale=None, reset_interval=None)


def plan(name: str, step: int, *lines: str, n: int = 50):
    densifier, refine = built(name, *lines)
    scene = make_gaussians(n)
    scene.opacity_logits[:4] = -9.0
    state = replace(
        densifier.init_state(n, CPU), norm_sum=torch.ones(n), sightings=torch.ones(n, dtype=torch.int32)
    )
    return scene, densifier.plan(state, scene, step, refine, torch.Generator().manual_seed(0))


def test_before_the_step_it_is_the_baseline():
    _, usual = plan("baseline", 399)
    _, ours = plan("baseline_simplified", 399, "densifier.count=10")
    assert usual.edit.rows_after > 50
    assert torch.equal(usual.edit.keep, ours.edit.keep)
    for name in FIELDS:
        assert torch.equal(getattr(usual.edit.children, name), getattr(ours.edit.children, name))


@pytest.mark.parametrize("method", ["merge", "opacity"])
@pytest.mark.parametrize("step", [400, 450])
def test_from_the_step_on_it_leaves_the_count_and_grows_nothing(method, step):
    scene, decided = plan("baseline_simplified", step, "densifier.count=10", f"densifier.simplify={method}")
    assert decided.edit.rows_after == len(decided.edit.apply(scene)) == 10
    assert (decided.selected, decided.cloned, decided.split, decided.pruned) == (0, 0, 0, 40)
    assert not {0, 1, 2, 3} & {*decided.edit.keep.tolist(), *decided.edit.parents.tolist()}
    assert decided.edit.keep.tolist() == sorted(decided.edit.keep.tolist())
    assert (len(decided.edit.parents) > 0) == (method == "merge")


def test_fewer_than_the_count_are_only_pruned():
    scene, decided = plan("baseline_simplified", 400, "densifier.count=47")
    assert decided.edit.keep.tolist() == list(range(4, 50))
    assert len(decided.edit.apply(scene)) == 46
