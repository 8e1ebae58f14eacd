"""A trainer that is stepped by hand gives the bytes of a whole run, also with objects of the caller."""

from dataclasses import dataclass

import pytest
import torch
from composed import composed

import cadam3d
from cadam3d.build import component
from cadam3d.core.edit import RowState
from cadam3d.densifier.base import Densifier

SMALL = ("prompt=a red cube", "prior=tiny", "rasterizer=reference", "steps=4", "views=1", "camera.size=8")
SMALL += ("initializer.count=20", "refine.start=0", "refine.end=9", "refine.interval=2", "seed=3")
CADAM = ("densifier.min_age=0",)


@dataclass
class Nothing(RowState):
    """One number per Gaussian, which is never read."""

    zeros: torch.Tensor


@dataclass(frozen=True)
class First(Densifier):
    """Grow the first Gaussians at every refinement."""

    count: int = 3

    def init_state(self, n, device):
        return Nothing(torch.zeros(n, device=device))

    def observe(self, state, signal):
        return state

    def select(self, state, step, generator):
        return torch.arange(len(state.zeros)) < self.count

    def unreliable(self, state):
        return torch.zeros_like(state.zeros, dtype=torch.bool)


def same(left, right) -> bool:
    return all(torch.equal(left.tensors()[name], tensor) for name, tensor in right.tensors().items())


@pytest.fixture(scope="module")
def trainer() -> cadam3d.Stepper:
    return cadam3d.compose(*SMALL, *CADAM)


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> cadam3d.Run:
    settings = ("exporter=[ply]", "metric=[]", "callback=[]")
    folder = tmp_path_factory.mktemp("run") / "whole"
    return cadam3d.train(None, *SMALL, *CADAM, *settings, folder=folder)


def test_stepping_gives_the_bytes_of_a_run(run, trainer, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    state = trainer.start()
    steps = []
    while trainer.outcome(state) is None:
        before = len(state.gaussians)
        steps.append(trainer.step(state))
        assert (steps[-1].step, steps[-1].num_gaussians) == (state.step, before)
    assert trainer.outcome(state) == "finished"
    assert [step.refinement is not None for step in steps] == [False, True, False, True]
    assert len(state.gaussians) > 20
    assert same(run.asset.gaussians, trainer.asset(state).gaussians)
    trainer.asset(state).export("asset.ply")
    assert (tmp_path / "asset.ply").read_bytes() == (run.folder / "asset.ply").read_bytes()


def test_the_modes_of_torch_are_those_of_the_caller_between_steps(run, trainer):
    dtype = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    torch.set_default_device("meta")
    try:
        with torch.no_grad():
            state = trainer.start()
            for _ in trainer.run(state):
                assert torch.get_default_dtype() == torch.float64
                assert torch.get_default_device().type == "meta"
                assert not torch.is_grad_enabled()
                assert torch.get_deterministic_debug_mode() == 0
    finally:
        torch.set_default_dtype(dtype)
        torch.set_default_device(None)
    assert same(run.asset.gaussians, trainer.asset(state).gaussians)


def test_modes_that_change_numbers_are_off_during_a_step(run, trainer):
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("medium")
    try:
        with torch.autocast("cpu", dtype=torch.bfloat16):
            state = trainer.start()
            list(trainer.run(state))
            assert torch.is_autocast_enabled("cpu")
        assert torch.get_float32_matmul_precision() == "medium"
    finally:
        torch.set_float32_matmul_precision(before)
    assert same(run.asset.gaussians, trainer.asset(state).gaussians)


def test_an_asset_of_a_state_is_a_copy(trainer):
    state = trainer.start()
    before = trainer.asset(state)
    trainer.step(state)
    assert not same(before.gaussians, state.gaussians)
    assert before.title == "a red cube"


def test_a_component_of_the_yaml_and_the_same_object_do_the_same(run):
    trainer = cadam3d.compose(*SMALL, densifier=component(composed(*SMALL, *CADAM).densifier))
    state = trainer.start()
    assert [step.step for step in trainer.run(state)] == [1, 2, 3, 4]
    assert same(run.asset.gaussians, state.gaussians.detach())


def test_a_densifier_of_the_caller_decides_what_grows():
    trainer = cadam3d.compose(*SMALL, densifier=First(count=5))
    state = trainer.start()
    refinements = [step.refinement for step in trainer.run(state) if step.refinement is not None]
    assert [refinement.selected for refinement in refinements] == [5, 5]
    assert len(state.gaussians) == refinements[-1].after > 20


def test_every_component_that_is_given_is_used():
    objects = {
        name: component(composed(*SMALL)[name])
        for name in ("guidance", "prior", "camera", "background", "optimizer", "initializer", "rasterizer")
    }
    trainer = cadam3d.compose(*SMALL[:1], "steps=4", "views=1", **objects)
    for name in objects.keys() - {"initializer"}:
        assert getattr(trainer.parts, name) is objects[name]
    assert trainer.initializer is objects["initializer"]


@pytest.mark.parametrize(
    ("words", "objects", "message"),
    [
        (
            (),
            {"densifier": "cadam"},
            r"densifier: expected an object of class Densifier, got 'cadam'\. Try: \"densifier=cadam\"",
        ),
        ((), {"densifier": First}, "densifier: expected an object of class"),
        (
            ("densifier.tau_Q=0.5",),
            {"densifier": First()},
            "densifier.tau_Q: expected the object or its settings",
        ),
        (("densifier=cadam",), {"densifier": First()}, "densifier: expected the object or its settings"),
        (("resume=outputs/latest",), {}, "resume: only a whole run"),
        (("stesp=3",), {}, r"stesp: no such setting\. Did you mean steps\?"),
    ],
)
def test_what_cannot_work_is_refused(words, objects, message, without_type_checks):
    with pytest.raises(cadam3d.UserError, match=message):
        cadam3d.compose("prompt=a red cube", *words, **objects)
