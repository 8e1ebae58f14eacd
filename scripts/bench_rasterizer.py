"""Check rasterizers against the reference and then compare their speed, in one process.

    python scripts/bench_rasterizer.py                  # this CPU: reference and cpu
    python scripts/bench_rasterizer.py --device cuda    # this GPU: cuda, stage by stage, beside gsplat
    python scripts/bench_rasterizer.py --backends cpu --counts 1000000 --threads 1 2 --no-check

A backend that disagrees with the reference, or with itself from run to run, is not timed. The script prints
the differences, times the other backends, and ends with exit code 1. Times are medians in milliseconds. The
ratio is the time of a step of the first backend divided by that of the row's backend.
docs/notes/performance.md describes the measurement.
"""

import argparse
import os
import sys
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

# The script measures the package that it stands beside, from any folder.
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from cadam3d.core.openmp import waiting

# As on the command line, and before torch is loaded: idle threads of torch leave the processor to others.
os.environ.update(waiting(os.environ))

import measuring
import torch
from omegaconf import OmegaConf
from rasterizer_bench.check import check, check_long_sort
from rasterizer_bench.scenes import make_scene, make_shell
from rasterizer_bench.stages import time_cpu_stages, time_stages
from rasterizer_bench.timing import OUT_OF_MEMORY, take_turns

from cadam3d.build import component
from cadam3d.core.errors import UserError
from cadam3d.rasterizer.base import Rasterizer
from cadam3d.rasterizer.cuda import load_kernels
from cadam3d.rasterizer.driver import Launcher
from cadam3d.settings.options import config_dir, option_names

DEFAULTS = {
    "cpu": {
        "backends": ["reference", "cpu"],
        "counts": [3_000, 10_000],
        "sizes": [128, 256],
        "views": [1],
        "degrees": [0],
    },
    "cuda": {
        "backends": ["gsplat", "cuda"],
        "counts": [20_000, 100_000, 500_000, 1_000_000, 3_400_000],
        "sizes": [512, 1024],
        "views": [1, 4],
        "degrees": [0, 3],
    },
}
# A yardstick that is optional: it is skipped where it cannot run.
GSPLAT = "gsplat"
# Keys; more than a counter of 27 bits can count.
LONG_SORT = 2**27 + 1


def parse(words: Sequence[str] | None = None) -> argparse.Namespace:
    """Parse the command line, and fill in the defaults of the device."""
    parser = measuring.parser_of(__doc__)
    several = {"nargs": "+", "metavar": "N", "type": measuring.positive}
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument(
        "--backends", nargs="+", choices=option_names("rasterizer"), help="ratios: to the first"
    )
    parser.add_argument("--counts", **several, help="numbers of Gaussians")
    parser.add_argument("--sizes", **several, help="sizes of the square images, in pixels")
    parser.add_argument("--views", **several, help="numbers of views rendered at once")
    parser.add_argument("--degrees", type=int, choices=range(4), nargs="+", help="of spherical harmonics")
    parser.add_argument("--repeats", type=measuring.positive, default=10, metavar="N")
    # With more threads, other load on the machine affects every number.
    parser.add_argument("--threads", **several, default=[1])
    parser.add_argument("--check", action=argparse.BooleanOptionalAction, default=True)
    parser.add_argument("--check-only", action="store_true", help="check the backends without timing them")
    parser.add_argument(
        "--stages", action=argparse.BooleanOptionalAction, default=True, help="of cuda and cpu"
    )
    parser.add_argument("--json", type=measuring.new_file, metavar="FILE", help="also write all results")
    args = parser.parse_args(words)
    for name, value in DEFAULTS[args.device].items():
        if getattr(args, name) is None:
            setattr(args, name, value)
    return args


def make_backends(names: Sequence[str], device: torch.device) -> dict[str, Rasterizer]:
    """Return the backends by name, without gsplat if it cannot run.

    Raises :class:`UserError` if none is left.
    """
    backends: dict[str, Rasterizer] = {}
    for name in names:
        rasterizer: Rasterizer = component(OmegaConf.load(config_dir() / "rasterizer" / f"{name}.yaml"))
        if name == GSPLAT:
            try:
                rasterizer.prepare(device)
            except UserError as error:
                print(f"gsplat is skipped: {error}", flush=True)
                continue
        backends[name] = rasterizer
    if not backends:
        raise UserError("no backend is left. Try: --backends cuda")
    return backends


def check_all(
    backends: dict[str, Rasterizer], launcher: Launcher | None, device: torch.device
) -> dict[str, Rasterizer]:
    """Return the backends that agree with the reference, and print the verdict for each."""
    agreeing: dict[str, Rasterizer] = {}
    for name, rasterizer in backends.items():
        problems = check(name, rasterizer, device)
        if launcher and name == device.type == "cuda":
            try:
                problems += check_long_sort(launcher, device, LONG_SORT)
            except OUT_OF_MEMORY:
                print(f"not enough memory to check a sort of {LONG_SORT} keys")
        if not problems:
            agreeing[name] = rasterizer
        verdict = "agrees with the reference" if not problems else "FAILED, not timed"
        print(f"check {name}: {verdict}", *problems, sep="\n  ", flush=True)
    return agreeing


def time_all(args: argparse.Namespace, backends: dict[str, Rasterizer], launcher: Launcher | None) -> None:
    """Time the backends on every scene, print the results, and write them to the JSON file."""
    device = torch.device(args.device)
    report: dict[str, Any] = {"machine": measuring.machine(device), "rows": [], "stages": []}
    report["settings"] = {name: value for name, value in vars(args).items() if name != "json"}
    print(f"{report['machine']['name']}, {args.repeats} repetitions; milliseconds")
    for degree, count in product(args.degrees, args.counts):
        gaussians = make_shell(count, degree, device)
        for size, views, threads in product(args.sizes, args.views, args.threads):
            torch.set_num_threads(threads)
            at = {"count": count, "size": size, "views": views, "degree": degree, "threads": threads}
            scene = make_scene(gaussians, size, views)
            timings = take_turns(backends, scene, args.repeats)
            report["rows"] += make_rows(at, timings)
            print_table(make_rows(at, timings))
            timing = None
            if args.stages and launcher is not None and timings["cuda"]:
                timing = time_stages(launcher, scene, args.repeats)
            elif args.stages and timings.get("cpu"):
                timing = time_cpu_stages(backends["cpu"], scene, args.repeats)
            if timing is not None:
                print_table(timing.stages)
                report["stages"].append(at | vars(timing))
            # The file is written after every scene, because a later one may exceed the memory.
            measuring.write(args.json, report)


def make_rows(at: dict[str, int], timings: dict[str, dict[str, Any] | None]) -> list[dict[str, Any]]:
    """Return the times of each backend on one scene, in milliseconds; ``None`` if it ran out of memory."""
    first = next(iter(timings.values()))
    rows = []
    for name, timing in timings.items():
        row: dict[str, Any] = {**at, "backend": name, "step_ms": None, **(timing or {})}
        if timing is not None and first is not None:
            row["ratio"] = first["step_ms"] / timing["step_ms"]
        rows.append(row)
    return rows


def print_table(rows: list[dict[str, Any]]) -> None:
    """Print rows with their numbers as text."""
    shown = [
        {key: f"{value:.3f}" if isinstance(value, float) else value for key, value in row.items()}
        for row in rows
    ]
    print(f"\n{measuring.table(shown)}", flush=True)


def run(args: argparse.Namespace, backends: dict[str, Rasterizer], launcher: Launcher | None) -> int:
    """Check and time the backends, and return the exit code.

    ``launcher`` is that of the backend ``cuda``. If it is given, the stages of that backend are timed too.
    """
    torch.set_num_threads(args.threads[0])
    good = check_all(backends, launcher, torch.device(args.device)) if args.check else backends
    if good and not args.check_only:
        time_all(args, good, launcher if "cuda" in good else None)
    return 0 if len(good) == len(backends) else 1


def main(words: Sequence[str] | None = None) -> int:
    """Return the exit code."""
    args = parse(words)
    try:
        if args.device == "cuda" and not torch.cuda.is_available():
            raise UserError("--device cuda: torch sees no CUDA device. Try: nvidia-smi, or --device cpu")
        backends = make_backends(args.backends, torch.device(args.device))
        return run(args, backends, load_kernels(None) if "cuda" in backends else None)
    except UserError as error:
        print(f"bench_rasterizer: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
