"""The native kernels, compiled once for all tests: never from, or into, the cache of who runs them."""

import pytest

from cadam3d.rasterizer.build import build, find_compiler


@pytest.fixture(scope="session")
def kernel_build(tmp_path_factory):
    if find_compiler() is None:
        pytest.skip("no C++ compiler")
    return build(tmp_path_factory.mktemp("kernels"))
