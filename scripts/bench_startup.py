"""Measure the time from the shell to the end of the first training step, here and in another checkout.

    python scripts/bench_startup.py --base ../cadam3d-before

Both trees run the demo in turn, so that a busy machine slows both alike. A run is killed as soon as the first
line of its metrics.jsonl is on the disk, which is the end of step 1. The wall-clock time depends on the other
load of the machine. The CPU time (user plus system) of the process hardly does.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from checkouts import add_base, environment_of, find_trees

DEMO = "a red and yellow checkered torus"
POLL_SECONDS = 0.002
LONGEST_SECONDS = 120.0


@dataclass(frozen=True)
class Timing:
    """The times of one start, in seconds."""

    wall: float
    cpu: float  # user plus system, children included


def main() -> None:
    args = read_arguments()
    trees = find_trees(args.base)
    for tree in trees.values():
        # The first run fills the caches of bytecode, compiled kernels and the disk.
        measure(tree, args.settings)
    timings: dict[str, list[Timing]] = {name: [] for name in trees}
    for _ in range(args.repeats):
        for name, tree in trees.items():
            timings[name].append(measure(tree, args.settings))
    print(json.dumps(summarize(timings), indent=2) if args.json else as_text(timings))


def read_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    add_base(parser)
    parser.add_argument("--repeats", type=int, default=7, help="starts of each tree (default: 7)")
    parser.add_argument("--json", action="store_true", help="print numbers for programs")
    parser.add_argument("settings", nargs="*", help="further settings of the training, such as prior=tiny")
    return parser.parse_args()


def measure(tree: Path, settings: list[str]) -> Timing:
    """Start the demo with the sources of ``tree``, and kill it at the end of its first step."""
    with tempfile.TemporaryDirectory() as place, (Path(place) / "console.txt").open("w") as console:
        metrics = Path(place) / "run" / "metrics.jsonl"
        words = [f"prompt={DEMO}", f"hydra.run.dir={metrics.parent}", *settings]
        started = time.perf_counter()
        process = subprocess.Popen(
            [sys.executable, "-m", "cadam3d", "train", *words],
            cwd=place,
            env=environment_of(tree),
            stdout=console,
            stderr=subprocess.STDOUT,
        )
        try:
            while not has_line(metrics):
                if process.poll() is not None or time.perf_counter() - started > LONGEST_SECONDS:
                    raise SystemExit(f"{tree}: no first step\n{Path(console.name).read_text()}")
                time.sleep(POLL_SECONDS)
            wall = time.perf_counter() - started
        finally:
            process.kill()
            _, _, usage = os.wait4(process.pid, 0) if process.returncode is None else (0, 0, None)
            process.returncode = process.returncode or 0
        assert usage is not None
        return Timing(wall=wall, cpu=usage.ru_utime + usage.ru_stime)


def has_line(path: Path) -> bool:
    return path.is_file() and b"\n" in path.read_bytes()


def summarize(timings: dict[str, list[Timing]]) -> dict[str, object]:
    medians = {
        name: {
            "wall_seconds": statistics.median(timing.wall for timing in found),
            "cpu_seconds": statistics.median(timing.cpu for timing in found),
            "starts": len(found),
        }
        for name, found in timings.items()
    }
    if "base" not in medians:
        return medians
    ratios = {key: medians["here"][key] / medians["base"][key] for key in ("wall_seconds", "cpu_seconds")}
    return {**medians, "here_to_base": ratios}


def as_text(timings: dict[str, list[Timing]]) -> str:
    """Return a table of medians, and the ratio of this tree to the other one."""
    lines = [f"{'':<8}{'wall':>9}{'CPU':>9}   median of {len(timings['here'])} starts"]
    found = summarize(timings)
    for name in timings:
        lines.append(f"{name:<8}{found[name]['wall_seconds']:>7.2f} s{found[name]['cpu_seconds']:>7.2f} s")
    if "here_to_base" in found:
        wall, cpu = found["here_to_base"]["wall_seconds"], found["here_to_base"]["cpu_seconds"]
        lines.append(f"{'ratio':<8}{wall:>9.3f}{cpu:>9.3f}   below 1: this tree starts faster")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
