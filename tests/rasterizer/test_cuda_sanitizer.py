"""AddressSanitizer, UndefinedBehaviorSanitizer and ThreadSanitizer watch the CUDA kernels, on fibers."""

import os
import re
import subprocess
import sys
from pathlib import Path
from shutil import which

import pytest
from emulation import build_emulator
from mutants import plant

from cadam3d.compiled.library import find_compiler

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
PROGRAM = Path(__file__).parent / "emulator" / "sanitized.py"
# The program continues after a finding, so that one run shows all of them.
FLAGS = ("-g1", "-fsanitize=address,undefined,float-cast-overflow", "-fsanitize-recover=all")
# Mistakes that the sanitizers must report: one reads behind a tensor, one behind shared memory. They only
# read, because a write would end the program.
PLANTED = {
    "heap-buffer-overflow": (
        "tiles.cuh",
        "if (e == slots - 1 || tile_keys[e + 1]",
        "if ((e == slots - 1 && !MUTANT) || tile_keys[e + 1]",
    ),
    "index 4 out of bounds": (
        "blend.cuh",
        "at = stage[0];",
        "at = stage[MUTANT ? 4 : 0];",
    ),
}
# Races that ThreadSanitizer must report: shared memory that a lane reads before another lane has written it,
# and a number of the whole launch that one block writes and the others read.
RACES = {
    "shared memory of a warp": (
        "blend.cuh",
        "    __syncwarp();\n    const u32 count",
        "    if (!MUTANT) __syncwarp();\n    const u32 count",
    ),
    "global memory of two blocks": (
        "sort.cuh",
        "  u32 carry = block_sum(before, shared);",
        "  u32 carry = block_sum(before, shared) + (MUTANT && total && *total == 0xffffffffu);",
    ),
}


def runtime(name: str) -> str:
    """Return the library of a sanitizer that must be loaded before all others."""
    compiler = find_compiler()
    if compiler is None or sys.platform != "linux":
        pytest.skip("no C++ compiler for Linux")
    # GCC prints a path, clang the bare name.
    query = [*compiler.command, f"-print-file-name=lib{name}.so"]
    path = subprocess.run(query, capture_output=True, text=True, check=False).stdout.strip()
    if not Path(path).is_absolute():
        pytest.skip(f"no lib{name} that could be loaded")
    return path


def run_under(name: str, library: Path, word: str) -> subprocess.CompletedProcess[str]:
    """Run the program under a sanitizer."""
    options = {
        "PYTHONPATH": os.pathsep.join(map(str, (ROOT, ROOT / "tests"))),
        "LD_PRELOAD": runtime(name),
        # Python leaks by design, and the sanitizer does not track the stacks of fibers.
        "ASAN_OPTIONS": "detect_leaks=0:detect_stack_use_after_return=0:halt_on_error=0",
        # Python and torch are not compiled for the sanitizer. The names of all functions would take minutes.
        "TSAN_OPTIONS": "ignore_noninstrumented_modules=1:symbolize=0:exitcode=0",
        "OMP_NUM_THREADS": "1",
        # Each array of the rasterizer gets an allocation of its own, as under compute-sanitizer.
        "PYTORCH_NO_CUDA_MEMORY_CACHING": "1",
    }
    # Random addresses may lie where ThreadSanitizer keeps its own memory.
    fixed = ("setarch", "-R") if name == "tsan" and which("setarch") else ()
    command = [*fixed, sys.executable, str(PROGRAM), str(library), word]
    return subprocess.run(
        command, env=os.environ | options, capture_output=True, text=True, timeout=300, check=False
    )


def by_mistake(errors: str) -> list[str]:
    """Return the part of the errors without a mistake, and then the part of each of them."""
    return re.split(r"^planted \d+$", errors, flags=re.MULTILINE)


@pytest.fixture(scope="module")
def outcome(build_cache, tmp_path_factory) -> subprocess.CompletedProcess[str]:
    """Run the program once, for all tests: a start under the sanitizers takes seconds."""
    runtime("asan")
    kernels = plant(PLANTED, tmp_path_factory.mktemp("sanitized"), only_degree_0=False)
    return run_under("asan", build_emulator(build_cache, kernels, "-O0", FLAGS), str(len(PLANTED)))


@pytest.fixture(scope="module")
def findings(outcome) -> list[list[str]]:
    """Return the findings without a mistake, and then with each of them."""
    return [
        [line for line in part.splitlines() if "ERROR: " in line or "runtime error: " in line]
        for part in by_mistake(outcome.stderr)
    ]


def test_the_kernels_stay_in_their_memory(outcome, findings):
    assert findings[0] == []
    assert (outcome.returncode, outcome.stdout) == (0, "all done\n"), outcome.stderr


def test_each_planted_mistake_is_reported(outcome, findings):
    assert len(findings) == 1 + len(PLANTED)
    for expected, found in zip(PLANTED, findings[1:], strict=True):
        assert expected in "\n".join(found), outcome.stderr


def test_threads_share_no_number_without_a_barrier_and_planted_races_are_reported(build_cache, tmp_path):
    runtime("tsan")
    library = build_emulator(build_cache, plant(RACES, tmp_path), "-O1", ("-g1", "-fsanitize=thread"))
    outcome = run_under("tsan", library, "races")
    if "unexpected memory mapping" in outcome.stderr:
        pytest.skip("ThreadSanitizer does not start here")
    assert (outcome.returncode, outcome.stdout) == (0, "all done\n"), outcome.stderr
    ordered, between_lanes, unordered, between_blocks = (
        part.split("WARNING: ThreadSanitizer: data race")[1:]
        for part in re.split(r"^(?:planted \d+|unordered)$", outcome.stderr, flags=re.MULTILINE)
    )
    assert not ordered, outcome.stderr
    assert between_lanes
    # Unordered blocks use the same shared memory, which is a global variable here.
    assert not [race for race in unordered if "heap block" in race], outcome.stderr
    assert [race for race in between_blocks if "heap block" in race]
