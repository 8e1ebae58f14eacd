"""Measure what a live view costs training: without a page, and with an open one.

    python scripts/bench_live.py --counts 4000 50000

Blocks of steps take turns: without the callback and the control (off), with both (closed), and with both
while a thread does what an open page does (open). Other load on the machine affects all of them alike. The
numbers are medians over the blocks, in milliseconds of CPU time per step and in percent of the block "off".
"""

import argparse
import statistics
import tempfile
import threading
import time
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import torch

from cadam3d.callback.live import Live
from cadam3d.commands.control import Control
from cadam3d.commands.train import build_trainer, run_context
from cadam3d.io.live import touch_watched
from cadam3d.settings.compose import component, compose
from cadam3d.state import TrainState
from cadam3d.trainer import Trainer

POLL_SECONDS = 0.7  # as in the page
MODES = ("off", "closed", "open")


class Block:
    """Lets a number of steps pass and measures the seconds between the first and the last one."""

    def __init__(self, steps: int, control) -> None:
        self.left, self.control, self.times = steps, control, []

    def __call__(self) -> bool:
        stops = self.control()
        self.times.append(time.process_time())
        self.left -= 1
        return stops or self.left < 0

    @property
    def milliseconds(self) -> float:
        return 1000 * (self.times[-1] - self.times[0]) / (len(self.times) - 1)


def measure(trainer: Trainer, state: TrainState, embedding, folder: Path, mode: str, steps: int) -> float:
    context = run_context("bench", trainer, state, folder)
    callbacks = [] if mode == "off" else [Live(seconds=1.0, share=0.03)]
    control = (
        nullcontext(lambda: False) if mode == "off" else Control(folder, state, lambda: False, lambda: None)
    )
    closed = threading.Event()

    def watch() -> None:
        while mode == "open" and not closed.wait(POLL_SECONDS):
            touch_watched(folder)

    page = threading.Thread(target=watch)
    page.start()
    try:
        with control as asked:
            block = Block(steps, asked)
            replace(trainer, callbacks=callbacks).train(state, embedding, context, block)
    finally:
        closed.set()
        page.join()
    return block.milliseconds


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--counts", type=int, nargs="+", default=[4000, 50000], help="Gaussians")
    parser.add_argument("--seconds", type=float, default=8, help="of each block, about")
    parser.add_argument("--blocks", type=int, default=7, help="of each kind")
    options = parser.parse_args()
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    torch.set_num_threads(1)
    print("| Gaussians | off, ms per step | closed | open |\n|---|---|---|---|")
    for count in options.counts:
        prompt = "prompt=a snowman next to a pine"
        cfg = compose(
            [prompt, f"initializer.count={count}", "steps=1000000", "refine.start=900000", "callback=[]"]
        )
        trainer = build_trainer(cfg, device)
        trainer.rasterizer.prepare(device)
        embedding = trainer.prior.embed(cfg.prompt, "")
        state = trainer.start(cfg.prompt, component(cfg.initializer), 0, device)
        times: dict[str, list[float]] = {mode: [] for mode in MODES}
        with tempfile.TemporaryDirectory() as folder:
            place = Path(folder)
            pace = measure(trainer, state, embedding, place, "off", 5)
            steps = max(5, round(1000 * options.seconds / pace))
            for _ in range(options.blocks):
                for mode in MODES:
                    times[mode].append(measure(trainer, state, embedding, place, mode, steps))
        middle = {mode: statistics.median(each) for mode, each in times.items()}
        ratios = [
            statistics.median(b / a - 1 for a, b in zip(times["off"], times[mode], strict=True))
            for mode in ("closed", "open")
        ]
        cells = [
            f"{middle[mode]:.1f} ({ratio:+.1%})"
            for mode, ratio in zip(("closed", "open"), ratios, strict=True)
        ]
        print(f"| {count:,} | {middle['off']:.1f} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
