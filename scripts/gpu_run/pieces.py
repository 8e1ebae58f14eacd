"""The pieces of a run: what each starts, how long it may take, and what it needs."""

import re
import sys
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from gpu_run.machine import REPOSITORY
from gpu_run.record import FAILED, PASSED, SKIPPED, Record
from gpu_run.runner import RESULT, Finished, Judge, Piece

CHECKS, TIMES, EXPLAINS = "checks", "times", "explains"
# Seconds. Together they take less than 25 minutes, and each less than ten, whatever comes before and after.
PARTS = {CHECKS: 480.0, TIMES: 480.0, EXPLAINS: 420.0}
# The tests compute what is right with torch on the CPU, in several processes. With the threads of all cores
# in each of them, they would mostly wait for one another.
ONE_THREAD = {"OMP_NUM_THREADS": "1"}
# The sanitizers see every tensor only if torch allocates each of them separately.
UNCACHED = {"PYTORCH_NO_CUDA_MEMORY_CACHING": "1"}
SANITIZERS = {"memcheck": 120.0, "racecheck": 120.0, "synccheck": 90.0}
# Some calls of torch fail on purpose, so only what kernels do is judged.
REPORTS = {"memcheck": ("--report-api-errors", "no")}
# The scenes that are timed: Gaussians, pixels, views and SH degree.
TIMED = {
    "times": ("20000 100000 1000000", "512 1024", "1 4", "0"),
    "times of 3.4 M": ("3400000", "512 1024", "4", "0"),
    "times of SH 3": ("1000000", "1024", "4", "3"),
}
GIB = 2**30
# Each process of the tests needs this much memory of the GPU.
TEST_MEMORY = 4 * GIB
MOST_PROCESSES = 6
# The first use of gsplat in a process deletes a build of its kernels that another process has begun. So these
# tests do not run beside the build.
GSPLAT_TESTS = ("tests/rasterizer/test_gsplat.py", "tests/plugins/test_gsplat.py")
DEMO = "a red and yellow checkered torus"


@dataclass(frozen=True)
class Setup:
    """What the pieces are made from."""

    folder: Path
    tools: dict[str, str]
    packages: dict[str, str]
    memory_bytes: int
    processors: int
    record: Record
    python: str = sys.executable

    def script(self, name: str, *words: str) -> tuple[str, ...]:
        """Return the command of a script of the project."""
        return (self.python, str(REPOSITORY / "scripts" / f"{name}.py"), *words)

    def tests(self, *words: str) -> tuple[str, ...]:
        """Return the command that runs the tests that need a GPU."""
        return (self.python, "-m", "pytest", "-m", "gpu", "-rs", "-p", "no:cacheprovider", *words)

    @property
    def has_gsplat(self) -> bool:
        """Return whether the kernels of gsplat are built."""
        gsplat = self.record.pieces.get("gsplat")
        return bool(gsplat and gsplat.result and gsplat.result.get("is_built"))

    def own(self, name: str, *words: str) -> tuple[str, ...]:
        """Return the command of a part of :mod:`gpu_run.on_device`."""
        return (self.python, "-m", "gpu_run.on_device", name, "--json", RESULT, *words)

    def lacks(self, *names: str) -> str | None:
        """Return a line about those of some packages and tools that are missing, or ``None``."""
        missing = [name for name in names if name not in self.packages and name not in self.tools]
        return f"not installed: {', '.join(missing)}" if missing else None


def plan(setup: Setup, part: str) -> list[Piece]:
    """Return the pieces of a part, in order."""
    return {CHECKS: checks, TIMES: times, EXPLAINS: explains}[part](setup)


def checks(setup: Setup) -> list[Piece]:
    """Return the checks. If one of the gates fails, nothing is timed.

    The gates come first: if the time of the part is over before the last piece, the times may follow anyway.
    """
    tests = setup.tests(*(f"--ignore={path}" for path in GSPLAT_TESTS))
    processes = min(MOST_PROCESSES, setup.processors, setup.memory_bytes // TEST_MEMORY)
    parallel = ("-n", str(processes)) if "pytest-xdist" in setup.packages and processes > 1 else ()
    run = datetime.now().strftime("demo-%Y%m%d-%H%M%S")
    line = ["train", f"prompt={DEMO}", "steps=100", "device=cuda", f"hydra.run.dir={setup.folder / run}"]
    line += [] if "imageio-ffmpeg" in setup.packages else ["callback=[progress]", "exporter=[ply]"]
    return [
        Piece(
            "gsplat",
            CHECKS,
            setup.own("gsplat"),
            PARTS[CHECKS],
            missing=setup.lacks("gsplat", "nvcc", "ninja"),
            in_background=True,
        ),
        Piece("self-test", CHECKS, setup.own("self-test"), 120.0, is_gate=True),
        Piece(
            "tests",
            CHECKS,
            (*tests, *parallel, "tests/rasterizer"),
            240.0,
            is_gate=True,
            missing=setup.lacks("pytest"),
            judge=by_pytest,
            environment=ONE_THREAD,
        ),
        Piece(
            "difficult scenes and the long sort",
            CHECKS,
            setup.script("bench_rasterizer", "--device", "cuda", "--backends", "cuda", "--check-only"),
            120.0,
            is_gate=True,
            judge=by_check,
        ),
        Piece(
            "demo",
            CHECKS,
            (setup.python, "-m", "cadam3d", *line),
            120.0,
            judge=by_last_line(r"finished after .*"),
        ),
        *(
            Piece(
                tool,
                CHECKS,
                (
                    setup.tools.get("compute-sanitizer", ""),
                    *("--tool", tool, *REPORTS.get(tool, ())),
                    *setup.own("self-test"),
                ),
                seconds,
                missing=setup.lacks("compute-sanitizer"),
                environment=UNCACHED,
                judge=by_sanitizer,
            )
            for tool, seconds in SANITIZERS.items()
        ),
        Piece(
            "other tests",
            CHECKS,
            (*tests, "--ignore=tests/rasterizer"),
            120.0,
            missing=setup.lacks("pytest"),
            judge=by_pytest,
            environment=ONE_THREAD,
        ),
    ]


def times(setup: Setup) -> list[Piece]:
    """Return the times. The checks have passed, so they are not repeated."""
    # A gsplat that is built is timed, even if it does not agree with the reference; the report says so.
    backends = ["gsplat", "cuda"] if setup.has_gsplat else ["cuda"]
    pieces = [Piece("choice of auto", TIMES, setup.own("auto"), 120.0)]
    for name, (counts, sizes, views, degrees) in TIMED.items():
        scenes = ["--counts", *counts.split(), "--sizes", *sizes.split(), "--views", *views.split()]
        words = ["--device", "cuda", "--backends", *backends, *scenes, "--degrees", degrees]
        words += ["--no-check", "--no-stages", "--json", RESULT]
        limit = 300.0 if name == "times" else 120.0
        pieces.append(Piece(name, TIMES, setup.script("bench_rasterizer", *words), limit, judge=by_rows))
    return pieces


def explains(setup: Setup) -> list[Piece]:
    """Return the pieces that explain the times."""
    recipes = ["--device", "cuda", "--vram", "low", "--steps", "20", "--json", RESULT]
    return [
        Piece("kernels", EXPLAINS, setup.own("kernels"), 150.0),
        Piece("sorts", EXPLAINS, setup.own("sorts"), 60.0),
        Piece(
            "ncu",
            EXPLAINS,
            setup.own("ncu", "--tool", setup.tools.get("ncu", "")),
            150.0,
            missing=setup.lacks("ncu"),
        ),
        *step(setup),
        Piece(
            "recipes",
            EXPLAINS,
            setup.script("bench_recipes", *recipes),
            300.0,
            missing=setup.lacks("diffusers"),
            judge=by_recipes,
        ),
        Piece(
            "tests of gsplat",
            EXPLAINS,
            setup.tests(*GSPLAT_TESTS),
            60.0,
            missing=setup.lacks("pytest") or (None if setup.has_gsplat else "gsplat is not built"),
            judge=by_pytest,
            environment=ONE_THREAD,
        ),
    ]


def step(setup: Setup) -> list[Piece]:
    """Return the benchmark of whole training steps, with small priors and with networks of full size."""

    def with_priors(*priors: str) -> tuple[str, ...]:
        words = ("--device", "cuda", "--priors", *priors, "--json", RESULT)
        return setup.script("bench_step", *words)

    return [
        Piece("step", EXPLAINS, with_priors("exact", "learned"), 120.0, judge=by_steps),
        Piece(
            "step of a network",
            EXPLAINS,
            with_priors("random"),
            180.0,
            missing=setup.lacks("diffusers"),
            judge=by_steps,
        ),
    ]


def by_pytest(finished: Finished) -> tuple[str, str]:
    """Judge a run of pytest, which fails if no test ran at all."""
    says = finished.last_line.strip("= ")
    if finished.code == 0 and re.search(r"\d+ passed", says):
        return PASSED, says
    failed = re.findall(r"^(?:FAILED|ERROR) (\S+)", finished.log, re.MULTILINE)
    return FAILED, f"{says}: {', '.join(failed[:3])}" if failed else says


def by_sanitizer(finished: Finished) -> tuple[str, str]:
    """Judge a run of compute-sanitizer by its summary; without one, the tool cannot run here."""
    found = re.findall(r"^=+ (?:ERROR|RACECHECK) SUMMARY: (.*)$", finished.log, re.MULTILINE)
    if not found or re.search(r"device not supported|unable to", finished.log, re.IGNORECASE):
        return SKIPPED, f"the tool does not work on this machine: {_quoted(finished.log)}"
    is_clean = re.match(r"0 (?:errors|hazards)\b", found[-1]) is not None
    return (PASSED if is_clean and finished.code == 0 else FAILED), found[-1]


def _quoted(log: str) -> str:
    """Return the most useful line of a log: the last one of the tool, or else the last one."""
    lines = [line.strip("= \n") for line in log.splitlines()]
    of_tool = [line.strip("= ") for line in log.splitlines() if line.startswith("====")]
    return next((line for line in reversed([*lines, *of_tool]) if line), "no output")


def by_check(finished: Finished) -> tuple[str, str]:
    """Judge ``bench_rasterizer --check-only``: its verdict, and what it could not check."""
    lines = [line.strip() for line in finished.log.splitlines() if line.strip()]
    verdicts = [line for line in lines if line.startswith(("check ", "not enough memory"))]
    if finished.code == 0 and verdicts:
        return PASSED, "; ".join(verdicts)
    following = lines[lines.index(verdicts[-1]) :] if verdicts else lines[-1:]
    return FAILED, "; ".join(following[:4])


def by_rows(finished: Finished) -> tuple[str, str]:
    """Judge a run of ``bench_rasterizer`` by the rows that it has written."""
    rows = (finished.result or {}).get("rows", [])
    if finished.code != 0 or not rows:
        return FAILED, f"exit code {finished.code} after {len(rows)} rows: {finished.last_line}"
    return PASSED, f"{len(rows)} rows"


def by_recipes(finished: Finished) -> tuple[str, str]:
    """Judge ``bench_recipes`` by its seconds per step."""
    results = (finished.result or {}).get("results", [])
    if finished.code != 0 or not results:
        return FAILED, f"exit code {finished.code}: {finished.last_line}"
    each = [f"{found['recipe']} {found['seconds_per_step']:.2f} s per step" for found in results]
    return PASSED, ", ".join(each)


def by_steps(finished: Finished) -> tuple[str, str]:
    """Judge ``bench_step`` by the milliseconds of whole steps."""
    steps = (finished.result or {}).get("here", [])
    if finished.code != 0 or not steps:
        return FAILED, f"exit code {finished.code}: {finished.last_line}"
    return PASSED, ", ".join(f"{found['prior']} prior {found['wall_ms']:.1f} ms per step" for found in steps)


def by_last_line(pattern: str) -> Judge:
    """Return a judge of the exit code, which quotes the last line that matches ``pattern``."""

    def judge(finished: Finished) -> tuple[str, str]:
        found = re.findall(pattern, finished.log)
        says = next((line for line in reversed(found) if line.strip()), finished.last_line)
        if finished.code == 0:
            return PASSED, says.strip()
        return FAILED, f"exit code {finished.code}: {finished.last_line}"

    return judge
