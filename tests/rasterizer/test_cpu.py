"""The native CPU rasterizer: threads and instruction sets. Its other laws are in test_backends.py."""

from functools import partial

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

from cadam3d.compiled.build import load
from cadam3d.core.errors import UserError
from cadam3d.rasterizer.cpu import instruction_set, rasterize


@pytest.fixture(autouse=True)
def _threads():
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def test_the_bits_do_not_depend_on_the_number_of_threads(cpu):
    gaussians, cameras = make_gaussians(2000, degree=1, log_scale=-2.5), make_cameras(2, 70, 90)
    results = []
    for threads in (1, 2, 3, 7):
        torch.set_num_threads(threads)
        scene = gaussians, cameras, backgrounds(2), make_weights(2, 70, 90)
        results.append(bits(*render_and_differentiate(cpu.render, *scene)))
    for other in results[1:]:
        assert_same_bits(results[0], other)


def test_narrower_vectors_and_groups_of_one_view_agree(kernel_build, build_with_flags):
    # One compilation for two independent laws: a single view has no groups, and shows the vectors alone.
    has_wider_vectors = instruction_set(load(kernel_build)) == "avx512"
    vectors = ("-march=x86-64-v3",) if has_wider_vectors else ()
    kernels = load(build_with_flags(*vectors, "-DSPLAT_RECORD_BUDGET=1"))
    assert instruction_set(kernels) != "avx512"
    for views in (1, 3):
        for absgrad in (False, True):
            scene = make_gaussians(150, degree=1), make_cameras(views, 40, 50)
            assert_agrees(partial(rasterize, kernels), *scene, absgrad=absgrad)


def test_rendering_off_the_cpu_is_refused_with_a_hint(cpu):
    with pytest.raises(UserError, match="rasterizer=auto"):
        cpu.render(make_gaussians(3).to("meta"), make_cameras(1, 9, 9), backgrounds(1))
