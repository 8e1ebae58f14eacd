"""Measure what a live view costs training: without a page, and with an open one.

    python scripts/bench_live.py --counts 4000 50000

Everything is measured in one process and in CPU time, so that other load on the machine matters little: a
step, a look for requests and for an open page, and a snapshot for an open page. A run looks for requests four
times a second and writes one snapshot a second, or fewer if these would take more than their share.
"""

import statistics
import tempfile
from collections.abc import Callable
from pathlib import Path

import measuring
import torch

from cadam3d.build import build_trainer, component
from cadam3d.callback.live import Live
from cadam3d.commands import control
from cadam3d.commands.beginning import run_context
from cadam3d.commands.control import Control
from cadam3d.io.live import touch_watched
from cadam3d.settings.compose import compose
from cadam3d.state import StepReport

LOOKS = 1 / control.LOOK_SECONDS  # per second


def milliseconds(work: Callable[[], object], times: int, repeats: int) -> float:
    """Return the median CPU time of ``work``, over ``repeats`` measurements of ``times`` calls."""
    device = torch.device("cpu")
    measured = [measuring.milliseconds(work, device, times) for _ in range(repeats + 1)]
    return statistics.median(measured[1:])


def measure(count: int, share: float, folder: Path, device: torch.device) -> dict[str, str]:
    """Return one row of the table."""
    words = ["prompt=a snowman next to a pine", f"initializer.count={count}", "callback=[]"]
    cfg = compose([*words, "steps=1000000", "refine.start=900000"])
    trainer = build_trainer(cfg, device)
    trainer.rasterizer.prepare(device)
    embedding = trainer.prior.embed(cfg.prompt, "")
    state = trainer.start(cfg.prompt, component(cfg.initializer), 0, device)
    context = run_context(cfg.prompt, trainer, state, folder)
    step = milliseconds(lambda: trainer.step(state, embedding), times=3, repeats=5)

    report = StepReport(step=state.step, loss=1.0, log={}, num_gaussians=count)
    live = Live(seconds=0.1, share=share)
    stop = Control(folder, state, lambda: False, lambda: None)
    live.on_start(context, state)

    def after_step() -> None:
        live.on_step(context, state, report)
        stop()

    between = milliseconds(after_step, times=2000, repeats=5)
    # From here on, every call looks.
    control.LOOK_SECONDS = stop._look_at = 0.0
    look = milliseconds(after_step, times=500, repeats=5)
    closed = between / step + LOOKS * look / 1000

    def snapshot() -> None:
        touch_watched(folder)
        state.step += 1
        live._due = 0.0
        live.on_step(context, state, report)

    shown = milliseconds(snapshot, times=1, repeats=7)
    size = (folder / "live/snapshot.bin").stat().st_size
    control.LOOK_SECONDS = 1 / LOOKS
    every = max(1.0, shown / 1000 / share)
    return {
        "Gaussians": f"{count:,}",
        "step, ms": f"{step:.1f}",
        "no page": f"{closed:.3%}",
        "snapshot, ms": f"{shown:.1f}",
        "MB": f"{size / 1e6:.2f}",
        "seconds between": f"{every:.1f}",
        "open page": f"{shown / 1000 / every:.1%}",
    }


def main() -> None:
    parser = measuring.parser_of(__doc__)
    parser.add_argument(
        "--counts", type=measuring.positive, nargs="+", default=[4000, 50000], help="Gaussians"
    )
    options = parser.parse_args()
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    share = compose(["prompt=a red cube"]).callback.live.share
    torch.set_num_threads(1)
    rows = []
    for count in options.counts:
        with tempfile.TemporaryDirectory() as folder:
            rows.append(measure(count, share, Path(folder), device))
    print(measuring.table(rows))


if __name__ == "__main__":
    main()
