"""Compiling the CUDA kernels at run time: for every architecture, with a cache and helpful errors."""

import ctypes
import os
import re
from dataclasses import replace
from pathlib import Path

import pytest
from emulation import content_hash, make_once

from cadam3d.core.errors import UserError
from cadam3d.rasterizer import base, nvrtc
from cadam3d.rasterizer.nvrtc import build, choose_architecture, compile_kernels, find_compiler

pytestmark = pytest.mark.slow

# All architectures since Turing, which is the oldest that CUDA 13 compiles for.
ARCHITECTURES = (75, 80, 86, 87, 88, 89, 90, 100, 101, 103, 107, 110, 120, 121)
# One of each generation, or all of them with CADAM3D_ARCHITECTURES=all.
COMPILED = ARCHITECTURES if os.environ.get("CADAM3D_ARCHITECTURES") == "all" else (75, 86, 90, 100, 120)
# The largest number of registers per thread on any of them, with the NVRTC of CUDA 12.6, 12.8, 13.0 and 13.5.
# With 64 registers, half of the threads of an SM are in use; with those of the backward pass of degree 3,
# which holds 48 coefficients, less than a fifth.
REGISTERS = {
    "blend_backward_8x4": 48,
    "blend_backward_8x8": 59,
    "blend_backward_absolute_8x4": 50,
    "blend_backward_absolute_8x8": 61,
    "blend_forward_8x4": 44,
    "blend_forward_8x8": 52,
    "centre_backward": 42,
    "prepare_cameras": 48,
    "project_backward_1": 96,
    "project_backward_4": 126,
    "project_backward_9": 128,
    "project_backward_16": 168,
    "project_forward_1": 64,
    "project_forward_4": 67,
    "project_forward_9": 67,
    "project_forward_16": 64,
    "scan_apply": 59,
    "scan_reduce": 48,
    "sort_columns": 64,
    "sort_count": 56,
    "sort_scatter": 128,
    "sum_absolutes": 54,
    "tile_list": 62,
    "tile_ranges": 16,
}


@pytest.fixture(scope="module")
def compiler():
    """Return the NVRTC of the environment, or the library that the variable CADAM3D_NVRTC names."""
    chosen = os.environ.get("CADAM3D_NVRTC")
    found = nvrtc._load(chosen) if chosen else find_compiler()
    if found is None:
        pytest.skip("no NVRTC: pip install nvidia-cuda-nvrtc")
    return found


def compile_verbosely(compiler: nvrtc.Nvrtc, architecture: int, folder: Path) -> str:
    """Return the log of a compilation. A log in ``folder`` is used if nothing has changed since."""
    key = content_hash(nvrtc._key(compiler), Path(nvrtc.__file__).read_text())

    def write_log(path: Path) -> None:
        logs = []
        compiled = compile_kernels(compiler, architecture, logs.append)
        assert compiled.startswith(b"\x7fELF")
        path.write_text("\n".join(logs))

    return make_once(folder / f"nvrtc-{key}-sm{architecture}.log", write_log).read_text()


@pytest.mark.parametrize("architecture", COMPILED)
def test_every_kernel_fits_its_architecture_without_spills(compiler, architecture, build_cache, monkeypatch):
    if architecture not in compiler.architectures:
        pytest.skip(f"the NVRTC of CUDA {compiler.version} does not support sm_{architecture}")
    monkeypatch.setattr(nvrtc, "OPTIONS", (*nvrtc.OPTIONS, "--ptxas-options=-v"))
    log = compile_verbosely(compiler, architecture, build_cache)
    usage = re.findall(
        r"entry function '(\w+)'.*?(\d+) bytes stack frame, (\d+) bytes spill stores.*?Used (\d+) registers",
        log,
        flags=re.DOTALL,
    )
    assert {name: int(registers) for name, *_, registers in usage if int(registers) > REGISTERS[name]} == {}
    assert {(int(stack), int(spills)) for _, stack, spills, _ in usage} == {(0, 0)}
    assert {name for name, *_ in usage} == set(REGISTERS)


def test_a_build_comes_from_the_cache_unless_its_file_is_damaged(compiler, tmp_path, monkeypatch):
    compiled = []
    monkeypatch.setattr(nvrtc, "compile_kernels", lambda *_: compiled.append(1) or b"\x7fELF and so on")
    first = build(tmp_path, (8, 6))
    assert "-sm86-" in first.name
    intact, second = first.read_bytes(), build(tmp_path, (8, 6))
    assert (second, len(compiled)) == (first, 1)
    assert list(tmp_path.iterdir()) == [first], "there are no temporary files"
    first.write_bytes(intact[:-1])
    assert build(tmp_path, (8, 6)) == first
    assert len(compiled) == 2
    assert first.read_bytes() == intact


@pytest.mark.parametrize(
    ("capability", "wanted"),
    [((7, 5), 75), ((8, 0), 80), ((8, 6), 86), ((8, 7), 87), ((8, 8), 86), ((10, 3), 100), ((12, 1), 120)],
)
def test_the_newest_architecture_that_runs_on_the_device_is_chosen(capability, wanted):
    compiler = nvrtc.Nvrtc(ctypes.CDLL(None), "", (13, 0), (75, 80, 86, 87, 90, 100, 101, 120))
    assert choose_architecture(capability, compiler) == wanted


@pytest.mark.parametrize("capability", [(6, 1), (7, 0), (11, 0)])
def test_a_device_that_the_compiler_does_not_support_is_refused(capability):
    compiler = nvrtc.Nvrtc(ctypes.CDLL(None), "", (13, 0), (75, 80, 86, 87, 90, 100, 101, 120))
    with pytest.raises(UserError, match=rf"CUDA 13\.0 .* capability {capability[0]}\.{capability[1]}"):
        choose_architecture(capability, compiler)


def test_a_missing_compiler_is_reported_with_what_to_install(monkeypatch, tmp_path):
    monkeypatch.setattr(nvrtc, "find_compiler", lambda: None)
    with pytest.raises(UserError, match="pip install nvidia-cuda-nvrtc"):
        build(tmp_path, (8, 0))


def test_a_compilation_error_is_quoted(compiler, monkeypatch):
    monkeypatch.setattr(nvrtc, "OPTIONS", (*nvrtc.OPTIONS, "-DRECORD=nonsense*"))
    with pytest.raises(UserError, match="NVRTC_ERROR_COMPILATION"):
        compile_kernels(compiler, compiler.architectures[-1])


def test_the_cache_distinguishes_compilers_options_and_constants(compiler, monkeypatch):
    keys = {nvrtc._key(compiler), nvrtc._key(replace(compiler, version=(99, 0)))}
    monkeypatch.setattr(nvrtc, "OPTIONS", ())
    keys.add(nvrtc._key(compiler))
    monkeypatch.setattr(base, "BLUR", 0.1)
    keys.add(nvrtc._key(compiler))
    assert len(keys) == 4
