"""A small run that the tests of callbacks watch."""

from dataclasses import replace

import pytest
import torch
from composed import composed

from cadam3d.build import build_trainer, component
from cadam3d.commands.beginning import run_context
from cadam3d.initializer.base import Initializer

SMALL = ("prompt=a red cube", "prior=tiny", "rasterizer=reference", "camera.size=12", "initializer.count=30")
GROWING = ("steps=7", "refine.start=0", "refine.end=100", "refine.interval=2")


@pytest.fixture(scope="session")
def begin():
    """Return a function that builds a run in ``folder``: trainer, state, embedded prompt and context.

    ``callbacks`` replace those of the configuration.
    """

    def build(folder, *line, callbacks=None):
        cfg = composed(*SMALL, *GROWING, "callback=[]", *line)
        trainer = build_trainer(cfg, torch.device("cpu"))
        if callbacks is not None:
            trainer = replace(trainer, callbacks=callbacks)
        initializer = component(cfg.initializer, Initializer, "initializer")
        state = trainer.start(cfg.prompt, initializer, cfg.seed, torch.device("cpu"))
        context = run_context(cfg.prompt, trainer, state, folder)
        return trainer, state, trainer.prior.embed(cfg.prompt, cfg.negative_prompt), context

    return build


@pytest.fixture(scope="session")
def train(begin):
    """Return a function that trains such a run in ``folder`` and returns its state and outcome."""

    def run(folder, *line, callbacks=None):
        trainer, state, embedding, context = begin(folder, *line, callbacks=callbacks)
        return state, trainer.train(state, embedding, context)

    return run


@pytest.fixture(scope="session")
def plain(train, tmp_path_factory):
    """Return the state of a run that no callback watches."""
    return train(tmp_path_factory.mktemp("plain"), "densifier.min_age=0")[0]


@pytest.fixture(scope="session")
def alike():
    """Return a function that checks that two runs have the same Gaussians, statistics and random states."""

    def check(one, other):
        assert len(one.gaussians) != one.num_initial, "nothing grew, so this test proves little"
        for name, tensor in other.gaussians.tensors().items():
            assert torch.equal(one.gaussians.tensors()[name], tensor), name
        for name, rows in other.densifier.to_dict().items():
            assert torch.equal(one.densifier.to_dict()[name], rows), name
        for name, generator in other.generators.items():
            assert torch.equal(one.generators[name].get_state(), generator.get_state()), name

    return check
