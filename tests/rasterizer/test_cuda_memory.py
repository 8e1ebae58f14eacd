"""Views that need too much memory together are split into groups, which does not change the bits."""

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

import pytest
import torch
from emulation import Emulator, count_slots
from splats import (
    assert_same_bits,
    backgrounds,
    bits,
    make_cameras,
    make_gaussians,
    make_weights,
    render_and_differentiate,
)

from cadam3d.core.errors import UserError
from cadam3d.rasterizer import cuda
from cadam3d.rasterizer.cuda import rasterize
from cadam3d.rasterizer.driver import Launch, Launcher

pytestmark = pytest.mark.usefixtures("garbage_in_new_memory")

CPU = torch.device("cpu")
VIEWS = 4
# The place of the capacity among the arguments of project_backward: after parameters and sizes.
CAPACITY = 13


class Spy(Launcher):
    """Passes every launch on and records it; ``meddle`` may then change the results of the kernel."""

    def __init__(self, inner: Emulator, meddle=lambda kernel, arguments: None) -> None:
        self.inner, self.meddle = inner, meddle
        self.launches: list[tuple] = []  # kernel, blocks, threads, arguments

    @contextmanager
    def on(self, device: torch.device) -> Iterator[Launch]:
        """See :meth:`Launcher.on`."""
        with self.inner.on(device) as launch:

            def spy(kernel, blocks, threads, *arguments):
                self.launches.append((kernel, blocks, threads, arguments))
                launch(kernel, blocks, threads, *arguments)
                self.meddle(kernel, arguments)

            yield spy

    def arguments_of(self, kernel: str) -> list[tuple]:
        return [arguments for name, *_, arguments in self.launches if name == kernel]


def make_scene(degree=1):
    # The Gaussians are all around the cameras, so each is visible in other views.
    gaussians = make_gaussians(120, degree=degree, spread=3.0, log_scale=-1.5)
    return gaussians, make_cameras(VIEWS, 29, 38), backgrounds(VIEWS), make_weights(VIEWS, 29, 38)


def differentiate(launcher: Launcher, scene):
    return render_and_differentiate(partial(rasterize, launcher), *scene)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_the_bits_do_not_depend_on_the_memory_for_records(emulator, degree, monkeypatch):
    scene = make_scene(degree)
    whole = differentiate(emulator, scene)
    visible = whole[0].visible
    assert (visible.any(dim=0) & ~visible[-1]).any(), "some Gaussian is visible, but not in the last view"
    assert (~visible.any(dim=0)).any(), "some Gaussian is not visible at all"
    slots = count_slots(emulator, *scene[:2])
    for most_slots, groups in ((sum(slots), 1), (sum(slots[:3]), 2), (max(slots), VIEWS), (0, VIEWS)):
        monkeypatch.setattr(cuda, "RECORD_MEMORY", 4 * cuda.RECORD * most_slots)
        spy = Spy(emulator)
        assert_same_bits(bits(*whole), bits(*differentiate(spy, scene)))
        launches = spy.arguments_of("blend_backward_8x8")
        assert len(launches) == len(spy.arguments_of(f"project_backward_{(degree + 1) ** 2}")) == groups
        # A single view always gets the memory that it needs.
        most = max(4 * cuda.RECORD * most_slots, 4 * cuda.RECORD * max(slots))
        backwards = spy.arguments_of(f"project_backward_{(degree + 1) ** 2}")
        capacities = [arguments[CAPACITY] for arguments in backwards]
        assert all(4 * cuda.RECORD * capacity <= most for capacity in capacities)


@pytest.mark.parametrize(
    ("n", "log_scale", "size"),
    [
        pytest.param(150, -4.0, (9, 7), id="pairs"),
        pytest.param(90, 1.0, (29, 38), id="slots"),
    ],
)
def test_the_bits_do_not_depend_on_how_much_32_bits_can_count(emulator, n, log_scale, size, monkeypatch):
    gaussians, cameras = make_gaussians(n, degree=1, log_scale=log_scale), make_cameras(VIEWS, *size)
    scene = gaussians, cameras, backgrounds(VIEWS), make_weights(VIEWS, *size)
    whole, slots = differentiate(emulator, scene), count_slots(emulator, gaussians, cameras)
    # One view just fits, two views do not.
    monkeypatch.setattr(cuda, "MOST", max(n, *slots, size[0] * size[1]))
    assert 2 * max(n, min(slots)) > cuda.MOST
    spy = Spy(emulator)
    assert_same_bits(bits(*whole), bits(*differentiate(spy, scene)))
    assert len(spy.arguments_of("blend_forward_8x8")) == VIEWS


@pytest.mark.parametrize(("views", "pairs"), [(7, 2**29), (3, 2**31 - 1)])
def test_views_beyond_32_bits_together_are_split(emulator, views, pairs, monkeypatch):
    monkeypatch.setattr(cuda, "RECORD_MEMORY", 2**60)
    kernels = cuda._CudaPass(emulator, make_cameras(views, 8, 8), CPU)
    assert views * pairs > cuda.MOST
    groups = kernels._split([pairs] * views, 3)
    assert sum(slots for _, slots in groups) == views * pairs
    assert all(slots <= cuda.MOST for _, slots in groups)
    assert len(groups) == -(-views // (cuda.MOST // pairs))


def test_more_than_32_bits_of_pairs_in_one_view_are_refused_and_counted(emulator):
    def claim_too_much(kernel, arguments):
        if kernel.startswith("project_forward"):
            # Tiles of each splat. Their total is above 2**32.
            counts = (ctypes.c_uint32 * 120).from_address(arguments[-1])
            counts[:] = [2**31 - 1] * 120

    gaussians, cameras, background, _ = make_scene()
    cameras = cameras.index(slice(0, 1))
    spy = Spy(emulator, claim_too_much)
    with pytest.raises(UserError, match=rf"pairs in a view, got {120 * (2**31 - 1)}\."):
        rasterize(spy, gaussians, cameras, background[:1])
    assert not spy.arguments_of("tile_list")


def test_lists_are_kept_only_for_a_backward_pass(emulator):
    gaussians, cameras, background, _ = make_scene()
    views = cuda._CudaPass(emulator, cameras, CPU)
    parameters = list(gaussians.tensors().values())
    for keeps in (False, True):
        with views:
            views.project(parameters)
            views.blend(parameters, background, keeps)
        assert len(views.groups) == keeps


def test_a_grid_may_have_more_blocks_than_its_other_dimensions_allow(emulator):
    slots = 2**16 + 5_000
    keys = torch.arange(slots, dtype=torch.int32) // 3
    ranges = torch.zeros(int(keys[-1]) + 1, 2, dtype=torch.int32)
    with emulator.on(CPU) as launch:
        total = torch.tensor([slots], dtype=torch.int32)
        launch("tile_ranges", slots, 1, *(t.data_ptr() for t in (keys, total)), slots, ranges.data_ptr())
    begins = torch.arange(0, slots, 3, dtype=torch.int32)
    assert torch.equal(ranges[:, 0], begins)
    assert torch.equal(ranges[:, 1], (begins + 3).clamp_max(slots))
