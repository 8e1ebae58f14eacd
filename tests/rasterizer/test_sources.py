"""The descriptions of the native rasterizers: every constant of the model reaches the kernels."""

import ctypes
import re

import pytest

from cadam3d.compiled.library import find_cached, find_compiler
from cadam3d.rasterizer import base
from cadam3d.rasterizer.base import CONSTANTS, KERNELS
from cadam3d.rasterizer.cpu import SOURCES, cpu_library


def test_the_kernels_run(kernel_build):
    assert ctypes.CDLL(str(kernel_build)).cadam3d_self_test() == 0
    assert find_cached(cpu_library(), kernel_build.parent, find_compiler()) == kernel_build


def test_the_kernels_use_every_constant_of_the_model():
    declared = {name for name, value in vars(base).items() if isinstance(value, float)}
    text = "".join(path.read_text(encoding="utf-8") for path in SOURCES)
    assert set(CONSTANTS) == declared
    assert not [name for name in declared if not re.search(rf"(?:Real|float|spread)\(SPLAT_{name}\)", text)]


@pytest.mark.parametrize("name", CONSTANTS)
def test_another_constant_leads_to_another_build(name, monkeypatch):
    before = cpu_library()
    monkeypatch.setattr(base, name, getattr(base, name) / 2)
    assert cpu_library().definitions != before.definitions


def test_the_shared_maths_needs_no_header():
    source = (KERNELS / "splat_math.h").read_text()
    assert "#include" not in source, "a run-time CUDA compiler has no headers"
