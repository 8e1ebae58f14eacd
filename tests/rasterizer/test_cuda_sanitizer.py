"""What AddressSanitizer and UndefinedBehaviorSanitizer say of the CUDA kernels, on fibers."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from cadam3d.rasterizer.build import KERNELS, find_compiler

ROOT = Path(__file__).parents[2]
PROGRAM = Path(__file__).parent / "emulator" / "sanitized.py"
# All findings of a run are wanted, so it goes on after one.
FLAGS = ("-g1", "-fsanitize=address,undefined,float-cast-overflow", "-fsanitize-recover=all")
# Both only read, or they would end the run: one behind a tensor, one behind shared memory.
PLANTED = {
    "heap-buffer-overflow": ("tiles.cuh", "if (e == slots - 1 || tile_keys[e + 1]", "if (tile_keys[e + 1]"),
    "index 3 out of bounds": (
        "blend.cuh",
        "stage[2][j]);\n      const u32",
        "stage[3][j]);\n      const u32",
    ),
}


@pytest.fixture(scope="module")
def runtime() -> str:
    """Where the library is that must be loaded before all others."""
    compiler = find_compiler()
    if compiler is None or sys.platform != "linux":
        pytest.skip("no C++ compiler for Linux")
    query = [*compiler.command, "-print-file-name=libasan.so"]  # of GCC; clang says the bare name
    path = subprocess.run(query, capture_output=True, text=True, check=False).stdout.strip()
    if not Path(path).is_absolute():
        pytest.skip("no AddressSanitizer to be loaded")
    return path


def run(runtime: str, folder: Path, kernels: Path) -> subprocess.CompletedProcess[str]:
    options = {
        "PYTHONPATH": os.pathsep.join(map(str, (ROOT, ROOT / "tests"))),
        "LD_PRELOAD": runtime,
        # Python leaks by design, and fibers bring stacks of their own.
        "ASAN_OPTIONS": "detect_leaks=0:detect_stack_use_after_return=0:halt_on_error=0",
        "OMP_NUM_THREADS": "1",
    }
    command = [sys.executable, str(PROGRAM), str(folder), str(kernels), *FLAGS]
    return subprocess.run(
        command, env=os.environ | options, capture_output=True, text=True, timeout=300, check=False
    )


def findings(done: subprocess.CompletedProcess[str]) -> list[str]:
    return [line for line in done.stderr.splitlines() if "ERROR: " in line or "runtime error: " in line]


def test_the_kernels_stay_in_their_memory(runtime, tmp_path):
    done = run(runtime, tmp_path, KERNELS)
    assert findings(done) == []
    assert (done.returncode, done.stdout) == (0, "all done\n"), done.stderr


def test_who_leaves_it_is_reported(runtime, tmp_path):
    kernels = tmp_path / "kernels"
    shutil.copytree(KERNELS, kernels)
    for name, original, changed in PLANTED.values():
        source = (kernels / name).read_text()
        assert source.count(original) == 1
        (kernels / name).write_text(source.replace(original, changed))
    report = "\n".join(findings(run(runtime, tmp_path, kernels)))
    for wanted in PLANTED:
        assert wanted in report, report
