"""Draw docs/images/growth.webp: the baseline beside CAdam while they grow from the same seed, then one turn.

    python scripts/make_growth.py                  # trains both densifiers and draws
    python scripts/make_growth.py --work growth    # keeps the pictures there, and only draws if they exist

Both runs have the same prompt, seed, views and noise; only densifier= differs.
"""

import argparse
import tempfile
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8

from cadam3d.callback.base import Callback
from cadam3d.commands.train import build_trainer
from cadam3d.core.cameras import orbit
from cadam3d.core.render import RenderFn
from cadam3d.io.image import to_uint8
from cadam3d.settings.compose import component, compose
from cadam3d.state import RunContext, StepReport, TrainState

PROMPT = "a snowman next to a pine"
ARMS = ("baseline", "cadam")
STEPS = 600
EVERY = 10  # steps between two pictures
TURN = 48  # pictures of the turn at the end
SIZE = 640  # pixels of a picture before it is scaled down, which smooths it
DRIFT_DEG = (-35.0, 25.0)  # azimuth at the first and at the last step
ELEVATION_DEG = 18.0
CPU = torch.device("cpu")


@dataclass
class Growth:
    """What the recorder has seen of one run."""

    steps: list[int] = field(default_factory=list)
    counts: list[int] = field(default_factory=list)
    pictures: list[np.ndarray] = field(default_factory=list)


@dataclass(frozen=True, kw_only=True)
class Recorder(Callback):
    """Keep a picture and the number of Gaussians every few steps."""

    growth: Growth

    def on_start(self, context: RunContext, state: TrainState) -> None:
        """Record the Gaussians before the first step."""
        self._record(context.render, state)

    def on_step(self, context: RunContext, state: TrainState, report: StepReport) -> None:
        """Record the Gaussians at multiples of ``EVERY``."""
        if report.step % EVERY == 0:
            self._record(context.render, state)

    def _record(self, render: RenderFn, state: TrainState) -> None:
        share = state.step / STEPS
        azimuth_deg = DRIFT_DEG[0] + share * (DRIFT_DEG[1] - DRIFT_DEG[0])
        self.growth.steps.append(state.step)
        self.growth.counts.append(len(state.gaussians))
        self.growth.pictures.append(picture(render, azimuth_deg))


def picture(render: RenderFn, azimuth_deg: float) -> UInt8[np.ndarray, "h w 3"]:
    """Return the current Gaussians on white, seen from ``azimuth_deg``."""
    angles = [torch.tensor([angle]) for angle in (azimuth_deg, ELEVATION_DEG, 3.0, 38.0)]
    return to_uint8(render(orbit(*angles, SIZE, SIZE), torch.ones(1, 3)).rgb[0])


def train(arm: str, folder: Path) -> Growth:
    """Train with the densifier ``arm``, and return what it looked like, a turn of the result included."""
    cfg = compose([f"prompt={PROMPT}", f"densifier={arm}", f"steps={STEPS}", "camera.size=160"])
    growth = Growth()
    trainer = replace(build_trainer(cfg, CPU), callbacks=[Recorder(growth=growth)])
    trainer.prior.load()
    state = trainer.start(cfg.prompt, component(cfg.initializer), cfg.seed, CPU)
    render = trainer.renderer(state)
    context = RunContext(folder, cfg.prompt, trainer.steps, render, trainer.rasterizer)
    trainer.train(state, trainer.prior.embed(cfg.prompt, ""), context)
    for view in range(1, TURN + 1):
        growth.pictures.append(picture(render, DRIFT_DEG[1] + 360 * view / TURN))
    return growth


def recorded(arm: str, work: Path) -> Growth:
    """Return the growth of ``arm``, from ``work`` if it is there, else by training."""
    path = work / f"{arm}.npz"
    if not path.is_file():
        growth = train(arm, work)
        np.savez_compressed(
            path, steps=growth.steps, counts=growth.counts, pictures=np.stack(growth.pictures)
        )
    data = np.load(path)
    return Growth(data["steps"].tolist(), data["counts"].tolist(), list(data["pictures"]))


def main() -> None:
    """Train both, draw, and write the animation."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--work", type=Path, help="folder that keeps the pictures between calls")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as spare:
        work = options.work or Path(spare)
        work.mkdir(parents=True, exist_ok=True)
        growths = [recorded(arm, work) for arm in ARMS]


if __name__ == "__main__":
    main()
