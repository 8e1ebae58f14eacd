"""Measure rasterizer=cpu on large scenes: stages, threads and memory, here and in another checkout.

    python scripts/bench_large.py
    python scripts/bench_large.py --base ../cadam3d-before
    python scripts/bench_large.py --memory --counts 1000000 --views 1 2

A pass is a render and its backward pass through Python and autograd, with prepared gradients of colour, alpha
and depth. Checkouts and numbers of threads take turns, so that other load on the machine slows all of them
alike. Times are medians of the wall clock in milliseconds.

With --memory, every scene is rendered in a process of its own, and the table shows the growth of its peak of
resident memory.
"""

import argparse
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
# Passes that are not counted: the first ones get memory from the system.
WARM_UP = 2


@dataclass(frozen=True)
class Case:
    """One scene."""

    count: int  # Gaussians
    size: int  # pixels along an edge
    views: int
    degree: int  # of spherical harmonics


class Worker:
    """A process with the sources of one checkout, which answers one question at a time."""

    def __init__(self, tree: Path) -> None:
        # As the command line sets it: threads of torch that spin would take the processor from the others.
        environment = {
            "OMP_WAIT_POLICY": "PASSIVE",
            "GOMP_SPINCOUNT": "3000",
            **os.environ,
            "PYTHONPATH": f"{tree}{os.pathsep}{SCRIPTS}",
        }
        self.process = subprocess.Popen(
            [sys.executable, str(Path(__file__).resolve()), "--worker"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=environment,
        )

    def ask(self, **question: object) -> dict[str, Any]:
        """Return the answer to a question; see :func:`serve`."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        print(json.dumps(question), file=self.process.stdin, flush=True)
        line = self.process.stdout.readline()
        if not line:
            raise SystemExit(f"{question}: the process ended with exit code {self.process.wait()}")
        return json.loads(line)

    def close(self) -> None:
        """End the process."""
        assert self.process.stdin is not None
        self.process.stdin.close()
        self.process.wait()


def main(words: Sequence[str] | None = None) -> None:
    """Print the tables, and write all numbers."""
    args = read_arguments(words)
    if args.worker:
        serve()
        return
    cases = [Case(n, size, v, args.degree) for n in args.counts for size in args.sizes for v in args.views]
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
    parser.add_argument("--repeats", type=measuring.positive, default=7, help="passes that are counted")
    measuring.add_base(parser)
    parser.add_argument("--memory", action="store_true", help="measure memory instead of time")
    parser.add_argument("--json", type=measuring.new_file, help="also write the numbers to this file")
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    return parser.parse_args(words)


def measure_times(cases: Sequence[Case], trees: dict[str, Path], args: argparse.Namespace) -> dict[str, Any]:
    """Measure, print and return the times of all scenes, and of the stages in this checkout."""
    workers = {name: Worker(tree) for name, tree in trees.items()}
    found, rows = [], []
    for case in cases:
        for worker in workers.values():
            worker.ask(do="scene", **asdict(case))
        works = {
            f"{name}, {threads} threads": partial(worker.ask, do="pass", threads=threads)
            for threads in args.threads
            for name, worker in workers.items()
        }
        turns = measuring.in_turns(works, args.repeats, warm_up=WARM_UP)
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
    for worker in workers.values():
        worker.close()
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
        peaks = {}
        for name, tree in trees.items():
            worker = Worker(tree)
            worker.ask(do="scene", **asdict(case))
            peaks[name] = worker.ask(do="peak", threads=args.threads[-1])["peak_bytes"]
            worker.close()
        found.append(asdict(case) | {"peak_bytes": peaks})
        cells = {f"{name}: peak, MB": f"{peak / 1e6:.0f}" for name, peak in peaks.items()}
        rows.append({**asdict(case), **cells, "bytes per Gaussian": f"{peaks['here'] / case.count:.0f}"})
    print(measuring.table(rows))
    return {"memory": found}


# --- the process that renders -----------------------------------------------------------------------------


def serve() -> None:
    """Answer questions from the standard input, one a line, until it ends.

    ``scene`` makes a scene, ``pass`` times a render and its backward pass, and ``peak`` measures the memory
    of one pass.
    """
    import torch
    from rasterizer_bench.scenes import make_scene, make_shell

    from cadam3d.rasterizer import cpu

    rasterizer = cpu.CpuRasterizer(cache_dir=None)
    scene = None
    for line in sys.stdin:
        question = json.loads(line)
        torch.set_num_threads(question.pop("threads", 1))
        match question.pop("do"):
            case "scene":
                case = Case(**question)
                gaussians = make_shell(case.count, case.degree, torch.device("cpu"))
                scene = make_scene(gaussians, case.size, case.views)
                answer = {}
            case "pass":
                answer = time_pass(rasterizer, scene, cpu)
            case "peak":
                rasterizer.prepare(torch.device("cpu"))
                before = resident_bytes(reset=True)
                time_pass(rasterizer, scene, cpu)
                answer = {"peak_bytes": resident_bytes() - before}
            case other:
                raise ValueError(other)
        print(json.dumps(answer), flush=True)


def time_pass(rasterizer: Any, scene: Any, cpu: Any) -> dict[str, Any]:
    """Return the milliseconds of a render, of its backward pass, and of the stages of the kernels."""
    scene.zero_grad()
    start = time.perf_counter()
    output = rasterizer.render(scene.gaussians, scene.cameras, scene.background)
    middle = time.perf_counter()
    scene.backward((output.rgb, output.alpha, output.depth))
    end = time.perf_counter()
    # An older checkout has no costs.
    stages = cpu.pass_costs(output).seconds if hasattr(cpu, "pass_costs") else {}
    return {
        "forward": 1e3 * (middle - start),
        "backward": 1e3 * (end - middle),
        "both": 1e3 * (end - start),
        "stages": {name: 1e3 * seconds for name, seconds in stages.items()},
    }


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
