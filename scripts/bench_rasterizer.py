"""Time rasterizers against one another in one process: forward, and forward plus backward.

    python scripts/bench_rasterizer.py --backends reference cpu --counts 3000 10000 --sizes 128 256

The scene is a bumpy shell of Gaussians whose size follows their spacing, seen from all around, with a loss on
colour, alpha and depth. Backends take turns within each repetition, so that whatever else the machine does
hits them alike. Reported are medians; the ratio is to the first backend.
"""

import argparse
import json
import math
import platform
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import torch
from omegaconf import OmegaConf

from cadam3d.core.cameras import Cameras, turntable
from cadam3d.core.gaussians import Gaussians
from cadam3d.rasterizer.base import Rasterizer
from cadam3d.settings import component, config_dir

RADIUS = 0.6  # world units, of the shell


def shell(count: int, degree: int, device: torch.device) -> Gaussians:
    """Splats on a bumpy sphere, about as large as the distance to the next one."""
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    directions = torch.nn.functional.normalize(normal(count, 3), dim=-1)
    spacing = math.sqrt(4 * math.pi * RADIUS**2 / count)
    gaussians = Gaussians(
        means=directions * (RADIUS + 0.05 * normal(count, 1)),
        log_scales=math.log(0.7 * spacing) + 0.3 * normal(count, 3),
        quats=normal(count, 4),
        opacity_logits=0.4 + normal(count),
        sh=0.5 * normal(count, (degree + 1) ** 2, 3),
    )
    return gaussians.to(device).map(lambda tensor: tensor.requires_grad_())


def forward(rasterizer: Rasterizer, gaussians: Gaussians, cameras: Cameras) -> None:
    with torch.no_grad():
        rasterizer.render(gaussians, cameras, torch.ones(len(cameras), 3, device=gaussians.device))


def forward_backward(rasterizer: Rasterizer, gaussians: Gaussians, cameras: Cameras) -> None:
    output = rasterizer.render(gaussians, cameras, torch.ones(len(cameras), 3, device=gaussians.device))
    (output.rgb.square().sum() + output.alpha.sum() + output.depth.sum()).backward()


def milliseconds(work: Callable[[], None], device: torch.device) -> float:
    def now() -> float:
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        return time.perf_counter()

    start = now()
    work()
    return (now() - start) * 1e3


def processor() -> str:
    """The name of the CPU, as well as it can be known."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def measure(
    backends: dict[str, Rasterizer], gaussians: Gaussians, cameras: Cameras, repeats: int
) -> list[dict]:
    """One row per backend, for one scene; the first, uncounted round warms up."""
    times: dict[str, tuple[list[float], list[float]]] = {name: ([], []) for name in backends}
    for repeat in range(repeats + 1):
        for name, rasterizer in backends.items():
            for work, samples in zip((forward, forward_backward), times[name], strict=True):
                taken = milliseconds(lambda: work(rasterizer, gaussians, cameras), gaussians.device)  # noqa: B023
                if repeat > 0:
                    samples.append(taken)
    first = statistics.median(times[next(iter(backends))][1])
    return [
        {
            "count": len(gaussians),
            "size": cameras.height,
            "backend": name,
            "forward_ms": statistics.median(times[name][0]),
            "forward_backward_ms": statistics.median(times[name][1]),
            "forward_backward_min_ms": min(times[name][1]),
            "speedup": first / statistics.median(times[name][1]),
        }
        for name in backends
    ]


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--backends", nargs="+", default=["reference"], help="names from configs/rasterizer")
    parser.add_argument("--counts", nargs="+", type=int, default=[3000], help="numbers of Gaussians")
    parser.add_argument("--sizes", nargs="+", type=int, default=[128], help="image sizes in pixels")
    parser.add_argument("--views", type=int, default=1)
    parser.add_argument("--degree", type=int, default=0, choices=range(4), help="of the spherical harmonics")
    parser.add_argument("--repeats", type=int, default=10)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--device", type=torch.device, default=torch.device("cpu"))
    parser.add_argument("--json", type=Path, help="also write the numbers to this file")
    return parser.parse_args()


def main() -> None:
    args = parse()
    torch.set_num_threads(args.threads)
    folder = config_dir() / "rasterizer"
    backends = {name: component(OmegaConf.load(folder / f"{name}.yaml")) for name in args.backends}
    print(f"{args.views} view(s), SH degree {args.degree}, {args.threads} thread(s), {args.device}")
    print(f"{'N':>9} {'pixels':>7} {'backend':>12} {'forward ms':>11} {'fwd+bwd ms':>11} {'ratio':>7}")
    rows = []
    for count in args.counts:
        gaussians = shell(count, args.degree, args.device)
        for size in args.sizes:
            cameras = turntable(args.views, elevation_deg=20.0, distance=3.0, fov_y_deg=40.0, size=size)
            for row in measure(backends, gaussians, cameras.to(args.device), args.repeats):
                rows.append(row)
                print(
                    f"{row['count']:>9} {row['size']:>7} {row['backend']:>12} {row['forward_ms']:>11.2f} "
                    f"{row['forward_backward_ms']:>11.2f} {row['speedup']:>6.2f}x",
                    flush=True,
                )
    if args.json:
        on_cuda = args.device.type == "cuda"
        setting = {name: getattr(args, name) for name in ("views", "degree", "threads", "repeats")}
        setting["device"] = torch.cuda.get_device_name(args.device) if on_cuda else processor()
        setting["torch"] = torch.__version__
        args.json.write_text(json.dumps({"setting": setting, "rows": rows}, indent=2) + "\n")


if __name__ == "__main__":
    main()
