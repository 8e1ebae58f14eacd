"""Measure the cost of a densifier: the time of observe() as a share of a training step.

    python scripts/bench_densifier.py --densifiers cadam baseline --count 1000000 --size 512 --threads 1

A step here is render, loss, backward and Adam on a shell of Gaussians, without a prior. No training step is
cheaper, so the printed share is an upper bound. The other columns are the time of select(), which is called
at refinements only, and the largest number of bytes per Gaussian that observe() allocates, including the new
state. One CPU thread is timed by its own clock, which excludes other processes.
"""

import argparse
import math
import statistics
import time
import weakref
from collections.abc import Callable

import torch
from omegaconf import OmegaConf
from torch.utils._python_dispatch import TorchDispatchMode

from cadam3d.build import component
from cadam3d.core.cameras import turntable
from cadam3d.core.gaussians import Gaussians
from cadam3d.densifier.base import Densifier, GradientSignal
from cadam3d.optimizer import GaussianOptimizer
from cadam3d.rasterizer.base import Rasterizer
from cadam3d.settings.compose import compose
from cadam3d.settings.options import config_dir

RADIUS = 0.6  # world units, of the shell


def shell(count: int) -> Gaussians:
    """Return Gaussians on a sphere, about as large as the distance between neighbours."""
    draw = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=draw), dim=-1)
    spacing = math.sqrt(4 * math.pi * RADIUS**2 / count)
    return Gaussians(
        means=RADIUS * directions,
        log_scales=math.log(0.7 * spacing) + 0.3 * torch.randn(count, 3, generator=draw),
        quats=torch.randn(count, 4, generator=draw),
        opacity_logits=torch.randn(count, generator=draw),
        sh=0.5 * torch.randn(count, 1, 3, generator=draw),
    )


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


def milliseconds(work: Callable[[], object], device: torch.device) -> float:
    """Return the time of ``work``: that of the CPU clock for a single thread, or else the wall-clock time."""

    def now() -> float:
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        is_one_thread = device.type == "cpu" and torch.get_num_threads() == 1
        return time.process_time() if is_one_thread else time.perf_counter()

    start = now()
    work()
    return (now() - start) * 1e3


class MemoryCounter(TorchDispatchMode):
    """Counts the bytes of the tensors that were created in its context and still exist, and their peak."""

    def __init__(self) -> None:
        super().__init__()
        self.bytes = self.peak = 0
        self.known: set[int] = set()

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        given = {t.untyped_storage()._cdata for t in args if isinstance(t, torch.Tensor)}
        result = func(*args, **(kwargs or {}))
        for tensor in result if isinstance(result, tuple | list) else [result]:
            storage = tensor.untyped_storage()
            if storage._cdata not in given | self.known:
                self.known.add(storage._cdata)
                self.bytes += storage.nbytes()
                weakref.finalize(storage, self.subtract, storage._cdata, storage.nbytes())
        self.peak = max(self.peak, self.bytes)
        return result

    def subtract(self, key: int, size: int) -> None:
        self.known.discard(key)
        self.bytes -= size


def measure(densifier: Densifier, steps: list[float], signal: GradientSignal, repeats: int) -> str:
    """Return one row of the table; ``steps`` are the times of training steps in milliseconds."""
    n, device, draw = signal.means.shape[0], signal.means.device, torch.Generator()
    state = densifier.observe(densifier.init_state(n, device), signal)
    with MemoryCounter() as memory:
        densifier.observe(state, signal)
    observing = [milliseconds(lambda: densifier.observe(state, signal), device) for _ in range(repeats)]
    selecting = [milliseconds(lambda: densifier.select(state, 100, draw), device) for _ in range(3)]
    observe, step = statistics.median(observing), statistics.median(steps)
    state_bytes = sum(rows.nbytes for rows in state.to_dict().values()) // n
    return (
        f"{observe:>11.2f} {100 * observe / (step + observe):>9.2f} % {statistics.median(selecting):>10.1f}"
        f" {state_bytes:>8} {memory.peak // n:>8}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--densifiers", nargs="+", default=["cadam", "baseline"], help="of configs/densifier")
    parser.add_argument("--rasterizer", default="cpu", help="of configs/rasterizer")
    parser.add_argument("--count", type=int, default=1_000_000, help="number of Gaussians")
    parser.add_argument("--size", type=int, default=512, help="image size in pixels")
    parser.add_argument("--views", type=int, default=2, help="per step")
    parser.add_argument("--repeats", type=int, default=10)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--device", type=torch.device, default=torch.device("cpu"))
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    rasterizer = component(OmegaConf.load(config_dir() / "rasterizer" / f"{args.rasterizer}.yaml"))
    settings = component(compose(["prompt=bench"]).optimizer)
    optimizer = settings.start(shell(args.count).to(args.device))
    # The first step also warms up the rasterizer and is not timed.
    signal = train_step(optimizer, rasterizer, args.size, args.views, 0)
    steps = [
        milliseconds(lambda: train_step(optimizer, rasterizer, args.size, args.views, 1), args.device)
        for _ in range(max(3, args.repeats // 3))
    ]
    print(
        f"{args.count:,} Gaussians, {args.views} view(s) of {args.size} px, "
        f"{args.rasterizer}, {args.threads} thread(s)"
    )
    print(f"step without densifier: {statistics.median(steps):.1f} ms")
    print(
        f"{'densifier':>18} {'observe ms':>11} {'of a step':>11} {'select ms':>10} "
        f"{'state B':>8} {'peak B':>8}"
    )
    for name in args.densifiers:
        densifier = component(compose(["prompt=bench", f"densifier={name}"]).densifier)
        print(f"{name:>18} {measure(densifier, steps, signal, args.repeats)}", flush=True)


if __name__ == "__main__":
    main()
