"""The native kernels, compiled once for all tests: never from, or into, the cache of who runs them."""

import pytest
import torch
from emulation import Emulator, compile_emulator

from cadam3d.rasterizer.build import build, find_compiler


@pytest.fixture(scope="session")
def kernel_build(tmp_path_factory):
    if find_compiler() is None:
        pytest.skip("no C++ compiler")
    return build(tmp_path_factory.mktemp("kernels"))


@pytest.fixture(scope="session")
def emulator(tmp_path_factory) -> Emulator:
    """The CUDA kernels, on fibers."""
    return compile_emulator(tmp_path_factory.mktemp("emulator"))


@pytest.fixture
def garbage_in_new_memory():
    """Every ``torch.empty`` holds NaN or the largest number: to read what nobody wrote shows."""
    torch.use_deterministic_algorithms(True)
    yield
    torch.use_deterministic_algorithms(False)
