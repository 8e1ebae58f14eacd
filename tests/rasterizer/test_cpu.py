"""The native CPU rasterizer: threads and instruction sets. Its other laws are in test_backends.py."""

import ctypes
import resource
import sys
import weakref
from functools import partial
from pathlib import Path

import pytest
import torch
from splats import (
    assert_agrees,
    assert_same_bits,
    backgrounds,
    bits,
    make_cameras,
    make_gaussians,
    make_weights,
    render_and_differentiate,
)

from cadam3d.rasterizer.cpu import rasterize


@pytest.fixture(autouse=True)
def _threads():
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def test_the_bits_do_not_depend_on_the_number_of_threads(cpu):
    # The lists of a large scene are made in pieces. Equal depths must stay in the order of the Gaussians.
    large = make_gaussians(40_000, log_scale=-5.0)
    large.means[1:20_000:3] = large.means[-1]
    small = make_gaussians(2000, degree=1, log_scale=-2.5)
    for gaussians, views, height, width in ((small, 2, 70, 90), (large, 1, 50, 60)):
        scene = make_cameras(views, height, width), backgrounds(views), make_weights(views, height, width)
        results = []
        for threads in (1, 2, 3, 7):
            torch.set_num_threads(threads)
            results.append(bits(*render_and_differentiate(cpu.render, gaussians, *scene)))
        for other in results[1:]:
            assert_same_bits(results[0], other)


def test_memory_that_is_used_again_changes_no_bits(cpu):
    def result(count, views, size):
        scene = make_gaussians(count), make_cameras(views, size, size), backgrounds(views)
        return bits(*render_and_differentiate(cpu.render, *scene, make_weights(views, size, size)))

    first = result(500, 2, 40)
    # Larger, smaller and empty scenes leave their numbers in the memory that the next pass gets.
    for count, views, size in ((9000, 3, 90), (3, 1, 8), (0, 1, 8)):
        result(count, views, size)
        assert_same_bits(first, result(500, 2, 40))
    held = cpu.render(make_gaussians(700), make_cameras(2, 40, 40), backgrounds(2))
    assert_same_bits(first, result(500, 2, 40))
    assert held.rgb.isfinite().all()


def test_a_pass_is_not_freed_while_the_program_ends(cpu, monkeypatch):
    # A thread that the program does not wait for may still be rendering it.
    finalize, made = weakref.finalize, []

    def record(*arguments):
        made.append(finalize(*arguments))
        return made[-1]

    monkeypatch.setattr(weakref, "finalize", record)
    output = cpu.render(make_gaussians(5), make_cameras(1, 8, 8), backgrounds(1))
    assert [(each.alive, each.atexit) for each in made] == [(True, False)]
    del output


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux limits the memory of a process")
def test_missing_memory_is_an_error_that_leaves_the_kernels_usable(cpu):
    large = make_gaussians(100_000, log_scale=-6.0), make_cameras(8, 30, 30), backgrounds(8)
    small = make_gaussians(300), make_cameras(1, 30, 30), backgrounds(1)
    weights = make_weights(1, 30, 30)
    first = bits(*render_and_differentiate(cpu.render, *small, weights))
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    before = resource.getrlimit(resource.RLIMIT_AS)
    # 45 MB are enough for the tensors of this pass, but not for the 51 MB of its splats.
    limit = pages * resource.getpagesize() + 45 * 10**6
    resource.setrlimit(resource.RLIMIT_AS, (limit, before[1]))
    try:
        with pytest.raises(
            MemoryError, match="not enough memory for 100,000 Gaussians in 8 views of 30 x 30"
        ):
            cpu.render(*large)
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)
    assert_same_bits(first, bits(*render_and_differentiate(cpu.render, *small, weights)))
    assert cpu.render(*large).rgb.isfinite().all()


def test_narrower_vectors_and_groups_of_one_view_agree(kernel_build, build_with_flags):
    # One compilation for two independent laws: a single view has no groups, and shows the vectors alone.
    native = ctypes.CDLL(str(kernel_build))
    native.cadam3d_instruction_set.restype = ctypes.c_char_p
    has_wider_vectors = native.cadam3d_instruction_set() == b"avx512"
    vectors = ("-march=x86-64-v3",) if has_wider_vectors else ()
    kernels = ctypes.CDLL(str(build_with_flags(*vectors, "-DSPLAT_RECORD_BUDGET=1")))
    kernels.cadam3d_instruction_set.restype = ctypes.c_char_p
    assert kernels.cadam3d_instruction_set() != b"avx512"
    for views in (1, 3):
        for absgrad in (False, True):
            scene = make_gaussians(150, degree=1), make_cameras(views, 40, 50)
            assert_agrees(partial(rasterize, kernels), *scene, absgrad=absgrad)
