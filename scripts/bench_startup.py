"""Measure the time from the shell to the end of the first training step, here and in another checkout.

    python scripts/bench_startup.py --base ../cadam3d-before

Both trees run the demo in turn, so that a busy machine slows both alike. A run is killed as soon as the first
line of its metrics.jsonl is on the disk, which is the end of step 1. The wall-clock time depends on the other
load of the machine. The CPU time (user plus system) of the process hardly does.
"""

import os
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

import measuring

DEMO = "a red and yellow checkered torus"
POLL_SECONDS = 0.002
LONGEST_SECONDS = 120.0


def measure(tree: Path, settings: list[str]) -> dict[str, float]:
    """Start the demo with the sources of ``tree``, kill it at the end of its first step; return seconds."""
    with tempfile.TemporaryDirectory() as place, (Path(place) / "console.txt").open("w") as console:
        metrics = Path(place) / "run" / "metrics.jsonl"
        words = [f"prompt={DEMO}", f"hydra.run.dir={metrics.parent}", *settings]
        started = time.perf_counter()
        process = subprocess.Popen(
            [sys.executable, "-m", "cadam3d", "train", *words],
            cwd=place,
            env=measuring.environment_of(tree),
            stdout=console,
            stderr=subprocess.STDOUT,
        )
        try:
            while not (metrics.is_file() and b"\n" in metrics.read_bytes()):
                if process.poll() is not None or time.perf_counter() - started > LONGEST_SECONDS:
                    raise SystemExit(f"{tree}: no first step\n{Path(console.name).read_text()}")
                time.sleep(POLL_SECONDS)
            wall = time.perf_counter() - started
        finally:
            process.kill()
            _, _, usage = os.wait4(process.pid, 0) if process.returncode is None else (0, 0, None)
            process.returncode = process.returncode or 0
        assert usage is not None
        return {"wall s": wall, "CPU s": usage.ru_utime + usage.ru_stime}


def main(words: list[str] | None = None) -> None:
    """Print the table."""
    parser = measuring.parser_of(__doc__)
    measuring.add_base(parser)
    parser.add_argument("--repeats", type=measuring.positive, default=7, help="starts of each tree")
    parser.add_argument("--json", type=measuring.new_file, help="file for all numbers")
    parser.add_argument("settings", nargs="*", help="further settings of the training, such as prior=tiny")
    args = parser.parse_args(words)
    works = {
        name: partial(measure, tree, args.settings) for name, tree in measuring.find_trees(args.base).items()
    }
    # The first run fills the caches of bytecode, compiled kernels and the disk.
    turns = measuring.in_turns(works, args.repeats, warm_up=1)
    found = {name: measuring.median(each) for name, each in turns.items()}
    if "base" in found:
        found["here / base"] = {key: found["here"][key] / found["base"][key] for key in found["here"]}
    rows = [{"": name} | {key: f"{value:.3f}" for key, value in each.items()} for name, each in found.items()]
    print(f"medians of {args.repeats} starts\n\n{measuring.table(rows)}")
    measuring.write(args.json, {"machine": measuring.machine(), **found})


if __name__ == "__main__":
    main()
