"""Talking to the CUDA driver: arguments are packed in test_cuda.py; here, what is said when it refuses."""

import ctypes
import subprocess
from pathlib import Path

import pytest
import torch

from cadam3d.core.checks import UserError
from cadam3d.rasterizer import driver
from cadam3d.rasterizer.build import find_compiler
from cadam3d.rasterizer.driver import Module, load_driver

# A driver that refuses: a kernel called "full" finds no memory, any other is unknown.
STUB = """
#include <string.h>
extern "C" {
static int pushed = 0, last = 0;
int stub_pushed() { return pushed; }
int cuInit(unsigned) { return 0; }
int cuDeviceGet(int* device, int ordinal) { *device = ordinal; return 0; }
int cuDevicePrimaryCtxRetain(void** context, int) { *context = 0; return 0; }
int cuCtxPushCurrent_v2(void*) { ++pushed; return 0; }
int cuCtxPopCurrent_v2(void**) { --pushed; return 0; }
int cuModuleLoadData(void**, const char* cubin) { return strcmp(cubin, "foreign") == 0 ? 209 : 0; }
int cuModuleGetFunction(void**, void*, const char* name) { return strcmp(name, "full") == 0 ? 2 : 500; }
int cuGetErrorString(int status, const char** text) {
  *text = status == 2 ? "out of memory" : status == 209 ? "no kernel image" : "named symbol not found";
  return 0;
}
}
"""


@pytest.fixture(scope="module")
def stub(tmp_path_factory) -> ctypes.CDLL:
    compiler = find_compiler()
    if compiler is None:
        pytest.skip("no C++ compiler")
    folder: Path = tmp_path_factory.mktemp("stub")
    (folder / "stub.cpp").write_text(STUB)
    command = [*compiler.command, "-shared", "-fPIC", str(folder / "stub.cpp"), "-o", str(folder / "stub.so")]
    subprocess.run(command, check=True)
    return ctypes.CDLL(str(folder / "stub.so"))


def test_what_the_driver_refuses_is_quoted(stub):
    with (
        pytest.raises(UserError, match=r"cuModuleGetFunction: named symbol not found \(500\)"),
        Module(stub, 0, b"").launching(0) as launch,
    ):
        launch("unknown", 1, 32, torch.zeros(1), 3, None)
    with pytest.raises(UserError, match="no kernel image"):
        Module(stub, 0, b"foreign")


def test_to_run_out_of_memory_is_an_outcome_and_not_a_mistake_of_the_user(stub):
    with pytest.raises(MemoryError, match="out of memory"), Module(stub, 0, b"").launching(0) as launch:
        launch("full", 1, 32)


def test_the_context_is_given_back_whatever_happens(stub):
    before, inside = stub.stub_pushed(), []
    with pytest.raises(UserError), Module(stub, 0, b"").launching(0) as launch:
        launch("unknown", 1, inside.append(stub.stub_pushed()) or 32)
    assert inside == [before + 1]
    assert stub.stub_pushed() == before


def test_without_a_driver_it_says_what_to_type(monkeypatch):
    monkeypatch.setattr(driver, "LIBRARY", "libcuda-of-nobody.so.1")
    with pytest.raises(UserError, match="Try: nvidia-smi"):
        load_driver()
