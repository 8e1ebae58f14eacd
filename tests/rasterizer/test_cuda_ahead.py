"""Rendering ahead: memory is reserved before its size is known, with the same bits and without a wait."""

import weakref
from functools import partial

import pytest
import torch
from emulation import Emulator, count_slots, guard_zones, passes
from mutants import COUNTED, NUMBERS
from splats import (
    assert_same_bits,
    backgrounds,
    bits,
    make_cameras,
    make_gaussians,
    make_weights,
    render_and_differentiate,
)

from cadam3d.rasterizer import cuda, forecast
from cadam3d.rasterizer.cuda import rasterize, rasterize_ahead
from cadam3d.rasterizer.forecast import DECAY, LEAST, MARGIN, Forecast
from cadam3d.rasterizer.workspace import Workspace

pytestmark = pytest.mark.usefixtures("garbage_in_new_memory")

CPU = torch.device("cpu")


def make_scene(n=70, views=2, degree=1, log_scale=-1.5):
    gaussians = make_gaussians(n, degree=degree, log_scale=log_scale)
    return gaussians, make_cameras(views, 29, 38), backgrounds(views), make_weights(views, 29, 38)


def overflow(emulator, scene, capacity) -> bool:
    with torch.no_grad():
        return bool(rasterize(emulator, *scene[:3], capacity=capacity).overflowed)


@pytest.fixture(autouse=True)
def forget():
    """Forget what earlier tests have rendered."""
    forecast.find_forecast.cache_clear()


# -------------------------------------------------------------------------- one law for both ways


@pytest.mark.parametrize("absgrad", [False, True])
@pytest.mark.parametrize("views", [1, 3])
def test_both_ways_give_the_same_bits_if_there_is_room(emulator, views, absgrad):
    scene = make_scene(views=views)
    want = bits(*render_and_differentiate(emulator.render, *scene, absgrad=absgrad))
    slots = sum(count_slots(emulator, *scene[:2]))
    # The last capacity is so large that the sort counts the slots in a kernel of its own.
    for capacity in (slots, slots + 1, 4097, 70_000):
        assert not overflow(emulator, scene, capacity)
        render = partial(rasterize, emulator, capacity=capacity)
        assert_same_bits(want, bits(*render_and_differentiate(render, *scene, absgrad=absgrad)))


@pytest.mark.parametrize("absgrad", [False, True])
def test_without_enough_room_images_show_the_background_and_gradients_are_zero(emulator, absgrad):
    scene = make_scene()
    slots = sum(count_slots(emulator, *scene[:2]))
    for capacity in (0, 1, slots // 2, slots - 1):
        assert overflow(emulator, scene, capacity)
        render = partial(rasterize, emulator, capacity=capacity)
        output, grads = render_and_differentiate(render, *scene, absgrad=absgrad)
        assert torch.equal(output.rgb, scene[2][:, None, None].expand_as(output.rgb))
        assert not output.alpha.any()
        assert not output.depth.any()
        assert output.visible.any(), "what the projection finds does not depend on memory"
        assert not any(grad.any() for grad in grads.values())


def test_a_total_beyond_32_bits_does_not_look_small(emulator):
    """Claim so many tiles that their sum wraps around to a number that would fit."""
    gaussians, cameras, background, _ = make_scene(n=3, views=1, degree=0)
    kernels = cuda._CudaPass(emulator, cameras, CPU, capacity=100)
    parameters = list(gaussians.tensors().values())
    with torch.no_grad(), kernels:
        kernels.project(parameters)
        kernels.frame.tensor(kernels.kept, "counts", torch.int32)[:] = torch.tensor([-1, 2, 3])
        rgb, *_ = kernels.blend(parameters, background, keeps=False)
        assert kernels.overflowed is not None
        assert kernels.overflowed
    assert torch.equal(rgb, background[:, None, None].expand_as(rgb))


def test_no_gaussians_and_no_views_are_rendered_too(emulator):
    for gaussians, views in ((make_gaussians(0), 2), (make_gaussians(5), 0)):
        cameras, background = make_cameras(2, 9, 17), backgrounds(2)[:views]
        cameras = cameras.index(slice(0, views))
        for _ in range(2):
            output = rasterize_ahead(emulator, gaussians, cameras, background)
            assert torch.equal(output.rgb, background[:, None, None].expand(views, 9, 17, 3))
    output = rasterize(emulator, make_gaussians(0), make_cameras(2, 9, 17), backgrounds(2), capacity=0)
    assert not output.overflowed
    assert torch.equal(output.rgb, backgrounds(2)[:, None, None].expand_as(output.rgb))


# -------------------------------------------------------------------------- what is forecast


def test_the_second_render_goes_ahead_with_what_the_first_has_learned(emulator):
    scene = make_scene()
    want, render = (
        bits(*render_and_differentiate(emulator.render, *scene)),
        partial(rasterize_ahead, emulator),
    )
    assert render(*scene[:3]).overflowed is None, "nothing is known yet, so the host waits"
    overflowed = render(*scene[:3]).overflowed
    assert overflowed is not None
    assert not overflowed
    assert_same_bits(want, bits(*render_and_differentiate(render, *scene)))


def test_what_overflowed_is_known_at_the_next_render(emulator):
    small, large = make_scene(log_scale=-5.0), make_scene(n=70, log_scale=1.0)
    render = partial(rasterize_ahead, emulator)
    render(*small[:3])
    assert render(*small[:3]).overflowed is not None
    slots = sum(count_slots(emulator, *large[:2]))
    found = forecast.find_forecast(CPU, 2, 29, 38)
    found._density = (slots // 2) / MARGIN / 70
    forecast_least, forecast.LEAST = forecast.LEAST, 0
    try:
        assert render(*large[:3]).overflowed
        assert not render(*large[:3]).overflowed
    finally:
        forecast.LEAST = forecast_least


def test_views_that_may_need_several_groups_are_counted_first(emulator, monkeypatch):
    scene = make_scene()
    render = partial(rasterize_ahead, emulator)
    render(*scene[:3])
    monkeypatch.setattr(cuda, "RECORD_MEMORY", 4 * cuda.RECORD * LEAST)
    assert render(*scene[:3]).overflowed is None
    want = bits(*render_and_differentiate(emulator.render, *scene))
    assert_same_bits(want, bits(*render_and_differentiate(render, *scene)))


def test_many_slots_of_a_single_view_are_counted_first(emulator, monkeypatch):
    """A forecast reserves too much for long after one large render, so it may not reserve without a limit."""
    scene = make_scene(views=1)
    render = partial(rasterize_ahead, emulator)
    render(*scene[:3])
    assert render(*scene[:3]).overflowed is not None
    monkeypatch.setattr(cuda, "RECORD_MEMORY", 4 * cuda.RECORD * LEAST)
    assert render(*scene[:3]).overflowed is None


def test_large_scenes_go_ahead_if_half_of_the_free_memory_holds_their_records(monkeypatch):
    """Pretend to have a GPU. Three million Gaussians at 1024 pixels and four views have such numbers."""
    device, slots, used = torch.device("cuda"), 40_000_000, []
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (used.append(device) or 3 * 2**30, 0))
    monkeypatch.setattr(torch.cuda, "memory_reserved", lambda device: 3 * 2**29)
    monkeypatch.setattr(torch.cuda, "memory_allocated", lambda device: 2**29)
    assert cuda.most_slots(slots, False, device) == 2**31 // (4 * cuda.RECORD) > slots
    assert cuda.most_slots(slots, True, device) == 2**31 // (4 * (cuda.RECORD + cuda.ABSOLUTES))
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (0, 0))
    monkeypatch.setattr(torch.cuda, "memory_reserved", lambda device: 2**29)
    assert cuda.most_slots(slots, False, device) == cuda.RECORD_MEMORY // (4 * cuda.RECORD) < slots
    assert len(used) == 2
    monkeypatch.setattr(torch.cuda, "mem_get_info", None)
    assert cuda.most_slots(1000, False, device) >= 1000, "small scenes do not ask"


def test_a_forecast_leaves_a_margin_and_grows_with_the_gaussians():
    new = Forecast(CPU)
    assert new.capacity(1000) is None
    new.learn(50_000, 1000)
    capacity = new.capacity(1000)
    assert MARGIN * 50_000 <= capacity <= 1.13 * (MARGIN * 50_000 + LEAST)
    assert new.capacity(2000) >= 2 * MARGIN * 50_000
    assert new.capacity(10) == capacity, "those that are left may be the large ones"


def test_a_forecast_remembers_the_largest_of_the_recent_renders():
    one = Forecast(CPU)
    one.learn(80_000, 1000)
    largest = one.capacity(1000)
    for _ in range(20):
        one.learn(20_000, 1000)
    assert one.capacity(1000) >= DECAY**21 * largest / 1.13
    for _ in range(5000):
        one.learn(20_000, 1000)
    assert one.capacity(1000) < 0.4 * largest


def test_a_report_counts_once():
    """Renders that do not go ahead make no report, so the last one must not keep them from it for ever."""
    one = Forecast(CPU)
    one.report.fill_(1000 << 32 | 80_000)
    largest = one.capacity(1000)
    for _ in range(5000):
        one.learn(20_000, 1000)
        one.capacity(1000)
    assert one.capacity(1000) < 0.4 * largest


def test_a_report_of_the_device_is_read_without_a_wait():
    one = Forecast(CPU)
    one.report.fill_(3 << 32 | 2**32 - 1)
    assert one.capacity(3) >= 2**32 - 1, "also if the count has saturated"


def test_nothing_waits_for_the_device_when_rendering_ahead(emulator, monkeypatch):
    scene = make_scene()
    render = partial(rasterize_ahead, emulator)
    render(*scene[:3])
    leaves = scene[0].map(lambda tensor: tensor.detach().requires_grad_())

    def wait(*_):
        raise AssertionError("the host waits")

    for name in ("tolist", "item", "cpu", "__bool__", "__int__", "__float__"):
        monkeypatch.setattr(torch.Tensor, name, wait)
    monkeypatch.setattr(cuda, "_start_reading", wait)
    output = render(leaves, *scene[1:3])
    torch.autograd.backward([output.rgb, output.depth], [output.rgb.detach(), output.depth.detach()])
    assert leaves.means.grad is not None
    assert output.overflowed is not None


def test_depths_are_sorted_before_the_host_waits(emulator, monkeypatch):
    scene, events = make_scene(views=1), []
    start = cuda._start_reading

    def start_reading(numbers):
        events.append("copy")
        read = start(numbers)
        return lambda: events.append("wait") or read()

    monkeypatch.setattr(cuda, "_start_reading", start_reading)
    views = cuda._CudaPass(emulator, scene[1], CPU)
    with views, torch.no_grad():
        launch = views.launch
        views.launch = lambda kernel, *arguments: events.append(kernel) or launch(kernel, *arguments)
        parameters = list(scene[0].tensors().values())
        views.project(parameters)
        views.blend(parameters, scene[2], keeps=False)
    assert events.index("project_forward_4") < events.index("copy") < events.index("sort_scatter")
    assert events.index("sort_scatter") < events.index("wait") < events.index("tile_list")


# -------------------------------------------------------------------------- the default device


# -------------------------------------------------------------------------- memory


@pytest.fixture
def blocks(monkeypatch) -> list:
    """Collect weak references to all blocks of memory that workspaces allocate."""
    found, allocate = [], Workspace.allocate

    def spy(self, device):
        new = allocate(self, device)
        found.extend(weakref.ref(block) for block in new)
        return new

    monkeypatch.setattr(Workspace, "allocate", spy)
    return found


@pytest.mark.parametrize("render", [rasterize, rasterize_ahead])
def test_memory_lives_only_as_long_as_a_backward_pass_may_follow(emulator, blocks, render):
    scene = make_scene()
    render(emulator, *scene[:3])
    blocks.clear()
    with torch.no_grad():
        shown = render(emulator, *scene[:3])
    assert blocks
    assert not any(block() is not None for block in blocks), "no gradient can follow"
    assert shown.rgb.shape[0] == 2
    leaves = scene[0].map(lambda tensor: tensor.detach().requires_grad_())
    output = render(emulator, leaves, *scene[1:3])
    assert any(block() is not None for block in blocks)
    output.rgb.sum().backward()
    assert not any(block() is not None for block in blocks), "the output lives, its memory does not"
    assert output.means2d.grad is not None


def test_a_second_backward_pass_finds_its_memory(emulator):
    scene = make_scene()
    leaves = scene[0].map(lambda tensor: tensor.detach().requires_grad_())
    loss = emulator.render(leaves, *scene[1:3]).rgb.square().sum()
    loss.backward(retain_graph=True)
    once = [tensor.grad.clone() for tensor in leaves.tensors().values()]
    loss.backward()
    assert_same_bits([2 * grad for grad in once], [tensor.grad for tensor in leaves.tensors().values()])
    with pytest.raises(RuntimeError, match="backward through the graph a second time"):
        loss.backward()


def test_memory_may_be_somewhere_else_in_the_backward_pass(emulator):
    """Autograd can move saved tensors, for example to the host and back."""
    scene = make_scene()
    want = bits(*render_and_differentiate(emulator.render, *scene))
    with torch.autograd.graph.saved_tensors_hooks(torch.clone, torch.clone):
        got = bits(*render_and_differentiate(emulator.render, *scene))
    assert_same_bits(want, got)


# Arrays that are in use at the same time.
OVERLAPS = [
    ("order", "offsets"),
    ("tile_keys", "offsets"),
    ("temporary 0", "depth_keys"),
    ("temporary 1", "order"),
    ("slots", "pair_of_slot"),
    ("splats", "transmittance"),
    ("transmittance", "last"),
    ("totals", "cameras"),
]


def judge_memory(emulator: Emulator) -> None:
    """Check both ways to render against the layout with one allocation for each array."""
    # Several blocks sort the pairs. A single one reads all of them before it writes.
    scene = make_scene(n=600, log_scale=-4.0)
    slots = sum(count_slots(emulator, *scene[:2]))
    patch = pytest.MonkeyPatch()
    patch.setattr(cuda.workspace, "APART", True)
    want = bits(*render_and_differentiate(emulator.render, *scene))
    patch.undo()
    render = partial(rasterize, emulator, capacity=slots)
    assert_same_bits(want, bits(*render_and_differentiate(render, *scene)))


@pytest.mark.parametrize("pair", OVERLAPS)
def test_two_arrays_in_the_same_place_are_noticed(emulator, pair, monkeypatch):
    one, other = pair
    addresses = Workspace.addresses

    def wrong(self, blocks):
        found = addresses(self, blocks)
        if len(blocks) == 1 and one in found and other in found:
            found[one] = found[other]
        return found

    monkeypatch.setattr(Workspace, "addresses", wrong)
    assert not passes(emulator, judge_memory)


# -------------------------------------------------------------------------- mutants


def judge(emulator: Emulator) -> None:
    """Check the limits of memory; every mutant must fail."""
    scene = make_scene(n=40, degree=0)
    slots = sum(count_slots(emulator, *scene[:2]))
    want = bits(*render_and_differentiate(emulator.render, *scene, absgrad=True))
    with guard_zones() as intact:
        assert not overflow(emulator, scene, slots)
        render = partial(rasterize, emulator, capacity=slots)
        assert_same_bits(want, bits(*render_and_differentiate(render, *scene, absgrad=True)))
        assert overflow(emulator, scene, slots - 1)
        render = partial(rasterize, emulator, capacity=slots - 1)
        output, grads = render_and_differentiate(render, *scene, absgrad=True)
        assert not output.alpha.any()
        assert not any(grad.any() for grad in grads.values())
        assert intact()
    one = Forecast(CPU)
    rasterize(emulator, *scene[:3], capacity=slots, forecast=one)
    assert int(one.report) == 40 << 32 | slots
    test_a_total_beyond_32_bits_does_not_look_small(emulator)


def test_kernels_without_a_mistake_pass(emulator, mutants):
    assert passes(emulator, judge)
    assert passes(mutants, judge)
    assert passes(emulator, judge_memory)


@pytest.mark.parametrize("mutant", COUNTED)
def test_a_mutant_is_caught(mutants, mutant):
    assert not passes(mutants, judge, NUMBERS[mutant])
