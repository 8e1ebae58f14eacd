"""Measuring: what the benchmarks share: turns of two checkouts, clocks, the machine, tables and JSON.

Importing this module imports neither torch nor cadam3d, so that a benchmark can choose the checkout first.
"""

import argparse
import json
import os
import platform
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parents[1]


# --- the command line -------------------------------------------------------------------------------------


def parser_of(description: str | None) -> argparse.ArgumentParser:
    """Return a parser that shows the description of a script as it is written."""
    return argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )


def add_base(parser: argparse.ArgumentParser) -> None:
    """Add the option ``--base``, which names a checkout to compare with."""
    parser.add_argument("--base", type=_checkout, metavar="FOLDER", help="a checkout to compare with")


def positive(text: str) -> int:
    """Parse a whole number that is at least 1."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"expected a whole number of at least 1, got {text}")
    return int(text)


def new_file(text: str) -> Path:
    """Parse the path of a file that can be written, in a folder that exists."""
    path = Path(text)
    if not path.absolute().parent.is_dir():
        raise argparse.ArgumentTypeError(f"expected a file in a folder that exists, got {path}")
    return path


def _checkout(text: str) -> Path:
    folder = Path(text).resolve()
    # Without this check, Python would import the installed package, and both columns would be the same.
    if not (folder / "cadam3d" / "__init__.py").is_file():
        raise argparse.ArgumentTypeError(f"expected a checkout of cadam3d, got {folder}")
    return folder


# --- checkouts in turn ------------------------------------------------------------------------------------


def find_trees(base: Path | None) -> dict[str, Path]:
    """Return the checkouts to measure by name: ``base``, if there is one, and ``here``."""
    return {"here": HERE} if base is None else {"base": base, "here": HERE}


def environment_of(tree: Path) -> dict[str, str]:
    """Return the environment of a process that imports the package of a checkout."""
    return os.environ | {"PYTHONPATH": str(tree)}


def in_checkout(script: str, tree: Path, words: Sequence[str]) -> dict[str, Any]:
    """Return what a script writes as JSON to its ``--out``, in a process that imports from ``tree``.

    Ends the program if the script fails, which has reported the reason.
    """
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "found.json"
        command = [sys.executable, script, *words, "--out", str(out)]
        code = subprocess.call(command, stdout=subprocess.DEVNULL, env=environment_of(tree))
        if code:
            sys.exit(f"{Path(script).stem} ended with exit code {code} for {tree}")
        return json.loads(out.read_text(encoding="utf-8"))


def in_turns(works: Mapping[str, Callable[[], Any]], repeats: int, warm_up: int = 0) -> dict[str, list[Any]]:
    """Call every function ``repeats`` times and return what they return, by name.

    They take turns, so that other load on the machine slows all of them alike. Results of the first
    ``warm_up`` rounds are dropped.
    """
    found: dict[str, list[Any]] = {name: [] for name in works}
    for turn in range(warm_up + repeats):
        for name, work in works.items():
            result = work()
            if turn >= warm_up:
                found[name].append(result)
    return found


def median(turns: Sequence[Any]) -> Any:
    """Return nested results with the median of every number; all else is that of the first turn."""
    first = turns[0]
    if isinstance(first, dict):
        return {key: median([turn.get(key) for turn in turns]) for key in first}
    if all(turn == first for turn in turns):
        return first
    numbers = [turn for turn in turns if isinstance(turn, int | float)]
    return statistics.median(numbers) if len(numbers) == len(turns) else first


# --- clocks -----------------------------------------------------------------------------------------------


def now(device: Any) -> float:
    """Return the wall clock in seconds, after waiting for a CUDA device."""
    if device.type == "cuda":
        import torch

        torch.cuda.synchronize(device)
    return time.perf_counter()


def milliseconds(work: Callable[[], object], device: Any, times: int = 1) -> float:
    """Return the mean time of ``work`` over some calls.

    One CPU thread is timed by its own clock, which excludes other processes; everything else by the wall
    clock.
    """
    import torch

    is_one_thread = device.type == "cpu" and torch.get_num_threads() == 1
    clock = time.process_time if is_one_thread else lambda: now(device)
    begin = clock()
    for _ in range(times):
        work()
    return 1e3 * (clock() - begin) / times


def peak_bytes() -> int:
    """Return the largest memory of this process so far, which Linux counts in KiB."""
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return 1024 * next(int(line.split()[1]) for line in lines if line.startswith("VmHWM"))


# --- the machine and the results --------------------------------------------------------------------------


def machine(device: Any = None) -> dict[str, Any]:
    """Return the device, the versions and the commit of a measurement."""
    import torch

    facts: dict[str, Any] = {"name": processor(), "processor": processor()}
    if getattr(device, "type", str(device)) == "cuda":
        found = torch.cuda.get_device_properties(0)
        driver = first_line("nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader")
        facts |= {"name": found.name, "driver": driver, "capability": f"{found.major}.{found.minor}"}
        facts |= {"memory_bytes": found.total_memory}
    return facts | {
        "python": platform.python_version(),
        "torch": torch.__version__,
        "cuda": torch.version.cuda,
        "system": platform.platform(),
        "commit": commit(),
    }


def processor() -> str:
    """Return the name of the CPU, as far as the system reports it."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    found = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return found[0] if found else platform.processor() or platform.machine()


def commit() -> str | None:
    """Return the commit as runs record it: ``fbdfba5``, or ``fbdfba5-dirty`` if files differ from it.

    ``None`` outside a checkout.
    """
    found = first_line("git", "-C", str(HERE), "rev-parse", "--short=7", "HEAD")
    changed = first_line("git", "-C", str(HERE), "status", "--porcelain", "--untracked-files=no")
    return f"{found}-dirty" if found and changed else found


def first_line(*command: str) -> str | None:
    """Return the first line that a program prints; ``None`` if it fails or prints nothing."""
    try:
        answer = subprocess.run(command, capture_output=True, text=True, timeout=30, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return answer.stdout.strip().splitlines()[0] if answer.stdout.strip() else None


def write(path: Path | None, results: Mapping[str, Any]) -> None:
    """Write results as JSON, unless there is no path."""
    if path is not None:
        path.write_text(json.dumps(results, indent=2) + "\n", encoding="utf-8")


def line_of(cells: Iterable[object]) -> str:
    """Return one line of a table in Markdown."""
    return f"| {' | '.join(map(str, cells))} |"


def header(columns: Iterable[str]) -> str:
    """Return the two lines at the top of a table in Markdown."""
    names = list(columns)
    return "\n".join([line_of(names), "|" + "---|" * len(names)])


def table(rows: Sequence[Mapping[str, object]]) -> str:
    """Return a table in Markdown; the columns are the keys of the rows, of which some may lack a value."""
    columns = list(dict.fromkeys(key for row in rows for key in row))
    return "\n".join([header(columns), *(line_of(row.get(key, "") for key in columns) for row in rows)])


# --- runs of cadam3d train --------------------------------------------------------------------------------


def trained(folder: Path, settings: Sequence[str]) -> dict[str, Any]:
    """Train with the given settings unless ``folder`` has a result already, and return the run's summary.

    Ends the program if training fails, which has reported the reason.
    """
    summary = folder / "summary.json"
    if not summary.is_file():
        shutil.rmtree(folder, ignore_errors=True)
        line = ["train", *settings, f"hydra.run.dir={folder.absolute()}"]
        print("cadam3d", *line, file=sys.stderr)
        code = subprocess.call([sys.executable, "-m", "cadam3d", *line], stdout=sys.stderr)
        if code:
            sys.exit(f"cadam3d ended with exit code {code}. The same line continues with this run.")
    return json.loads(summary.read_text(encoding="utf-8"))


def folder_name(prompt: str, settings: Sequence[str]) -> str:
    """Return the name of the folder for a prompt and settings, such as ``a_red_boat_seed=1``."""
    return "_".join([*prompt.split(), *settings]).replace("/", "_")
