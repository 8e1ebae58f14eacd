"""Calls of the CUDA driver: the device and stream that kernels use, and the messages for its errors."""

import ctypes
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from splats import backgrounds, make_cameras, make_gaussians

from cadam3d.compiled.build import find_compiler
from cadam3d.core.errors import UserError
from cadam3d.rasterizer import driver
from cadam3d.rasterizer.cuda import BLEND_BLOCK, MOST, WARP, CudaRasterizer, _launch_each
from cadam3d.rasterizer.driver import Module, load_driver
from cadam3d.rasterizer.nvrtc import Cubin

# A driver with the kernels "works" and "full". It records the launches of the first kernel, and it has no
# memory for the second.
STUB = """
#include <string.h>
extern "C" {
static int pushed = 0;
static void* current = 0;
unsigned long long stub_launched[9];
int stub_pushed() { return pushed; }
int cuInit(unsigned) { return 0; }
int cuDeviceGet(int* device, int ordinal) { *device = ordinal; return 0; }
int cuDevicePrimaryCtxRetain(void** context, int device) { *context = (char*)0 + 100 + device; return 0; }
int cuCtxPushCurrent_v2(void* context) { ++pushed; current = context; return 0; }
int cuCtxPopCurrent_v2(void**) { --pushed; return 0; }
int cuModuleLoadData(void**, const char* cubin) { return strcmp(cubin, "foreign") == 0 ? 209 : 0; }
int cuModuleGetFunction(void** function, void*, const char* name) {
  *function = &pushed;
  return strcmp(name, "works") == 0 ? 0 : strcmp(name, "full") == 0 ? 2 : 500;
}
int cuLaunchKernel(void*, unsigned x, unsigned y, unsigned z, unsigned threads_x, unsigned threads_y,
                   unsigned threads_z, unsigned shared, void* stream, void**, void**) {
  const unsigned long long all[] = {x, y, z, threads_x, threads_y, threads_z, shared,
                                    (unsigned long long)stream, (unsigned long long)current};
  memcpy(stub_launched, all, sizeof(all));
  return 0;
}
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


def test_errors_of_the_driver_are_quoted(stub):
    with (
        pytest.raises(UserError, match=r"cuModuleGetFunction: named symbol not found \(500\)"),
        Module(stub, 0, b"").launching(0) as launch,
    ):
        launch("unknown", 1, 32, torch.zeros(1), 3, None)
    with pytest.raises(UserError, match="no kernel image"):
        Module(stub, 0, b"foreign")


def test_running_out_of_memory_is_not_a_user_error(stub):
    with pytest.raises(MemoryError, match="out of memory"), Module(stub, 0, b"").launching(0) as launch:
        launch("full", 1, 32)


def test_the_context_is_popped_even_after_an_error(stub):
    before, inside = stub.stub_pushed(), []
    with pytest.raises(UserError), Module(stub, 0, b"").launching(0) as launch:
        launch("unknown", 1, inside.append(stub.stub_pushed()) or 32)
    assert inside == [before + 1]
    assert stub.stub_pushed() == before


def test_a_missing_driver_is_reported_with_a_hint(monkeypatch):
    monkeypatch.setattr(driver, "LIBRARY", "libcuda-that-does-not-exist.so.1")
    with pytest.raises(UserError, match="Try: nvidia-smi"):
        load_driver()


class FakeCuda:
    """A replacement of ``torch.cuda`` with two devices; number 0 is current, and each has a side stream."""

    def __init__(self) -> None:
        self.index = 0

    def current_device(self) -> int:
        return self.index

    @contextmanager
    def device(self, index: int) -> Iterator[None]:
        before, self.index = self.index, index
        yield
        self.index = before

    def get_device_capability(self, index: int) -> tuple[int, int]:
        return (8, index)

    def current_stream(self, index: int) -> SimpleNamespace:
        return SimpleNamespace(cuda_stream=2**40 + index)  # a handle has more than 32 bits


@pytest.fixture
def built(stub, monkeypatch, tmp_path) -> list[tuple[int, int]]:
    """Return the compute capabilities that kernels are built for, on the stub and the fake devices."""
    asked = []

    def build(_, capability):
        asked.append(capability)
        return Cubin(tmp_path / "cubin", 0.0)

    (tmp_path / "cubin").write_bytes(b"")
    monkeypatch.setattr(torch, "cuda", FakeCuda())
    monkeypatch.setattr(driver, "load_driver", lambda: stub)
    monkeypatch.setattr(driver, "build", build)
    return asked


def launched(stub) -> dict[str, object]:
    x, y, z, threads, *threads_yz, shared, stream, context = (ctypes.c_ulonglong * 9).in_dll(
        stub, "stub_launched"
    )
    assert (y, z, *threads_yz, shared) == (1, 1, 1, 1, 0)
    return {"blocks": x, "threads": threads, "stream": stream, "context": context}


@pytest.mark.parametrize(("device", "index"), [("cuda", 0), ("cuda:0", 0), ("cuda:1", 1)])
def test_kernels_run_on_the_given_device_and_its_current_stream(stub, built, tmp_path, device, index):
    with driver.Driver(tmp_path).on(torch.device(device)) as launch:
        assert torch.cuda.current_device() == index
        launch("works", 70_000, 256, None)
    assert torch.cuda.current_device() == 0
    assert built == [(8, index)]
    stream, context = 2**40 + index, 100 + index
    assert launched(stub) == {"blocks": 70_000, "threads": 256, "stream": stream, "context": context}


def test_kernels_are_loaded_once_for_each_device(stub, built, tmp_path):
    everywhere = driver.Driver(tmp_path)
    for device in ("cuda:0", "cuda:1", "cuda", "cuda:1"):
        with everywhere.on(torch.device(device)) as launch:
            launch("works", 1, 1)
    assert built == [(8, 0), (8, 1)]
    assert launched(stub)["context"] == 101


def test_the_largest_grid_has_one_dimension(stub):
    blocks = []
    _launch_each(lambda kernel, count, *_: blocks.append(count), "any", MOST * WARP, BLEND_BLOCK)
    assert blocks == [-(-MOST * WARP // BLEND_BLOCK)]
    assert 65535 < blocks[0] < 2**31
    with Module(stub, 0, b"").launching(0) as launch:
        launch("works", blocks[0], BLEND_BLOCK)
    assert launched(stub)["blocks"] == blocks[0]


# -------------------------------------------------------------------------- on real devices


def differentiate(gaussians, cameras, device):
    output = CudaRasterizer(cache_dir=None).render(gaussians, cameras, backgrounds(2).to(device))
    (output.rgb.square().sum() + output.depth.sum()).backward()
    return [output.rgb.detach(), *(tensor.grad for tensor in gaussians.tensors().values())]


def leaves(device):
    return make_gaussians(1000, degree=1).to(device).map(lambda tensor: tensor.detach().requires_grad_())


@pytest.mark.gpu
def test_forward_and_backward_run_on_the_current_stream():
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    cameras = make_cameras(2, 64, 80)
    want = differentiate(leaves("cuda"), cameras, "cuda")
    source, late = leaves("cuda"), leaves("cuda").map(torch.zeros_like)
    torch.cuda.synchronize()
    with torch.cuda.stream(torch.cuda.Stream()):
        # A kernel on another stream would read the zeros.
        torch.cuda._sleep(10**8)
        for name, tensor in late.tensors().items():
            tensor.copy_(getattr(source, name).detach())
        got = differentiate(late.map(lambda tensor: tensor.requires_grad_()), cameras, "cuda")
    torch.cuda.synchronize()
    for a, b in zip(got, want, strict=True):
        assert torch.equal(a, b)


@pytest.mark.gpu
def test_a_second_device_gives_the_same_bits_and_leaves_the_first_current():
    if torch.cuda.device_count() < 2:
        pytest.skip("no second CUDA device")
    if torch.cuda.get_device_name(0) != torch.cuda.get_device_name(1):
        pytest.skip("two kinds of devices")
    cameras = make_cameras(2, 64, 80)
    want, got = (differentiate(leaves(device), cameras, device) for device in ("cuda:0", "cuda:1"))
    assert torch.cuda.current_device() == 0
    for a, b in zip(got, want, strict=True):
        assert b.device.index == 0
        assert a.device.index == 1
        assert torch.equal(a.cpu(), b.cpu())
