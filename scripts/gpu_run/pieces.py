"""The pieces of a run: what each starts, how long it may take, and what it needs."""

import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path

from gpu_run.machine import REPOSITORY, Device

# In a command, the path of the JSON file with its results.
RESULT = "{result}"
# Seconds. The limits of the pieces of a part fit into it, and each part takes less than ten minutes, whatever
# comes before and after. gsplat is last because its build may take long.
PARTS = {"checks": 450.0, "times": 420.0, "explains": 390.0, "sanitizers": 270.0, "gsplat": 530.0}
# The tests compute what is right with torch on the CPU, in several processes. With the threads of all cores
# in each of them, they would mostly wait for one another.
ONE_THREAD = {"OMP_NUM_THREADS": "1"}
# The sanitizers see every tensor only if torch allocates each of them separately.
UNCACHED = {"PYTORCH_NO_CUDA_MEMORY_CACHING": "1"}
SANITIZERS = ("memcheck", "racecheck", "synccheck")
# The scenes that are timed: Gaussians, pixels, views and SH degree.
TIMED = {
    "times": ("20000 100000 1000000", "512 1024", "1 4", "0"),
    "times of 3.4 M": ("3400000", "512 1024", "4", "0"),
    "times of SH 3": ("1000000", "1024", "4", "3"),
}
# Each process of the tests needs this much memory of the GPU.
TEST_MEMORY = 4 * 2**30
MOST_PROCESSES = 6
# These tests run in one process after the build, because several processes would delete each other's build.
GSPLAT_TESTS = ("tests/rasterizer/test_gsplat.py", "tests/plugins/test_gsplat.py")


@dataclass(frozen=True)
class Piece:
    """A part of a run that has its own process, time limit and entry in the record."""

    name: str
    command: tuple[str, ...]
    seconds: float  # the time limit
    is_gate: bool = False  # whether the other parts need it to pass
    after: str = ""  # the piece that must have passed
    may_be_slow: bool = False  # whether the end of its time says nothing about the kernels
    expects: str = ""  # a pattern of a line that its log must have
    needs: tuple[str, ...] = ()  # packages and tools
    environment: Mapping[str, str] = field(default_factory=dict)


def own(name: str, *words: str) -> tuple[str, ...]:
    """Return the command of a part of :mod:`gpu_run.on_device`."""
    return (sys.executable, "-m", "gpu_run.on_device", name, "--json", RESULT, *words)


def script(name: str, *words: str) -> tuple[str, ...]:
    """Return the command of a benchmark on the GPU that writes its results as JSON."""
    return (sys.executable, str(REPOSITORY / "scripts" / f"{name}.py"), "--device", "cuda", *words)


def gpu_tests(name: str, *words: str, seconds: float, after: str = "") -> Piece:
    """Return the piece that runs the tests that need a GPU; it fails if no test runs."""
    command = (sys.executable, "-m", "pytest", "-m", "gpu", "-p", "no:cacheprovider", *words)
    return Piece(
        name,
        command,
        seconds,
        expects=r".*\d+ passed.*",
        needs=("pytest",),
        after=after,
        environment=ONE_THREAD,
    )


def plan(part: str, folder: Path, found: Mapping[str, object], processes: int) -> list[Piece]:
    """Return the pieces of a part, in order; ``found`` has the packages and the tools of the machine."""
    if part == "checks":
        return checks(folder, found, processes if "pytest-xdist" in found else 1)
    if part == "sanitizers":
        return sanitizers(str(found.get("compute-sanitizer")))
    return {"times": times, "explains": explains, "gsplat": gsplat}[part]()


def most_processes(device: Device, cores: int) -> int:
    """Return how many processes may use the GPU at a time."""
    return 1 if device.is_exclusive else min(MOST_PROCESSES, cores, device.memory_bytes // TEST_MEMORY)


def checks(folder: Path, found: Mapping[str, object], processes: int) -> list[Piece]:
    """Return the checks, gates first. If one of the gates fails, nothing else runs."""
    parallel = ("-n", str(processes)) if processes > 1 else ()
    ignored = tuple(f"--ignore={path}" for path in GSPLAT_TESTS)
    run = datetime.now().strftime("demo-%Y%m%d-%H%M%S")
    demo = ["prompt=a red and yellow checkered torus", "steps=100", "device=cuda"]
    demo += [] if "imageio-ffmpeg" in found else ["callback=[progress]", "exporter=[ply]"]
    return [
        Piece("self-test", own("self-test"), 60.0, is_gate=True),
        Piece(
            "difficult scenes and the long sort",
            script("bench_rasterizer", "--backends", "cuda", "--check-only"),
            90.0,
            is_gate=True,
            expects="check cuda: agrees.*",
        ),
        Piece(
            "demo",
            (sys.executable, "-m", "cadam3d", "train", *demo, f"hydra.run.dir={folder / run}"),
            60.0,
            expects="finished after .*",
        ),
        gpu_tests("tests", *ignored, *parallel, "tests/rasterizer", seconds=180.0),
        gpu_tests("other tests", *ignored, "--ignore=tests/rasterizer", seconds=60.0),
    ]


def times() -> list[Piece]:
    """Return the times of ``rasterizer=cuda``."""
    return [Piece("choice of auto", own("auto"), 60.0), *timed("cuda", seconds=120.0)]


def timed(*backends: str, seconds: float, beside: str = "", after: str = "") -> list[Piece]:
    """Return the pieces that time some backends."""
    pieces = []
    for name, (counts, sizes, views, degree) in TIMED.items():
        words = ["--backends", *backends, "--counts", *counts.split(), "--sizes", *sizes.split()]
        words += ["--views", *views.split(), "--degrees", degree, "--no-check", "--no-stages"]
        command = script("bench_rasterizer", *words, "--json", RESULT)
        pieces.append(Piece(name + beside, command, seconds, after=after))
    return pieces


def explains() -> list[Piece]:
    """Return the pieces that explain the times."""
    recipes = ("--vram", "low", "--steps", "20", "--json", RESULT)
    step = ("--priors", "learned", "random", "--json", RESULT)
    return [
        Piece("kernels", own("kernels"), 90.0),
        Piece("sorts", own("sorts"), 40.0),
        Piece("step", script("bench_step", "--priors", "exact", "--json", RESULT), 50.0),
        Piece("step with a network", script("bench_step", *step), 100.0, needs=("diffusers",)),
        Piece("recipes", script("bench_recipes", *recipes), 110.0, needs=("diffusers",)),
    ]


def sanitizers(path: str) -> list[Piece]:
    """Return the self-test under each tool of compute-sanitizer, which makes kernels many times slower."""
    # Some calls of torch fail on purpose, so only what kernels do is judged.
    return [
        Piece(
            tool,
            (
                *(path, "--tool", tool),
                *(("--report-api-errors", "no") if tool == "memcheck" else ()),
                *own("self-test"),
            ),
            90.0,
            expects="(ERROR|RACECHECK) SUMMARY: 0 .*",
            needs=("compute-sanitizer",),
            may_be_slow=True,
            environment=UNCACHED,
        )
        for tool in SANITIZERS
    ]


def gsplat() -> list[Piece]:
    """Return the build of gsplat, the times beside it, and its tests."""
    tools = ("gsplat", "nvcc", "ninja")
    return [
        Piece("gsplat", own("gsplat"), 330.0, needs=tools, may_be_slow=True),
        *timed("gsplat", "cuda", seconds=50.0, beside=" beside gsplat", after="gsplat"),
        gpu_tests("tests of gsplat", *GSPLAT_TESTS, seconds=50.0, after="gsplat"),
    ]
