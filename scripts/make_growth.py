"""Draw docs/images/growth.webp: the baseline beside CAdam while they grow from the same seed, then one turn.

    python scripts/make_growth.py

Both runs have the same prompt, seed, views and noise; only densifier= differs. Training takes two minutes on
two cores, and drawing about as long.
"""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8
from PIL import Image, ImageDraw

from cadam3d.build import build_trainer, component
from cadam3d.callback.base import Callback
from cadam3d.commands.beginning import run_context
from cadam3d.core.cameras import orbit
from cadam3d.core.palette import INK, LINE, PAPER, SOFT
from cadam3d.core.rendering import RenderFn
from cadam3d.io.atomic import replacing
from cadam3d.io.caption import BOLD, REGULAR, font
from cadam3d.io.image import to_uint8
from cadam3d.report.style import looks
from cadam3d.settings.compose import compose
from cadam3d.state import RunContext, StepReport, TrainState

PROMPT = "a cupcake"
ARMS = ("baseline", "cadam")
STEPS = 600
EVERY = 10  # steps between two pictures
TURN = 48  # pictures of the turn at the end
SIZE = 640  # pixels of a picture before it is scaled down, which smooths it
DRIFT_DEG = (-35.0, 25.0)  # azimuth at the first and at the last step
ELEVATION_DEG = 18.0
CPU = torch.device("cpu")
QUALITY = 85  # of the WebP file, up to 100
NAMES = {"baseline": "baseline (3DGS)", "cadam": "CAdam"}
OUTPUT = Path(__file__).parent.parent / "docs" / "images" / "growth.webp"

# Frames are drawn at twice their size. These are pixels of the large ones.
WIDTH, HEIGHT = 1440, 944
CROP = (0, 50, 640, 590)  # of a picture: left, top, right, bottom
PANEL = (704, 594)
CHART = (40, 752, 1400, 892)  # left, top, right, bottom
# Milliseconds that a frame stays: the first, those of the growth, the last of these, and those of the turn.
FIRST_MS, GROWTH_MS, GROWN_MS, TURN_MS = 700, 90, 1500, 75


@dataclass
class Growth:
    """The records of one run, and pictures of its result from all sides."""

    steps: list[int] = field(default_factory=list)
    counts: list[int] = field(default_factory=list)  # Gaussians after each of these steps
    pictures: list[np.ndarray] = field(default_factory=list)  # one per step, then those of the turn


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
    """Train with the densifier ``arm``, and return its records and a turn of the result."""
    cfg = compose([f"prompt={PROMPT}", f"densifier={arm}", f"steps={STEPS}", "camera.size=160"])
    growth = Growth()
    trainer = replace(build_trainer(cfg, CPU), callbacks=[Recorder(growth=growth)])
    trainer.prior.load()
    state = trainer.start(cfg.prompt, component(cfg.initializer), cfg.seed, CPU)
    context = run_context(cfg.prompt, trainer, state, folder)
    trainer.train(state, trainer.prior.embed(cfg.prompt, ""), context)
    for view in range(1, TURN + 1):
        growth.pictures.append(picture(context.render, DRIFT_DEG[1] + 360 * view / TURN))
    return growth


def draw(growths: Sequence[Growth]) -> tuple[list[Image.Image], list[int]]:
    """Return the frames of the animation, and how long each one stays, in milliseconds."""
    frames, grown = [], len(growths[0].steps)
    for index in range(len(growths[0].pictures)):
        shown = min(index, grown - 1)
        frame = Image.new("RGB", (WIDTH, HEIGHT), PAPER)
        for column, (arm, growth) in enumerate(zip(ARMS, growths, strict=True)):
            panel = Image.fromarray(growth.pictures[index]).crop(CROP).resize(PANEL, Image.Resampling.LANCZOS)
            frame.paste(panel, (8 + column * 720, 0))
            middle = 360 + column * 720
            write(frame, (middle, 606), NAMES[arm], 34, looks(ARMS)[arm].color, bold=True)
            write(frame, (middle, 652), f"{growth.counts[shown]:,} Gaussians", 46, INK, bold=True)
        draw_chart(frame, growths, shown)
        frames.append(frame.resize((WIDTH // 2, HEIGHT // 2), Image.Resampling.LANCZOS))
    growth_ms = [FIRST_MS, *[GROWTH_MS] * (grown - 2), GROWN_MS]
    return frames, [*growth_ms, *[TURN_MS] * (len(frames) - grown)]


def draw_chart(frame: Image.Image, growths: Sequence[Growth], shown: int) -> None:
    """Draw the numbers of Gaussians up to the record ``shown`` below the pictures, from zero upwards."""
    left, top, right, bottom = CHART
    pen = ImageDraw.Draw(frame)
    pen.line([(left, bottom), (right, bottom)], fill=LINE, width=3)
    most = max(max(growth.counts) for growth in growths)
    for arm, growth in zip(ARMS, growths, strict=True):
        points = [
            (left + (right - left) * step / STEPS, bottom - (bottom - top) * count / most)
            for step, count in zip(growth.steps, growth.counts, strict=True)
        ][: shown + 1]
        color, (x, y) = looks(ARMS)[arm].color, points[-1]
        if len(points) > 1:
            pen.line(points, fill=color, width=6, joint="curve")
        pen.ellipse([x - 9, y - 9, x + 9, y + 9], fill=color)
    write(frame, (left, bottom + 12), "number of Gaussians", 24, SOFT, anchor="la")
    write(frame, (right, bottom + 12), f"step {growths[0].steps[shown]} of {STEPS}", 24, SOFT, anchor="ra")


def write(
    frame: Image.Image,
    place: tuple[int, int],
    text: str,
    size: int,
    color: str,
    *,
    bold: bool = False,
    anchor: str = "ma",
) -> None:
    """Write one line; ``anchor`` is the part of it that is at ``place``, in Pillow's letters."""
    letters = font(BOLD if bold else REGULAR, size)
    ImageDraw.Draw(frame).text(place, text, fill=color, font=letters, anchor=anchor)


def main() -> None:
    """Train both, draw, and write the animation."""
    with tempfile.TemporaryDirectory() as folder:
        frames, durations = draw([train(arm, Path(folder)) for arm in ARMS])
    rest = {"append_images": frames[1:], "duration": durations, "loop": 0}
    with replacing(OUTPUT) as temporary:
        frames[0].save(temporary, save_all=True, quality=QUALITY, method=6, **rest)
    print(f"{OUTPUT}: {len(frames)} frames, {OUTPUT.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
