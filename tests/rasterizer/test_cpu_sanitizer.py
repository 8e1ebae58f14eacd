"""ThreadSanitizer, AddressSanitizer and UndefinedBehaviorSanitizer watch the threads of the CPU kernels."""

import subprocess
import sys
from pathlib import Path

import pytest
from emulation import content_hash, make_once

from cadam3d.compiled.library import SIMD, find_compiler
from cadam3d.rasterizer.base import KERNELS, definitions
from cadam3d.rasterizer.cpu import SOURCES

PROGRAM = Path(__file__).parent / "cpu_threads.cpp"
# Without memory that is kept, a sanitizer sees the bounds of every array.
FLAGS = ("-std=c++17", "-O1", "-g1", "-pthread", "-ffp-contract=off", "-Wno-psabi", "-DSPLAT_KEPT_BYTES=0")


@pytest.fixture
def compile_with(build_cache, tmp_path):
    """Return a function that compiles the program with a sanitizer, and skips if there is none."""

    def compile_program(*sanitizer: str) -> Path:
        compiler = find_compiler()
        if compiler is None or sys.platform != "linux":
            pytest.skip("no C++ compiler for Linux")
        command = [*compiler.command, *FLAGS, *sanitizer]
        empty, small = tmp_path / "empty.cpp", tmp_path / "empty"
        empty.write_text("int main() { return 0; }\n")
        for line in ([*command, str(empty), "-o", str(small)], [str(small)]):
            if subprocess.run(line, capture_output=True, check=False).returncode != 0:
                pytest.skip(f"{' '.join(sanitizer)} does not work here")
        sources = [PROGRAM, *SOURCES]
        words = [*command, *definitions(), f"-I{KERNELS}", f"-I{SIMD.parent}", str(PROGRAM)]
        facts = [*words, compiler.version, *(path.read_text(encoding="utf-8") for path in sources)]

        def make(path: Path) -> None:
            subprocess.run([*words, "-o", str(path)], check=True)

        return make_once(build_cache / f"threads-{content_hash(*facts)}", make)

    return compile_program


@pytest.mark.parametrize("sanitizer", ["thread", "address,undefined"])
def test_threads_share_no_number_and_leave_no_array(sanitizer, compile_with):
    program = compile_with(f"-fsanitize={sanitizer}", "-fno-sanitize-recover=all")
    outcome = subprocess.run([str(program)], capture_output=True, text=True, check=False)
    assert outcome.returncode == 0, outcome.stdout + outcome.stderr
