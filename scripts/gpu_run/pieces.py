"""The pieces of a run: what each starts, how long it may take, and what it needs."""

import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path

from gpu_run.machine import REPOSITORY

# In a command, the path of the JSON file with its results.
RESULT = "{result}"
# Seconds. Together they take less than 25 minutes, and each less than ten, whatever comes before and after.
PARTS = {"checks": 480.0, "times": 480.0, "explains": 420.0}
# The tests compute what is right with torch on the CPU, in several processes. With the threads of all cores
# in each of them, they would mostly wait for one another.
ONE_THREAD = {"OMP_NUM_THREADS": "1"}
# The sanitizers see every tensor only if torch allocates each of them separately.
UNCACHED = {"PYTORCH_NO_CUDA_MEMORY_CACHING": "1"}
SANITIZERS = {"memcheck": 120.0, "racecheck": 120.0, "synccheck": 90.0}
# The scenes that are timed: Gaussians, pixels, views and SH degree.
TIMED = {
    "times": ("20000 100000 1000000", "512 1024", "1 4", "0"),
    "times of 3.4 M": ("3400000", "512 1024", "4", "0"),
    "times of SH 3": ("1000000", "1024", "4", "3"),
}
# Each process of the tests needs this much memory of the GPU.
TEST_MEMORY = 4 * 2**30
MOST_PROCESSES = 6
# Several processes that use gsplat for the first time delete the build of one another, so these tests run
# alone, after the build.
GSPLAT_TESTS = ("tests/rasterizer/test_gsplat.py", "tests/plugins/test_gsplat.py")


@dataclass(frozen=True)
class Piece:
    """A part of a run that has its own process, time limit and entry in the record."""

    name: str
    command: tuple[str, ...]
    seconds: float  # the time limit
    is_gate: bool = False  # whether the times need it to pass
    expects: str = ""  # a pattern of a line that its log must have
    needs: tuple[str, ...] = ()  # packages and tools
    environment: Mapping[str, str] = field(default_factory=dict)


def own(name: str, *words: str) -> tuple[str, ...]:
    """Return the command of a part of :mod:`gpu_run.on_device`."""
    return (sys.executable, "-m", "gpu_run.on_device", name, "--json", RESULT, *words)


def script(name: str, *words: str) -> tuple[str, ...]:
    """Return the command of a benchmark on the GPU that writes its results as JSON."""
    return (sys.executable, str(REPOSITORY / "scripts" / f"{name}.py"), "--device", "cuda", *words)


def gpu_tests(name: str, *words: str, seconds: float, **options: bool) -> Piece:
    """Return the piece that runs the tests that need a GPU; it fails if no test runs."""
    command = (sys.executable, "-m", "pytest", "-m", "gpu", "-p", "no:cacheprovider", *words)
    needs = ("pytest", "gsplat", "nvcc", "ninja") if "gsplat" in name else ("pytest",)
    return Piece(
        name, command, seconds, expects=r".*\d+ passed.*", needs=needs, environment=ONE_THREAD, **options
    )


def plan(part: str, folder: Path, found: Mapping[str, object], memory_bytes: int, cores: int) -> list[Piece]:
    """Return the pieces of a part, in order; ``found`` has the packages and the tools of the machine."""
    if part == "checks":
        processes = min(MOST_PROCESSES, cores, memory_bytes // TEST_MEMORY)
        return checks(folder, found, processes if "pytest-xdist" in found else 1)
    return times(found) if part == "times" else explains(found)


def checks(folder: Path, found: Mapping[str, object], processes: int) -> list[Piece]:
    """Return the checks, gates first. If one of the gates fails, nothing is timed."""
    parallel = ("-n", str(processes)) if processes > 1 else ()
    ignored = tuple(f"--ignore={path}" for path in GSPLAT_TESTS)
    run = datetime.now().strftime("demo-%Y%m%d-%H%M%S")
    demo = ["prompt=a red and yellow checkered torus", "steps=100", "device=cuda"]
    demo += [] if "imageio-ffmpeg" in found else ["callback=[progress]", "exporter=[ply]"]
    sanitizer = str(found.get("compute-sanitizer"))
    return [
        Piece("self-test", own("self-test"), 120.0, is_gate=True),
        gpu_tests("tests", *ignored, *parallel, "tests/rasterizer", seconds=240.0, is_gate=True),
        Piece(
            "difficult scenes and the long sort",
            script("bench_rasterizer", "--backends", "cuda", "--check-only"),
            120.0,
            is_gate=True,
            expects="check cuda: agrees.*",
        ),
        Piece(
            "demo",
            (sys.executable, "-m", "cadam3d", "train", *demo, f"hydra.run.dir={folder / run}"),
            120.0,
            expects="finished after .*",
        ),
        *(
            Piece(
                tool,
                # Some calls of torch fail on purpose, so only what kernels do is judged.
                (
                    *(sanitizer, "--tool", tool),
                    *(("--report-api-errors", "no") if tool == "memcheck" else ()),
                    *own("self-test"),
                ),
                seconds,
                expects="(ERROR|RACECHECK) SUMMARY: 0 .*",
                needs=("compute-sanitizer",),
                environment=UNCACHED,
            )
            for tool, seconds in SANITIZERS.items()
        ),
        gpu_tests("other tests", *ignored, "--ignore=tests/rasterizer", seconds=120.0),
    ]


def times(found: Mapping[str, object]) -> list[Piece]:
    """Return the times, beside gsplat where it can be built."""
    gsplat = ("gsplat", "nvcc", "ninja")
    backends = ("gsplat", "cuda") if all(name in found for name in gsplat) else ("cuda",)
    pieces = [
        Piece("gsplat", own("gsplat"), 240.0, needs=gsplat),
        Piece("choice of auto", own("auto"), 120.0),
    ]
    for name, (counts, sizes, views, degree) in TIMED.items():
        words = ["--backends", *backends, "--counts", *counts.split(), "--sizes", *sizes.split()]
        words += ["--views", *views.split(), "--degrees", degree, "--no-check", "--no-stages"]
        pieces.append(Piece(name, script("bench_rasterizer", *words, "--json", RESULT), 300.0))
    return pieces


def explains(found: Mapping[str, object]) -> list[Piece]:
    """Return the pieces that explain the times."""
    recipes = ("--vram", "low", "--steps", "20", "--json", RESULT)
    return [
        Piece("kernels", own("kernels"), 150.0),
        Piece("sorts", own("sorts"), 60.0),
        Piece("step", script("bench_step", "--priors", "exact", "--json", RESULT), 60.0),
        Piece(
            "step with a network",
            script("bench_step", "--priors", "learned", "random", "--json", RESULT),
            240.0,
            needs=("diffusers",),
        ),
        Piece("recipes", script("bench_recipes", *recipes), 240.0, needs=("diffusers",)),
        gpu_tests("tests of gsplat", *GSPLAT_TESTS, seconds=120.0),
    ]
