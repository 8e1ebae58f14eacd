"""The native kernels, compiled once for all tests: never from, or into, the cache of who runs them."""

import pytest
import torch
from emulation import Emulator, compile_emulator
from splats import Backend

from cadam3d.rasterizer.build import build, find_compiler
from cadam3d.rasterizer.cpu import CpuRasterizer
from cadam3d.rasterizer.cuda import CudaRasterizer
from cadam3d.rasterizer.reference import ReferenceRasterizer

NATIVE = ["cpu", "emulator", pytest.param("gpu", marks=pytest.mark.gpu)]
REFERENCES = {
    "reference-float64": Backend(
        "reference-float64", ReferenceRasterizer().render, dtype=torch.float64, order_of_sums=1e-12
    ),
    "reference-float32": Backend("reference-float32", ReferenceRasterizer().render, order_of_sums=1e-5),
}


@pytest.fixture(scope="session")
def kernel_build(tmp_path_factory):
    if find_compiler() is None:
        pytest.skip("no C++ compiler")
    return build(tmp_path_factory.mktemp("kernels"))


@pytest.fixture(scope="session")
def emulator(tmp_path_factory) -> Emulator:
    """The CUDA kernels, on fibers."""
    return compile_emulator(tmp_path_factory.mktemp("emulator"))


@pytest.fixture(scope="session")
def cpu(kernel_build) -> CpuRasterizer:
    """The CPU kernels."""
    return CpuRasterizer(cache_dir=str(kernel_build.path.parent))


@pytest.fixture(scope="session", params=NATIVE)
def backend(request) -> Backend:
    """Each rasterizer with kernels of its own."""
    return find_backend(request)


@pytest.fixture(scope="session", params=[*NATIVE, *REFERENCES])
def any_backend(request) -> Backend:
    """The same and the reference, for laws that hold whatever the truth is."""
    return REFERENCES.get(request.param) or find_backend(request)


def find_backend(request) -> Backend:
    if request.param == "cpu":
        return Backend("cpu", request.getfixturevalue("cpu").render)
    if request.param == "emulator":
        return Backend("emulator", request.getfixturevalue("emulator").render, rounding=5e-5)
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    cache = request.getfixturevalue("tmp_path_factory").mktemp("cubin")
    return Backend("gpu", CudaRasterizer(cache_dir=str(cache)).render, device="cuda", rounding=5e-5)


@pytest.fixture
def garbage_in_new_memory():
    """Every ``torch.empty`` holds NaN or the largest number: to read what nobody wrote shows."""
    torch.use_deterministic_algorithms(True)
    yield
    torch.use_deterministic_algorithms(False)
