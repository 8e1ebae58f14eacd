"""Measure rasterizer=cpu on large scenes: stages, threads and memory, here and in another checkout.

    python scripts/bench_large.py
    python scripts/bench_large.py --base ../cadam3d-before
    python scripts/bench_large.py --memory --counts 1000000 --views 1 2

A pass is a render and its backward pass through Python and autograd, with prepared gradients of colour, alpha
and depth. Every scene is rendered in processes of its own. The processes of both checkouts and all numbers of
threads take turns, so that other load on the machine slows all alike. Times are medians of the wall clock in
milliseconds.

With --memory, the table shows how far a pass raises the peak of resident memory of its process.
"""

import argparse
import ctypes
import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import measuring

SCRIPTS = Path(__file__).resolve().parent
# Passes of a process. The first ones are not counted, because they get memory from the system.
PASSES, WARM_UP = 3, 2
# The stages of a pass, in the order of ``enum Stage`` in cadam3d/rasterizer/kernels/cpu.cpp.
STAGES = ("project", "order", "lists", "blend", "blend backward", "gather", "centre backward")


@dataclass(frozen=True)
class Case:
    """One scene."""

    count: int  # Gaussians
    size: int  # pixels along an edge
    views: int
    degree: int  # of spherical harmonics


def start(tree: Path, case: Case, threads: int, do: str) -> dict[str, Any]:
    """Return what :func:`measure_pass` or :func:`measure_peak` returns in a process with a checkout."""
    # As the command line sets it: threads of torch that spin would take the processor from the others.
    waiting = {"OMP_WAIT_POLICY": "PASSIVE", "GOMP_SPINCOUNT": "3000"}
    environment = waiting | os.environ | {"PYTHONPATH": f"{tree}{os.pathsep}{SCRIPTS}"}
    command = [sys.executable, str(Path(__file__).resolve()), "--worker", do]
    command += [f"--counts={case.count}", f"--sizes={case.size}", f"--views={case.views}"]
    command += [f"--degree={case.degree}", f"--threads={threads}"]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, env=environment, check=False)
    if done.returncode:
        raise SystemExit(f"{case}: the process ended with exit code {done.returncode}")
    return json.loads(done.stdout)


def main(words: Sequence[str] | None = None) -> None:
    """Print the tables, and write all numbers."""
    args = read_arguments(words)
    cases = [Case(n, size, v, args.degree) for n in args.counts for size in args.sizes for v in args.views]
    if args.worker:
        work = {"pass": measure_pass, "peak": measure_peak}[args.worker]
        print(json.dumps(work(cases[0], args.threads[0])))
        return
    trees = measuring.find_trees(args.base)
    measure = measure_memory if args.memory else measure_times
    measuring.write(args.json, {"machine": measuring.machine(), **measure(cases, trees, args)})


def read_arguments(words: Sequence[str] | None) -> argparse.Namespace:
    """Parse the command line."""
    parser = measuring.parser_of(__doc__)
    several = {"type": measuring.positive, "nargs": "+"}
    parser.add_argument("--counts", **several, default=[10_000, 100_000, 1_000_000])
    parser.add_argument("--sizes", **several, default=[256, 512, 1024], help="pixels along an edge")
    parser.add_argument("--views", **several, default=[1])
    parser.add_argument("--degree", type=int, default=0, choices=range(4), help="of spherical harmonics")
    parser.add_argument("--threads", **several, default=[1, 2])
    parser.add_argument("--repeats", type=measuring.positive, default=3, help="processes of each kind")
    measuring.add_base(parser)
    parser.add_argument("--memory", action="store_true", help="measure memory instead of time")
    parser.add_argument("--json", type=measuring.new_file, help="also write the numbers to this file")
    parser.add_argument("--worker", choices=("pass", "peak"), help=argparse.SUPPRESS)
    return parser.parse_args(words)


def measure_times(cases: Sequence[Case], trees: dict[str, Path], args: argparse.Namespace) -> dict[str, Any]:
    """Measure, print and return the times of all scenes, and of the stages in this checkout."""
    found, rows = [], []
    for case in cases:
        works = {
            f"{name}, {threads} threads": partial(start, tree, case, threads, "pass")
            for threads in args.threads
            for name, tree in trees.items()
        }
        turns = measuring.in_turns(works, args.repeats)
        times = {name: measuring.median(answers) for name, answers in turns.items()}
        found.append(asdict(case) | {"ms": times})
        row = {
            **asdict(case),
            **{name: f"{ms['forward']:.1f} + {ms['backward']:.1f}" for name, ms in times.items()},
        }
        for threads in args.threads if "base" in trees else ():
            base, here = (times[f"{name}, {threads} threads"]["both"] for name in ("base", "here"))
            row[f"base / here, {threads} threads"] = f"{base / here:.2f}"
        rows.append(row)
    print(measuring.table(rows))
    for case, each in zip(cases, found, strict=True):
        print(f"\n{case.count:,} Gaussians, {case.size} px, {case.views} views, SH degree {case.degree}\n")
        print(show_stages({name: ms for name, ms in each["ms"].items() if name.startswith("here")}))
    return {"times": found}


def show_stages(times: dict[str, dict[str, Any]]) -> str:
    """Return a table of the stages of one scene; the last one is everything outside of the kernels."""
    stages = list(next(iter(times.values()))["stages"])
    rows = [
        {"stage": stage} | {name: f"{ms['stages'][stage]:.2f}" for name, ms in times.items()}
        for stage in stages
    ]
    rest = {name: f"{ms['both'] - sum(ms['stages'].values()):.2f}" for name, ms in times.items()}
    return measuring.table([*rows, {"stage": "Python and autograd"} | rest])


def measure_memory(cases: Sequence[Case], trees: dict[str, Path], args: argparse.Namespace) -> dict[str, Any]:
    """Measure, print and return the peak of memory of one pass of each scene."""
    found, rows = [], []
    for case in cases:
        peaks = {
            name: start(tree, case, args.threads[-1], "peak")["peak_bytes"] for name, tree in trees.items()
        }
        found.append(asdict(case) | {"peak_bytes": peaks})
        cells = {f"{name}: peak, MB": f"{peak / 1e6:.0f}" for name, peak in peaks.items()}
        rows.append({**asdict(case), **cells, "bytes per Gaussian": f"{peaks['here'] / case.count:.0f}"})
    print(measuring.table(rows))
    return {"memory": found}


# --- the process that renders -----------------------------------------------------------------------------


def make_scene_of(case: Case, threads: int) -> tuple[Any, Any]:
    """Return the rasterizer and a scene."""
    import torch
    from rasterizer_bench.scenes import make_scene, make_shell

    from cadam3d.rasterizer.cpu import CpuRasterizer

    torch.set_num_threads(threads)
    rasterizer = CpuRasterizer(cache_dir=None)
    rasterizer.prepare(torch.device("cpu"))
    return rasterizer, make_scene(
        make_shell(case.count, case.degree, torch.device("cpu")), case.size, case.views
    )


def measure_pass(case: Case, threads: int) -> dict[str, Any]:
    """Return the median times of a pass."""
    rasterizer, scene = make_scene_of(case, threads)
    return measuring.median([time_pass(rasterizer, scene) for _ in range(WARM_UP + PASSES)][WARM_UP:])


def measure_peak(case: Case, threads: int) -> dict[str, Any]:
    """Return how many bytes one pass adds to the peak of the resident memory."""
    rasterizer, scene = make_scene_of(case, threads)
    before = resident_bytes(reset=True)
    time_pass(rasterizer, scene)
    return {"peak_bytes": resident_bytes() - before}


def time_pass(rasterizer: Any, scene: Any) -> dict[str, Any]:
    """Return the milliseconds of a render, of its backward pass, and of the stages of the kernels."""
    scene.zero_grad()
    start = time.perf_counter()
    output = rasterizer.render(scene.gaussians, scene.cameras, scene.background)
    middle = time.perf_counter()
    scene.backward((output.rgb, output.alpha, output.depth))
    end = time.perf_counter()
    stages = stage_seconds(output)
    return {
        "forward": 1e3 * (middle - start),
        "backward": 1e3 * (end - middle),
        "both": 1e3 * (end - start),
        "stages": {name: 1e3 * seconds for name, seconds in stages.items()},
    }


def stage_seconds(output: Any) -> dict[str, float]:
    """Return the wall-clock time of each stage of the pass that made ``output``, which needs a gradient."""
    # The node of the graph is the context of ``rasterizer/native.py``, which holds the pass.
    run = output.rgb.grad_fn.kernels
    seconds, counts = (ctypes.c_double * len(STAGES))(), (ctypes.c_int64 * 3)()
    run.kernels.cadam3d_measure(run.handle, seconds, counts)
    return dict(zip(STAGES, seconds, strict=True))


def resident_bytes(reset: bool = False) -> int:
    """Return the peak of the resident memory of this process.

    With ``reset`` the peak starts again from the memory at this moment, where the system can do that (Linux).
    """
    if sys.platform != "linux":
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak if sys.platform == "darwin" else 1024 * peak
    if reset:
        Path("/proc/self/clear_refs").write_text("5")
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024 * next(int(line.split()[1]) for line in lines if line.startswith("VmHWM:"))


if __name__ == "__main__":
    main()
