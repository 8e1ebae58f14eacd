"""AddressSanitizer and UndefinedBehaviorSanitizer watch the CUDA kernels, on fibers."""

import os
import re
import subprocess
import sys
from pathlib import Path

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


@pytest.fixture(scope="module")
def runtime() -> str:
    """Return the library that must be loaded before all others."""
    compiler = find_compiler()
    if compiler is None or sys.platform != "linux":
        pytest.skip("no C++ compiler for Linux")
    # GCC prints a path, clang the bare name.
    query = [*compiler.command, "-print-file-name=libasan.so"]
    path = subprocess.run(query, capture_output=True, text=True, check=False).stdout.strip()
    if not Path(path).is_absolute():
        pytest.skip("no AddressSanitizer that could be loaded")
    return path


@pytest.fixture(scope="module")
def outcome(runtime, build_cache, tmp_path_factory) -> subprocess.CompletedProcess[str]:
    """Run the program once, for all tests: a start under the sanitizers takes seconds."""
    kernels = plant(PLANTED, tmp_path_factory.mktemp("sanitized"), only_degree_0=False)
    library = build_emulator(build_cache, kernels, "-O0", FLAGS)
    options = {
        "PYTHONPATH": os.pathsep.join(map(str, (ROOT, ROOT / "tests"))),
        "LD_PRELOAD": runtime,
        # Python leaks by design, and the sanitizer does not track the stacks of fibers.
        "ASAN_OPTIONS": "detect_leaks=0:detect_stack_use_after_return=0:halt_on_error=0",
        "OMP_NUM_THREADS": "1",
        # Each array of the rasterizer gets an allocation of its own, as under compute-sanitizer.
        "PYTORCH_NO_CUDA_MEMORY_CACHING": "1",
    }
    command = [sys.executable, str(PROGRAM), str(library), str(len(PLANTED))]
    return subprocess.run(
        command, env=os.environ | options, capture_output=True, text=True, timeout=300, check=False
    )


@pytest.fixture(scope="module")
def findings(outcome) -> list[list[str]]:
    """Return the findings without a mistake, and then with each of them."""
    return [
        [line for line in part.splitlines() if "ERROR: " in line or "runtime error: " in line]
        for part in re.split(r"^planted \d+$", outcome.stderr, flags=re.MULTILINE)
    ]


def test_the_kernels_stay_in_their_memory(outcome, findings):
    assert findings[0] == []
    assert (outcome.returncode, outcome.stdout) == (0, "all done\n"), outcome.stderr


def test_each_planted_mistake_is_reported(outcome, findings):
    assert len(findings) == 1 + len(PLANTED)
    for expected, found in zip(PLANTED, findings[1:], strict=True):
        assert expected in "\n".join(found), outcome.stderr
