"""The trained models of the package: a few steps give colour and outline, which a random network cannot."""

from dataclasses import dataclass

import pytest
import torch

from cadam3d.build import build_trainer, component
from cadam3d.commands.beginning import run_context
from cadam3d.core.cameras import turntable
from cadam3d.initializer.base import Initializer
from cadam3d.prior.shapes.words import COLOURS
from cadam3d.settings.compose import compose

pytest.importorskip("diffusers")
pytestmark = pytest.mark.slow

# An object whose outline is far from that of the ball of points at the start.
COLOUR, NOUN = "red", "capsule"
STEPS = 40
SIZE = 64
NAMES = ("red", "green", "blue", "yellow", "white", "black")


@dataclass(frozen=True)
class Seen:
    """What four views around an object show."""

    colour: torch.Tensor  # the mean RGB of the object
    outline: torch.Tensor  # "4 h w", where the object is

    def overlap(self, other: "Seen") -> float:
        """Return the intersection of both outlines over their union."""
        both, either = self.outline & other.outline, self.outline | other.outline
        return float(both.sum() / either.sum())

    def name(self) -> str:
        """Return the nearest colour of a few very different ones."""
        return min(NAMES, key=lambda name: float((self.colour - torch.tensor(COLOURS[name])).norm()))


def seen(images) -> Seen:
    """Look at an object over black and over white."""
    cameras = turntable(4, elevation_deg=15.0, distance=3.1, fov_y_deg=42.0, size=SIZE)
    black, white = (images(cameras, torch.full((4, 3), value)) for value in (0.0, 1.0))
    alpha = 1 - (white - black).mean(dim=-1)
    colour = (black * (alpha > 0.5)[..., None]).sum(dim=(0, 1, 2)) / alpha[alpha > 0.5].sum().clamp_min(1)
    return Seen(colour, alpha > 0.5)


def distilled(folder, *line, is_random=False) -> Seen:
    """Train for a few steps and look at the result; a random network has lost what it had learned."""
    words = [f"prompt=a {COLOUR} {NOUN}", f"steps={STEPS}", "initializer.count=1500", "callback=[]", *line]
    cfg = compose([*words, f"camera.size={SIZE}", "densifier=none", "device=cpu"])
    trainer = build_trainer(cfg, torch.device("cpu"))
    if is_random:
        torch.manual_seed(0)
        for module in trainer.prior.network.modules():
            if hasattr(module, "reset_parameters"):
                module.reset_parameters()
    initializer = component(cfg.initializer, Initializer)
    state = trainer.start(cfg.prompt, initializer, cfg.seed, torch.device("cpu"))
    context = run_context(cfg.prompt, trainer, state, folder)
    trainer.train(state, trainer.prior.embed(cfg.prompt, ""), context)
    render = trainer.renderer(state)
    return seen(lambda cameras, background: render(cameras, background).rgb.clamp(0, 1))


@pytest.fixture(scope="module")
def truth() -> Seen:
    prior = component(compose(["prompt=a cube"]).prior)
    images = prior.truth(f"a {COLOUR} {NOUN}").images
    return seen(lambda cameras, background: images(cameras, background)[0])


@pytest.fixture(scope="module")
def control(tmp_path_factory) -> Seen:
    """The result of the same run with a random network."""
    folder = tmp_path_factory.mktemp("random")
    return distilled(folder, "prior=shapes_sd", f"prior.cache_dir={folder}", is_random=True)


@pytest.mark.parametrize("name", ["shapes_sd", "shapes_mvdream", "shapes_sd3"])
def test_a_trained_model_knows_colour_and_outline(name, truth, control, tmp_path):
    result = distilled(tmp_path, f"prior={name}", f"prior.cache_dir={tmp_path}")
    assert result.name() == COLOUR
    assert control.name() != COLOUR
    assert result.overlap(truth) > max(0.5, control.overlap(truth) + 0.15)
