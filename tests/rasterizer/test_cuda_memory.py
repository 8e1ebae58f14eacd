"""Views that need too much memory together are split into groups, which does not change the bits."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

import pytest
import torch
from emulation import Emulator
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
from cadam3d.rasterizer.launcher import Launch, Launcher

pytestmark = pytest.mark.usefixtures("garbage_in_new_memory")

CPU = torch.device("cpu")
VIEWS = 4


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


def slots_per_view(emulator, gaussians, cameras) -> list[int]:
    views = cuda._CudaPass(emulator, cameras, CPU)
    views.project(list(gaussians.tensors().values()))
    return views.slot_count.sum(dim=1).tolist()


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_the_bits_do_not_depend_on_the_memory_for_records(emulator, degree, monkeypatch):
    scene = make_scene(degree)
    whole = differentiate(emulator, scene)
    visible = whole[0].visible
    assert (visible.any(dim=0) & ~visible[-1]).any(), "some Gaussian is visible, but not in the last view"
    assert (~visible.any(dim=0)).any(), "some Gaussian is not visible at all"
    slots = slots_per_view(emulator, *scene[:2])
    for most_slots, groups in ((sum(slots), 1), (sum(slots[:3]), 2), (max(slots), VIEWS), (0, VIEWS)):
        monkeypatch.setattr(cuda, "RECORD_MEMORY", 4 * cuda.RECORD * most_slots)
        spy = Spy(emulator)
        assert_same_bits(bits(*whole), bits(*differentiate(spy, scene)))
        launches = spy.arguments_of("blend_backward")
        assert len(launches) == len(spy.arguments_of(f"project_backward_{(degree + 1) ** 2}")) == groups
        # A single view always gets the memory that it needs.
        most = max(4 * cuda.RECORD * most_slots, 4 * cuda.RECORD * max(slots))
        assert all(4 * arguments[-1].numel() <= most for arguments in launches)


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
    whole, slots = differentiate(emulator, scene), slots_per_view(emulator, gaussians, cameras)
    # One view just fits, two views do not.
    monkeypatch.setattr(cuda, "MOST", max(n, *slots, size[0] * size[1]))
    assert 2 * max(n, min(slots)) > cuda.MOST
    spy = Spy(emulator)
    assert_same_bits(bits(*whole), bits(*differentiate(spy, scene)))
    assert len(spy.arguments_of("blend_forward")) == VIEWS


def test_a_group_has_as_many_views_as_fit_and_at_least_one():
    split = cuda._split_views
    spans = [(views.start, views.stop, slots) for views, slots in split([3, 4, 5, 9, 0, 1], 8, 99)]
    assert spans == [(0, 2, 7), (2, 3, 5), (3, 4, 9), (4, 6, 1)]
    assert [views for views, _ in split([1] * 5, 99, 2)] == [slice(0, 2), slice(2, 4), slice(4, 5)]
    assert [views for views, _ in split([1, 1], 99, 0)] == [slice(0, 1), slice(1, 2)]
    assert split([], 8, 8) == []


@pytest.mark.parametrize(("views", "pairs"), [(7, 2**29), (3, 2**31 - 1)])
def test_views_beyond_32_bits_together_are_split(emulator, views, pairs, monkeypatch):
    monkeypatch.setattr(cuda, "RECORD_MEMORY", 2**60)
    kernels = cuda._CudaPass(emulator, make_cameras(views, 8, 8), CPU)
    kernels.slot_count = torch.tensor([[pairs - 1, 1, 0]] * views, dtype=torch.int32)
    assert views * pairs > cuda.MOST
    groups = kernels._split()
    assert sum(slots for _, slots in groups) == views * pairs
    assert all(slots <= cuda.MOST for _, slots in groups)
    assert len(groups) == -(-views // (cuda.MOST // pairs))


def test_more_than_32_bits_of_pairs_in_one_view_are_refused_and_counted(emulator):
    def claim_too_much(kernel, arguments):
        if kernel.startswith("project_forward"):
            # Tiles of each splat. Their total is above 2**32.
            arguments[-1].fill_(2**31 - 1)

    gaussians, *scene = make_scene()
    spy = Spy(emulator, claim_too_much)
    with pytest.raises(UserError, match=rf"pairs in a view, got {120 * (2**31 - 1)}\."):
        rasterize(spy, gaussians, *scene[:2])
    assert not spy.arguments_of("tile_list")


def test_lists_are_kept_only_for_a_backward_pass(emulator):
    gaussians, cameras, background, _ = make_scene()
    views = cuda._CudaPass(emulator, cameras, CPU)
    parameters = list(gaussians.tensors().values())
    views.project(parameters)
    views.blend(parameters, background, keeps=False)
    assert views.groups == []
    views.project(parameters)
    views.blend(parameters, background, keeps=True)
    assert len(views.groups) == 1


def test_a_grid_may_have_more_blocks_than_its_other_dimensions_allow(emulator):
    slots = 2**16 + 5_000
    keys = torch.arange(slots, dtype=torch.int32) // 3
    ranges = torch.zeros(int(keys[-1]) + 1, 2, dtype=torch.int32)
    with emulator.on(CPU) as launch:
        launch("tile_ranges", slots, 1, keys, slots, ranges)
    begins = torch.arange(0, slots, 3, dtype=torch.int32)
    assert torch.equal(ranges[:, 0], begins)
    assert torch.equal(ranges[:, 1], (begins + 3).clamp_max(slots))
