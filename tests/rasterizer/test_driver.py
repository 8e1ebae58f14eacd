"""Calls of the CUDA driver: the device and stream that kernels use, and the messages for its errors."""

import ctypes
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from splats import backgrounds, make_cameras, make_gaussians

from cadam3d.compiled.library import find_compiler
from cadam3d.core.errors import UserError
from cadam3d.rasterizer import driver
from cadam3d.rasterizer.cuda import (
    CudaRasterizer,
    rasterize,
)
from cadam3d.rasterizer.driver import Module, load_driver

# A driver with all kernels except "unknown". It records launches, and it has no memory for the kernel "full".
STUB = """
#include <dlfcn.h>
#include <string.h>
extern "C" {
int stub_locked[4] = {-1, -1, -1, -1};  // whether Python's lock was held: by push, launch, pop, load
static void note(int call) {
  if (void* check = dlsym(RTLD_DEFAULT, "PyGILState_Check")) stub_locked[call] = ((int (*)())check)();
}
static int pushed = 0;
static void* current = 0;
unsigned long long stub_launched[9], stub_streams[256], stub_arguments[32], stub_count = 0;
int stub_pushed() { return pushed; }
int cuInit(unsigned) { return 0; }
int cuDeviceGet(int* device, int ordinal) { *device = ordinal; return 0; }
int cuDevicePrimaryCtxRetain(void** context, int device) { *context = (char*)0 + 100 + device; return 0; }
int cuCtxPushCurrent_v2(void* context) { note(0); ++pushed; current = context; return 0; }
int cuCtxPopCurrent_v2(void**) { note(2); --pushed; return 0; }
int cuModuleLoadData(void**, const char* cubin) {
  note(3);
  return strcmp(cubin, "foreign") == 0 ? 209 : 0;
}
int cuModuleGetFunction(void** function, void*, const char* name) {
  *function = &pushed;
  return strcmp(name, "unknown") == 0 ? 500 : strcmp(name, "full") == 0 ? 2 : 0;
}
int cuLaunchKernel(void*, unsigned x, unsigned y, unsigned z, unsigned threads_x, unsigned threads_y,
                   unsigned threads_z, unsigned shared, void* stream, void**, void** extra) {
  note(1);
  const unsigned long long all[] = {x, y, z, threads_x, threads_y, threads_z, shared,
                                    (unsigned long long)stream, (unsigned long long)current};
  memcpy(stub_launched, all, sizeof(all));
  stub_streams[stub_count++ % 256] = all[7];
  memcpy(stub_arguments, extra[1], *(unsigned long long*)extra[3]);
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
        launch("unknown", 1, 32, 2**40, 3, 0)
    with pytest.raises(UserError, match="no kernel image"):
        Module(stub, 0, b"foreign")


def test_a_kernel_that_failed_before_is_not_called_ours(stub):
    with pytest.raises(UserError, match=r"^CUDA: some kernel of this process failed before") as caught:
        Module(stub, 0, b"").check("cuLaunchKernel", 700)
    assert "rasterizer=" not in str(caught.value)


def test_running_out_of_memory_is_not_a_user_error(stub):
    with pytest.raises(MemoryError, match="out of memory"), Module(stub, 0, b"").launching(0) as launch:
        launch("full", 1, 32)


def test_the_context_is_popped_even_after_an_error(stub):
    before, inside = stub.stub_pushed(), []
    with pytest.raises(UserError), Module(stub, 0, b"").launching(0) as launch:
        launch("unknown", 1, inside.append(stub.stub_pushed()) or 32)
    assert inside == [before + 1]
    assert stub.stub_pushed() == before


def test_a_launch_keeps_pythons_lock_and_loading_releases_it(stub):
    """Another thread may hold the lock for milliseconds, which is longer than a step takes."""
    with Module(stub, 0, b"").launching(0) as launch:
        launch("some", 1, 32)
    push, launched, pop, loaded = (ctypes.c_int * 4).in_dll(stub, "stub_locked")
    if launched == -1:
        pytest.skip("this interpreter does not export its functions")
    assert (push, launched, pop, loaded) == (1, 1, 1, 0)


def test_a_missing_driver_is_reported_with_a_hint(monkeypatch):
    monkeypatch.setattr(driver, "LIBRARY", "libcuda-that-does-not-exist.so.1")
    with pytest.raises(UserError, match="Try: nvidia-smi"):
        load_driver()


def test_two_threads_never_share_a_buffer_of_arguments(stub):
    module = Module(stub, 0, b"")
    with module.launching(0) as one, module.launching(0) as other:
        assert one is not other
    with module.launching(0) as again:
        assert again in (one, other), "a buffer is used again"


def test_a_thread_may_take_the_last_buffer_while_another_one_looks(stub):
    class Contested(list):
        """Has a buffer for those that look, which is gone when they take it."""

        def __len__(self) -> int:
            return 1

    module = Module(stub, 0, b"")
    module.idle = Contested()
    with module.launching(3) as launch:
        launch("works", 1, 32)


class FakeCuda:
    """A replacement of ``torch.cuda`` with two devices; number 0 is current, and each has a side stream."""

    def __init__(self) -> None:
        self.index, self.stream = 0, 2**40  # a handle has more than 32 bits

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
        return SimpleNamespace(cuda_stream=self.stream + index)


@pytest.fixture
def built(stub, monkeypatch, tmp_path) -> list[tuple[int, int]]:
    """Return the compute capabilities that kernels are built for, on the stub and the fake devices."""
    asked = []

    def build(_, capability):
        asked.append(capability)
        return tmp_path / "cubin"

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
        launch("works", 70_000, 256, 0)
    assert torch.cuda.current_device() == 0
    assert built == [(8, index)]
    stream, context = 2**40 + index, 100 + index
    assert launched(stub) == {"blocks": 70_000, "threads": 256, "stream": stream, "context": context}


def streams_of_a_step(stub, launcher, stream: int) -> set[int]:
    """Return the streams of all launches of a forward and backward pass while ``stream`` is current."""
    torch.cuda.stream = stream
    count = ctypes.c_ulonglong.in_dll(stub, "stub_count")
    count.value = 0
    gaussians = make_gaussians(50).map(lambda tensor: tensor.detach().requires_grad_())
    output = rasterize(launcher, gaussians, make_cameras(2, 9, 17), backgrounds(2), capacity=100)
    images = (output.rgb, output.alpha, output.depth)
    torch.autograd.backward(images, [torch.ones_like(image) for image in images])
    assert 10 < count.value < 256
    return set((ctypes.c_ulonglong * 256).in_dll(stub, "stub_streams")[: count.value])


def test_every_launch_is_on_the_stream_that_is_current_at_that_time(stub, built, tmp_path, monkeypatch):
    launcher = driver.Driver(tmp_path)
    for stream in (2**41, 2**42, 2**41):
        assert streams_of_a_step(stub, launcher, stream) == {stream}
    # A stream that is remembered from another call would be wrong, and this is noticed.
    launching = Module.launching
    monkeypatch.setattr(Module, "launching", lambda module, _: launching(module, 2**41))
    assert streams_of_a_step(stub, launcher, 2**42) == {2**41}


class Recorder:
    """The functions of a driver, which also write their names down."""

    def __init__(self, library: ctypes.CDLL) -> None:
        self.library, self.names = library, []

    def __getattr__(self, name: str):
        function = getattr(self.library, name)
        return lambda *arguments: self.names.append(name) or function(*arguments)


# -------------------------------------------------------------------------- on real devices


def differentiate(gaussians, cameras, background, before_backward=lambda: None):
    output = CudaRasterizer(cache_dir=None).render(gaussians, cameras, background)
    loss = output.rgb.square().sum() + output.depth.sum()
    before_backward()
    loss.backward()
    return [output.rgb.detach(), *(tensor.grad for tensor in gaussians.tensors().values())]


def leaves(device):
    return make_gaussians(1000, degree=1).to(device).map(lambda tensor: tensor.detach().requires_grad_())


@pytest.mark.gpu
def test_forward_and_backward_run_on_the_current_stream():
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    # Everything is on the device beforehand, because an upload would wait for the device before any launch.
    scene = make_cameras(2, 64, 80).to("cuda"), backgrounds(2).cuda()
    want = differentiate(leaves("cuda"), *scene)
    source, late = leaves("cuda"), leaves("cuda").map(torch.zeros_like)
    torch.cuda.synchronize()
    with torch.cuda.stream(torch.cuda.Stream()):
        # A kernel on another stream would overtake the pause and read the zeros.
        torch.cuda._sleep(10**8)
        for name, tensor in late.tensors().items():
            tensor.copy_(getattr(source, name).detach())
        # A backward pass on another stream would overtake the pause before it, and read gradients and records
        # of the images that are not there yet.
        pause = partial(torch.cuda._sleep, 10**8)
        got = differentiate(late.map(lambda tensor: tensor.requires_grad_()), *scene, pause)
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
    want, got = (
        differentiate(leaves(device), cameras, backgrounds(2).to(device)) for device in ("cuda:0", "cuda:1")
    )
    assert torch.cuda.current_device() == 0
    for a, b in zip(got, want, strict=True):
        assert b.device.index == 0
        assert a.device.index == 1
        assert torch.equal(a.cpu(), b.cpu())
