"""The rasterizers under test. Test processes share compiled files, apart from the cache of the user."""

from pathlib import Path

import pytest
import torch
from emulation import Emulator, content_hash, load_emulator
from filelock import FileLock
from mutants import MUTANTS, plant
from splats import Backend

from cadam3d.compiled import library as build_module
from cadam3d.compiled.library import build, find_compiler
from cadam3d.rasterizer import cuda
from cadam3d.rasterizer.cpu import CpuRasterizer, cpu_library
from cadam3d.rasterizer.cuda import CudaRasterizer
from cadam3d.rasterizer.reference import ReferenceRasterizer

# More tiles than any image of the tests has.
MANY = 10**9
NATIVE = ["cpu", "emulator", pytest.param("gpu", marks=pytest.mark.gpu)]
REFERENCES = {
    "reference-float64": Backend(
        "reference-float64", ReferenceRasterizer().render, dtype=torch.float64, order_of_sums=1e-12
    ),
    "reference-float32": Backend("reference-float32", ReferenceRasterizer().render, order_of_sums=1e-5),
}


@pytest.fixture(scope="session")
def build_cache(request, tmp_path_factory) -> Path:
    """Return the folder of compiled files, which later test runs use again.

    The name of a file contains a hash of everything that it was made from.
    """
    cache = getattr(request.config, "cache", None)
    return cache.mkdir("rasterizer") if cache else tmp_path_factory.mktemp("rasterizer")


def build_once(folder: Path, *machine_flags: tuple[str, ...]) -> Path:
    """Return the CPU kernels in ``folder``, and compile them if they are missing, one process at a time."""
    with FileLock(folder.with_suffix(".lock")):
        built = sorted(folder.glob(f"*{build_module.SUFFIX}"))
        if machine_flags and built:
            return built[0]
        return build(cpu_library(), folder, machine_flags or build_module.MACHINE_FLAGS)


@pytest.fixture(scope="session")
def kernel_build(build_cache) -> Path:
    """Return the CPU kernels as users get them."""
    if find_compiler() is None:
        pytest.skip("no C++ compiler")
    source = Path(build_module.__file__).read_text()
    return build_once(build_cache / f"cpu-{content_hash(source)}")


@pytest.fixture(scope="session")
def build_with_flags(build_cache, kernel_build):
    """Return a function that compiles the CPU kernels with other flags for the machine."""
    source = Path(build_module.__file__).read_text()

    def build_other(*flags: str) -> Path:
        key = content_hash(source, kernel_build.name, *flags)
        return build_once(build_cache / f"cpu-{key}", flags)

    return build_other


@pytest.fixture(autouse=True)
def large_tiles(monkeypatch):
    """Use tiles of 8x8, in which a lane has two pixels, although the images of the tests are small."""
    monkeypatch.setattr(cuda, "FEW_TILES", 0)


@pytest.fixture
def small_tiles(monkeypatch, large_tiles):
    """Use tiles of 8x4 after all."""
    monkeypatch.setattr(cuda, "FEW_TILES", MANY)


@pytest.fixture(scope="session")
def emulator(build_cache) -> Emulator:
    """Return the CUDA kernels on fibers."""
    return load_emulator(build_cache)


@pytest.fixture(scope="session")
def mutants(build_cache, tmp_path_factory) -> Emulator:
    """Return the CUDA kernels on fibers, with all mistakes of mutants.py planted and switched off."""
    return load_emulator(build_cache, plant(MUTANTS, tmp_path_factory.mktemp("mutants")), "-O0")


@pytest.fixture(scope="session")
def cpu(kernel_build) -> CpuRasterizer:
    """Return the CPU rasterizer."""
    return CpuRasterizer(cache_dir=str(kernel_build.parent))


@pytest.fixture(scope="session", params=NATIVE)
def backend(request) -> Backend:
    """Return each rasterizer that has native kernels."""
    return find_backend(request)


@pytest.fixture(scope="session", params=[*NATIVE, *REFERENCES])
def any_backend(request) -> Backend:
    """Return each of these and the reference, for laws that need no second implementation."""
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
    """Fill every new tensor with NaN or the largest integer, so that reading uninitialized memory shows.

    ``torch.use_deterministic_algorithms`` does the same, but first imports the inductor, for over a second.
    """
    torch.set_deterministic_debug_mode("error")
    yield
    torch.set_deterministic_debug_mode("default")
