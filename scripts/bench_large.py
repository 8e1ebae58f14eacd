"""Measure rasterizer=cpu on large scenes: stages, threads, bytes and memory, here and in another checkout.

    python scripts/bench_large.py
    python scripts/bench_large.py --base ../cadam3d-before
    python scripts/bench_large.py --memory --counts 1000000 --views 1 2

A pass is a render and its backward pass through Python and autograd, with prepared gradients of colour, alpha
and depth. Checkouts and numbers of threads take turns, so that other load on the machine slows all of them
alike. Times are medians of the wall clock in milliseconds.

The table of stages shows the bytes that a stage must move at least: each array that it reads or writes,
once. The floor is the time of these bytes at the speed of a large copy on as many threads. A stage near its
floor is bound by memory, and a stage far above it by arithmetic.

With --memory, every scene is rendered in a process of its own, and the table shows the growth of its peak of
resident memory beside the sum of the arrays.
"""

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from checkouts import HERE, add_base, find_trees

SCRIPTS = Path(__file__).resolve().parent
PHASES = ("forward", "backward", "both")
# The copy is larger than the caches of most machines, and is the best of a few.
COPY_BYTES, COPIES = 2**27, 8
# Passes that are not counted: the first ones get memory from the system.
WARM_UP = 2


@dataclass(frozen=True)
class Case:
    """One scene."""

    count: int  # Gaussians
    size: int  # pixels along an edge
    views: int
    degree: int  # of spherical harmonics

    def cells(self) -> list[str]:
        """Return the first cells of a row: N, pixels and views."""
        return [f"{self.count:,}", str(self.size), str(self.views)]


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

    def ask(self, **question: object) -> dict:
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
    args = read_arguments(words)
    if args.worker:
        serve()
        return
    cases = [Case(n, size, v, args.degree) for n in args.counts for size in args.sizes for v in args.views]
    trees = {"here": HERE, **find_trees(args.base)}
    result = measure_memory(cases, trees, args.threads) if args.memory else measure_times(cases, trees, args)
    if args.json:
        args.json.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")


def read_arguments(words: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--counts", type=int, nargs="+", default=[10_000, 100_000, 1_000_000])
    parser.add_argument("--sizes", type=int, nargs="+", default=[256, 512, 1024], help="pixels along an edge")
    parser.add_argument("--views", type=int, nargs="+", default=[1])
    parser.add_argument("--degree", type=int, default=0, choices=range(4), help="of spherical harmonics")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--repeats", type=int, default=7, help="passes that are counted (default: 7)")
    add_base(parser)
    parser.add_argument("--memory", action="store_true", help="measure memory instead of time")
    parser.add_argument("--json", type=Path, help="also write the numbers to this file")
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args(words)
    numbers = (args.counts, args.sizes, args.views, args.threads, [args.repeats])
    if any(number < 1 for each in numbers for number in each):
        parser.error("counts, sizes, views, threads and repeats: expected whole numbers >= 1")
    # A worker in any other folder would import an installed cadam3d, and measure that.
    if args.base and not (args.base / "cadam3d" / "__init__.py").is_file():
        parser.error(f"--base: expected a checkout of cadam3d, got {args.base}")
    if args.json and not args.json.absolute().parent.is_dir():
        parser.error(f"--json: expected a file in a folder that exists, got {args.json}")
    return args


# --- time -------------------------------------------------------------------------------------------------


def measure_times(cases: Sequence[Case], trees: dict[str, Path], args: argparse.Namespace) -> dict:
    """Measure, print and return the times of all scenes."""
    workers = {name: Worker(tree) for name, tree in trees.items()}
    speeds = {t: workers["here"].ask(do="copy", threads=t)["speed"] for t in args.threads}
    print(", ".join(f"copy on {t} threads: {speed / 1e9:.1f} GB/s" for t, speed in speeds.items()))
    rows, stages = [], []
    for case in cases:
        for worker in workers.values():
            worker.ask(do="scene", **asdict(case))
        samples: dict[tuple[str, int], list[dict]] = {(name, t): [] for name in trees for t in args.threads}
        for repeat in range(args.repeats + WARM_UP):
            for (name, threads), answers in samples.items():
                answer = workers[name].ask(do="pass", threads=threads)
                if repeat >= WARM_UP:
                    answers.append(answer)
        rows.append(summarize(case, samples))
        stages.append(make_stages(case, {t: samples["here", t] for t in args.threads}, speeds))
    for worker in workers.values():
        worker.close()
    show_times(rows, list(trees), args.threads)
    for case, table in zip(cases, stages, strict=True):
        show_stages(case, table, args.threads)
    return {
        "settings": {"repeats": args.repeats, "trees": {name: str(tree) for name, tree in trees.items()}},
        "copy_bytes_per_second": speeds,
        "times": rows,
        "stages": [asdict(case) | {"stages": table} for case, table in zip(cases, stages, strict=True)],
    }


def summarize(case: Case, samples: dict[tuple[str, int], list[dict]]) -> dict:
    """Return the medians of all phases in milliseconds, by checkout and number of threads."""
    times: dict[str, dict[int, dict[str, float]]] = {}
    for (name, threads), answers in samples.items():
        middle = {phase: 1e3 * statistics.median(each[phase] for each in answers) for phase in PHASES}
        times.setdefault(name, {})[threads] = middle
    return asdict(case) | {"ms": times}


def make_stages(case: Case, samples: dict[int, list[dict]], speeds: dict[int, float]) -> list[dict]:
    """Return time, bytes and floor of each stage; the last one is everything outside of the kernels."""
    answers = next(iter(samples.values()))
    moved = bytes_moved(case, answers[0]["visible"], answers[0]["slots"])
    table = []
    for stage in answers[0]["stages"]:
        seconds = {t: statistics.median(each["stages"][stage] for each in samples[t]) for t in samples}
        table.append(
            {
                "stage": stage,
                "ms": {t: 1e3 * s for t, s in seconds.items()},
                "mb": moved[stage] / 1e6,
                "floor_ms": {t: 1e3 * moved[stage] / speeds[t] for t in samples},
            }
        )
    rest = {
        t: statistics.median(each["both"] - sum(each["stages"].values()) for each in samples[t])
        for t in samples
    }
    table.append({"stage": "Python and autograd", "ms": {t: 1e3 * s for t, s in rest.items()}})
    return table


def bytes_moved(case: Case, visible: int, slots: int) -> dict[str, int]:
    """Return the bytes of the arrays that each stage of the kernels reads or writes, counted once each."""
    pairs, pixels = case.count * case.views, case.size**2 * case.views
    parameters = 4 * (11 + 3 * (case.degree + 1) ** 2) * case.count
    splats, boxes, on_screen, records = 64 * pairs, 16 * pairs, 12 * pairs, 64 * slots
    images, kept = 20 * pixels, 8 * pixels
    # A sorted item is a key and a number. Depths usually have two digits, and each pass reads and writes all.
    items = 8 * visible
    lists = 8 * slots
    return {
        "project": parameters + splats + boxes + on_screen,
        "order": 2 * boxes + items + 2 * 2 * items,
        "lists": items + boxes + lists,
        "blend": lists + 2 * slots + 64 * visible + images + kept,
        "blend backward": lists + 2 * slots + 64 * visible + 2 * images + kept + records,
        "gather": records + boxes + 2 * parameters + 8 * pairs,
        "centre backward": on_screen + 2 * 12 * case.count,
    }


def show_times(rows: Sequence[dict], trees: Sequence[str], threads: Sequence[int]) -> None:
    """Print the forward and backward times of all scenes, and their ratios."""
    first, last = threads[0], threads[-1]
    columns = ["N", "pixels", "views"]
    for name in trees:
        prefix = "" if name == "here" else f"{name}: "
        columns += [f"{prefix}{t} thread{'s' * (t > 1)}: forward + backward" for t in threads]
        columns += [f"{prefix}{first} / {last}"]
    columns += [f"base / here, {t} thread{'s' * (t > 1)}" for t in threads if "base" in trees]
    body = []
    for row in rows:
        cells = Case(row["count"], row["size"], row["views"], row["degree"]).cells()
        for name in trees:
            ms = row["ms"][name]
            cells += [f"{ms[t]['forward']:.1f} + {ms[t]['backward']:.1f}" for t in threads]
            cells += [f"{ms[first]['both'] / ms[last]['both']:.2f}"]
        if "base" in trees:
            cells += [f"{row['ms']['base'][t]['both'] / row['ms']['here'][t]['both']:.2f}" for t in threads]
        body.append(cells)
    show_table(columns, body)


def show_stages(case: Case, table: Sequence[dict], threads: Sequence[int]) -> None:
    """Print the stages of one scene."""
    first, last = threads[0], threads[-1]
    print(f"\n{case.count:,} Gaussians, {case.size} px, {case.views} views, SH degree {case.degree}")
    columns = ["stage", *(f"{t} thread{'s' * (t > 1)}" for t in threads), f"{first} / {last}", "MB"]
    columns += [f"floor, {t} thread{'s' * (t > 1)}" for t in threads]
    body = []
    for row in table:
        cells = [row["stage"], *(f"{row['ms'][t]:.2f}" for t in threads)]
        cells += [f"{row['ms'][first] / max(row['ms'][last], 1e-9):.2f}"]
        has_bytes = "mb" in row
        cells += [f"{row['mb']:.1f}" if has_bytes else ""]
        cells += [f"{row['floor_ms'][t]:.2f}" if has_bytes else "" for t in threads]
        body.append(cells)
    show_table(columns, body)


def show_table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table in Markdown."""
    print("\n| " + " | ".join(columns) + " |\n" + "|---" * len(columns) + "|")
    for cells in rows:
        print("| " + " | ".join(cells) + " |")


# --- memory -----------------------------------------------------------------------------------------------


def measure_memory(cases: Sequence[Case], trees: dict[str, Path], threads: Sequence[int]) -> dict:
    """Measure, print and return the peak of memory of one pass of each scene."""
    rows = []
    for case in cases:
        row: dict = asdict(case)
        for name, tree in trees.items():
            worker = Worker(tree)
            worker.ask(do="scene", **asdict(case))
            row[name] = worker.ask(do="peak", threads=threads[-1])
            worker.close()
        row["arrays"] = sum(arrays(case, row["here"]["slots"]).values())
        rows.append(row)
    columns = ["N", "pixels", "views", "arrays, MB", *(f"{name}: peak, MB" for name in trees)]
    columns += ["here: bytes per Gaussian", "slots"]
    body = []
    for case, row in zip(cases, rows, strict=True):
        cells = [*case.cells(), f"{row['arrays'] / 1e6:.0f}"]
        cells += [f"{row[name]['peak_bytes'] / 1e6:.0f}" for name in trees]
        cells += [f"{row['here']['peak_bytes'] / case.count:.0f}", f"{row['here']['slots']:,}"]
        body.append(cells)
    show_table(columns, body)
    return {"memory": rows}


def arrays(case: Case, slots: int) -> dict[str, int]:
    """Return the bytes that exist at the end of a backward pass, without the scene itself."""
    pairs, pixels = case.count * case.views, case.size**2 * case.views
    gradients = 4 * (11 + 3 * (case.degree + 1) ** 2) * case.count
    return {
        # Splat, box, the centre, its gradient and the radius.
        "Gaussian and view": (64 + 16 + 8 + 8 + 4) * pairs,
        # The gradients, those of the means once more, and the depth order of one view.
        "Gaussian": gradients + 12 * case.count + 8 * case.count,
        # The number of the Gaussian and of the slot, the bits of the cells, and the record.
        "slot": (8 + 2) * slots + min(64 * slots, max(256 * 2**20, 64 * slots // case.views)),
        "pixel": (20 + 8) * pixels,
    }


# --- the process that renders -----------------------------------------------------------------------------


def serve() -> None:
    """Answer questions from the standard input, one a line, until it ends.

    ``scene`` makes a scene, ``pass`` times a render and its backward pass, ``copy`` measures the speed of a
    copy in bytes per second, read and written, and ``peak`` measures the memory of one pass.
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
            case "copy":
                answer = {"speed": copy_speed(torch)}
            case "pass":
                answer = time_pass(rasterizer, scene, cpu)
            case "peak":
                rasterizer.prepare(torch.device("cpu"))
                before = resident_bytes(reset=True)
                answer = time_pass(rasterizer, scene, cpu)
                answer["peak_bytes"] = resident_bytes() - before
            case other:
                raise ValueError(other)
        print(json.dumps(answer), flush=True)


def copy_speed(torch) -> float:
    """Return the bytes per second that a large copy reads and writes."""
    source, target = torch.ones(COPY_BYTES // 4), torch.zeros(COPY_BYTES // 4)
    times = []
    for _ in range(COPIES):
        start = time.perf_counter()
        target.copy_(source)
        times.append(time.perf_counter() - start)
    return 2 * COPY_BYTES / min(times)


def time_pass(rasterizer, scene, cpu) -> dict:
    """Return the seconds of a render and of its backward pass, and what the kernels report about them."""
    scene.zero_grad()
    start = time.perf_counter()
    output = rasterizer.render(scene.gaussians, scene.cameras, scene.background)
    middle = time.perf_counter()
    scene.backward((output.rgb, output.alpha, output.depth))
    end = time.perf_counter()
    answer = {"forward": middle - start, "backward": end - middle, "both": end - start}
    # An older checkout has no costs.
    if hasattr(cpu, "pass_costs"):
        costs = cpu.pass_costs(output)
        answer |= {"stages": costs.seconds, "visible": costs.visible, "slots": costs.slots}
    return answer


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
