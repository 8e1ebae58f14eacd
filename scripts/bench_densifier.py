"""Measure the cost of a densifier: the time of observe() as a share of a training step.

    python scripts/bench_densifier.py --densifiers cadam baseline --count 1000000 --size 512 --threads 1

A step here is render, loss, backward and Adam on a shell of Gaussians, without a prior. No training step is
cheaper, so the printed share is an upper bound. The other columns are the time of select(), which is called
at refinements only, and the bytes per Gaussian of the densifier's state.
"""

import statistics

import measuring
import torch
from omegaconf import OmegaConf
from rasterizer_bench.scenes import make_shell

from cadam3d.build import component
from cadam3d.core.cameras import turntable
from cadam3d.densifier.base import Densifier, GradientSignal
from cadam3d.optimizer import GaussianOptimizer
from cadam3d.rasterizer.base import Rasterizer
from cadam3d.settings.compose import compose
from cadam3d.settings.options import config_dir


def train_step(
    optimizer: GaussianOptimizer, rasterizer: Rasterizer, size: int, views: int, step: int
) -> GradientSignal:
    """Do one optimization step and return the signal that a densifier would observe."""
    gaussians = optimizer.gaussians
    cameras = turntable(views, elevation_deg=20.0, distance=3.0, fov_y_deg=40.0, size=size)
    background = torch.ones(views, 3, device=gaussians.device)
    output = rasterizer.render(gaussians, cameras.to(gaussians.device), background)
    output.rgb.square().mean().backward()
    assert gaussians.means.grad is not None
    assert output.means2d.grad is not None
    means, means2d = gaussians.means.grad.clone(), output.means2d.grad.clone()
    optimizer.step(step)
    return GradientSignal(means=means, means2d=means2d, radii=output.radii, height=size, width=size)


def measure(densifier: Densifier, step_ms: float, signal: GradientSignal, repeats: int) -> dict[str, str]:
    """Return the times and the bytes of one densifier, beside a step that takes ``step_ms``."""
    n, device, draw = signal.means.shape[0], signal.means.device, torch.Generator()
    state = densifier.observe(densifier.init_state(n, device), signal)
    works = {
        "observe": lambda: measuring.milliseconds(lambda: densifier.observe(state, signal), device),
        "select": lambda: measuring.milliseconds(lambda: densifier.select(state, 100, draw), device),
    }
    found = {name: statistics.median(times) for name, times in measuring.in_turns(works, repeats).items()}
    return {
        "observe ms": f"{found['observe']:.2f}",
        "of a step": f"{found['observe'] / (step_ms + found['observe']):.2%}",
        "select ms": f"{found['select']:.1f}",
        "state B per Gaussian": str(sum(rows.nbytes for rows in state.to_dict().values()) // n),
    }


def main(words: list[str] | None = None) -> None:
    """Print the table."""
    parser = measuring.parser_of(__doc__)
    parser.add_argument("--densifiers", nargs="+", default=["cadam", "baseline"], help="of configs/densifier")
    parser.add_argument("--rasterizer", default="cpu", help="of configs/rasterizer")
    parser.add_argument("--count", type=measuring.positive, default=1_000_000, help="number of Gaussians")
    parser.add_argument("--size", type=measuring.positive, default=512, help="image size in pixels")
    parser.add_argument("--views", type=measuring.positive, default=2, help="per step")
    parser.add_argument("--repeats", type=measuring.positive, default=10)
    parser.add_argument("--threads", type=measuring.positive, default=1)
    parser.add_argument("--device", type=torch.device, default=torch.device("cpu"))
    args = parser.parse_args(words)
    torch.set_num_threads(args.threads)
    rasterizer = component(OmegaConf.load(config_dir() / "rasterizer" / f"{args.rasterizer}.yaml"))
    settings = component(compose(["prompt=bench"]).optimizer)
    optimizer = settings.start(make_shell(args.count, 0, args.device).detach())
    # The first step also warms up the rasterizer and is not timed.
    signal = train_step(optimizer, rasterizer, args.size, args.views, 0)

    def step() -> None:
        train_step(optimizer, rasterizer, args.size, args.views, 1)

    times = [measuring.milliseconds(step, args.device) for _ in range(max(3, args.repeats // 3))]
    step_ms = statistics.median(times)
    scene = f"{args.count:,} Gaussians, {args.views} view(s) of {args.size} px, {args.rasterizer}"
    print(f"{scene}, {args.threads} thread(s); a step without densifier takes {step_ms:.1f} ms\n")
    rows = []
    for name in args.densifiers:
        densifier = component(compose(["prompt=bench", f"densifier={name}"]).densifier)
        rows.append({"densifier": name, **measure(densifier, step_ms, signal, args.repeats)})
    print(measuring.table(rows))


if __name__ == "__main__":
    main()
