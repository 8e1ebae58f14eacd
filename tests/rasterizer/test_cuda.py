"""The CUDA rasterizer: the same kernels on fibers on every machine, and on a GPU if there is one."""

import ctypes

import pytest
import torch
from emulation import Emulator, build_emulator, check_sort, list_tiles, passes
from mutants import NUMBERS, RENDERING, ROUNDING, SMALL_TILES, plant
from splats import (
    assert_agrees,
    assert_same_bits,
    at_tile_corners,
    backgrounds,
    bits,
    flat_discs,
    make_cameras,
    make_gaussians,
    make_weights,
    needles,
    render_and_differentiate,
    saturated,
)

from cadam3d.core.errors import UserError
from cadam3d.rasterizer import cuda
from cadam3d.rasterizer.base import KERNELS
from cadam3d.rasterizer.cuda import CudaRasterizer
from cadam3d.rasterizer.forecast import find_forecast

pytestmark = pytest.mark.usefixtures("garbage_in_new_memory")

CPU = torch.device("cpu")
# Gaussians, cameras, and the smallest share of pixels that are not on a step.
HARD_SCENES = (
    (saturated(40), make_cameras(1, 21, 27), 0.5),
    (needles(60), make_cameras(1, 31, 43), 0.9),
    (make_gaussians(4, seed=16, log_scale=1.5), make_cameras(1, 75, 70), 0.5),
)


# -------------------------------------------------------------------------- order and limits


def test_the_bits_do_not_depend_on_the_schedule_of_threads(emulator):
    scene = saturated(60), make_cameras(2, 37, 50), backgrounds(2), make_weights(2, 37, 50)
    results = [
        bits(*render_and_differentiate(emulator.shuffled(seed).render, *scene)) for seed in (0, 1, 2, 77)
    ]
    for other in results[1:]:
        assert_same_bits(results[0], other)


# -------------------------------------------------------------------------- the blend


@pytest.mark.usefixtures("small_tiles")
@pytest.mark.parametrize("absgrad", [False, True])
def test_tiles_of_8x4_agree_with_the_reference(emulator, absgrad):
    for gaussians, cameras, most in HARD_SCENES:
        assert_agrees(emulator.render, gaussians, cameras, most=most, absgrad=absgrad)


@pytest.mark.usefixtures("small_tiles")
def test_the_bits_of_tiles_of_8x4_do_not_depend_on_the_schedule_of_threads(emulator):
    scene = saturated(60), make_cameras(2, 37, 50), backgrounds(2), make_weights(2, 37, 50)
    results = [bits(*render_and_differentiate(emulator.shuffled(seed).render, *scene)) for seed in (0, 1)]
    assert_same_bits(*results)


@pytest.fixture(scope="module")
def rough(build_cache, tmp_path_factory):
    """Return the kernels with results of the fast exponential and reciprocal that are off by some bits."""
    kernels = plant({}, tmp_path_factory.mktemp("rough"))
    return Emulator(ctypes.CDLL(str(build_emulator(build_cache, kernels, "-O1", ("-DEMULATOR_ROUGH",)))))


# The documentation of PTX allows 2 units in the last place for the exponential, and 1 for the reciprocal.
@pytest.mark.parametrize("few", [0, 10**9])
def test_kernels_agree_with_the_reference_when_the_hardware_rounds_as_it_may(
    rough, emulator, few, monkeypatch
):
    monkeypatch.setattr(cuda, "FEW_TILES", few)
    for gaussians, cameras, most in HARD_SCENES:
        output, _ = assert_agrees(rough.render, gaussians, cameras, most=most)
        exact = emulator.render(gaussians, cameras, backgrounds(len(cameras)))
        assert not torch.equal(output.rgb, exact.rgb), "the results are off"


# The limits are below the number of pixels, and below the number of (splat, tile) pairs.
@pytest.mark.parametrize("most", [100, 500])
def test_more_items_than_indices_can_count_are_refused_before_memory_is_allocated(
    emulator, monkeypatch, most
):
    monkeypatch.setattr(cuda, "MOST", most)
    with pytest.raises(UserError, match=rf"expected at most {most} .*Try: camera\.size="):
        emulator.render(make_gaussians(200, log_scale=0.0), make_cameras(1, 20, 20), backgrounds(1))


@pytest.mark.gpu
def test_kernels_run_on_the_current_stream():
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    # Everything is on the device beforehand, because an upload would wait for the device before any launch.
    scene = make_cameras(1, 64, 64).to("cuda"), backgrounds(1).cuda()
    rasterizer, gaussians = CudaRasterizer(cache_dir=None), make_gaussians(1000).to("cuda")
    # The second call renders ahead.
    renders = (rasterizer.render, rasterizer.render_ahead, rasterizer.render_ahead)
    want = [render(gaussians, *scene).rgb for render in renders]
    torch.cuda.synchronize()
    with torch.cuda.stream(torch.cuda.Stream()):
        got = []
        for render in renders:
            late = gaussians.map(torch.zeros_like)
            torch.cuda.current_stream().synchronize()
            # Kernels on another stream would overtake this pause and read the zeros.
            torch.cuda._sleep(10**8)
            for name, tensor in late.tensors().items():
                tensor.copy_(getattr(gaussians, name))
            got.append(render(late, *scene).rgb)
    torch.cuda.synchronize()
    for a, b in zip(got, want, strict=True):
        assert torch.equal(a, b)


@pytest.mark.gpu
def test_rendering_ahead_does_not_wait_for_the_device():
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    scene = make_cameras(2, 64, 64).to("cuda"), backgrounds(2).cuda()
    rasterizer = CudaRasterizer(cache_dir=None)
    gaussians = make_gaussians(1000).to("cuda").map(lambda tensor: tensor.detach().requires_grad_())
    for _ in range(2):
        rasterizer.render_ahead(gaussians, *scene).rgb.sum().backward()
    torch.cuda.synchronize()
    pause = torch.cuda.Event()
    torch.cuda._sleep(10**9)
    pause.record()
    output = rasterizer.render_ahead(gaussians, *scene)
    output.rgb.sum().backward()
    assert not pause.query(), "the device still pauses, while the host has done its work"
    assert output.overflowed is not None
    assert not output.overflowed
    report = find_forecast(gaussians.device, 2, 64, 64).report
    torch.cuda.synchronize()
    assert int(report) >> 32 == 1000, "kernels write what they count to memory of the host"


# -------------------------------------------------------------------------- the parts


@pytest.mark.parametrize(
    ("gaussians", "cameras"),
    [
        pytest.param(needles(120), make_cameras(2, 61, 83), id="needles"),
        pytest.param(flat_discs(120), make_cameras(2, 61, 83), id="flat discs"),
        pytest.param(make_gaussians(120), make_cameras(2, 61, 83), id="random"),
        pytest.param(*at_tile_corners([-0.9, -1.9, -4.0]), id="ends at corners of tiles"),
    ],
)
@pytest.mark.parametrize("tile_height", [4, 8])
def test_every_tile_with_a_pixel_in_reach_is_listed_and_few_others(
    emulator, gaussians, cameras, tile_height, monkeypatch
):
    monkeypatch.setattr(cuda, "FEW_TILES", 0 if tile_height == 8 else 10**9)
    v, n, height, width = len(cameras), len(gaussians), cameras.height, cameras.width
    lists = list_tiles(emulator, gaussians, cameras)
    listed = torch.zeros(len(lists.ranges) - 1, v * n, dtype=torch.bool)
    for tile, (begin, end) in enumerate(lists.ranges[:-1].tolist()):
        pairs = lists.pair_of_slot[lists.slots[begin:end].long()].long()
        assert (lists.splats[pairs, 11].diff() >= 0).all(), "nearest first"
        listed[tile, pairs] = True
    assert listed.sum() == lists.slots.shape[0], "as many as were counted, and none of them twice"
    assert not lists.ranges[-1].any(), "no slot is left over"

    x, y, l11, l12, l22, _, cut, *_ = lists.splats.double()[..., None, None].unbind(dim=1)
    tile = tile_height, cuda.TILE_WIDTH
    tiles_y, tiles_x = -(-height // tile[0]), -(-width // tile[1])
    rows, columns = (torch.arange(tiles_y * tile[0])[None] + 0.5, torch.arange(tiles_x * tile[1])[None] + 0.5)
    dx, dy = columns.double() - x, rows.double().mT - y
    is_reached = (l11 * dx + l12 * dy).square() + (l22 * dy).square() <= cut * (1 - 1e-5)
    is_reached &= (rows.mT < height) & (columns < width)
    is_seen = lists.is_seen
    in_tile = is_reached.view(-1, tiles_y, tile[0], tiles_x, tile[1]).any(dim=4).any(dim=2).flatten(1)
    wanted = (in_tile & is_seen[:, None]).view(v, n, -1)
    want = torch.zeros_like(listed).view(v, -1, v, n)
    for view in range(v):
        want[view, :, view] = wanted[view].T
    want = want.view_as(listed)
    assert not (want & ~listed).any()
    assert listed.sum() < 1.25 * want.sum()


def test_constants_mirror_those_of_the_kernels():
    source = "".join((KERNELS / f"{name}.cuh").read_text() for name in ("device", "project", "blend"))
    for line in (
        f"PROJECT_BLOCK = {cuda.PROJECT_BLOCK};",
        f"BLEND_BLOCK = {cuda.BLEND_BLOCK};",
        f"WARP = {cuda.WARP};",
        f"TILE_WIDTH = {cuda.TILE_WIDTH};",
        f"RECORD = {cuda.RECORD};",
        f"ABSOLUTES = {cuda.ABSOLUTES};",
        f"sizeof(Camera) == {cuda.CAMERA} * sizeof(float)",
    ):
        assert line in source


# -------------------------------------------------------------------------- mutants


def judge(emulator: Emulator) -> None:
    """Check the results of kernels; every mutant must fail."""
    for seed in (1, 2):
        check_sort(emulator.shuffled(seed), 5000, 7, 9)
    scene = saturated(40), make_cameras(1, 21, 27)
    assert_agrees(emulator.render, *scene, most=0.5)
    assert_agrees(
        emulator.render, make_gaussians(4, seed=16, log_scale=1.5), make_cameras(1, 75, 70), most=0.5
    )


def test_kernels_without_a_mistake_pass(emulator, mutants):
    assert passes(emulator, judge)
    assert passes(mutants, judge)


@pytest.mark.parametrize("mutant", RENDERING)
def test_a_mutant_is_caught(mutants, mutant):
    assert not passes(mutants, judge, NUMBERS[mutant])


@pytest.mark.usefixtures("small_tiles")
def test_kernels_without_a_mistake_pass_with_small_tiles(mutants):
    assert passes(mutants, judge)


@pytest.mark.usefixtures("small_tiles")
@pytest.mark.parametrize("mutant", SMALL_TILES)
def test_a_mutant_is_caught_with_small_tiles(mutants, mutant):
    assert not passes(mutants, judge, NUMBERS[mutant])


def judge_slots(emulator: Emulator) -> None:
    """Check that each pair fills exactly its own slots and that every rendered number is finite."""
    gaussians, cameras = make_gaussians(60, log_scale=-1.0), make_cameras(2, 21, 27)
    lists = list_tiles(emulator, gaussians, cameras)
    counts = lists.counts.long()
    pairs = torch.arange(counts.numel()).repeat_interleave(counts)
    nth = torch.arange(pairs.numel()) - (counts.cumsum(0) - counts)[pairs]
    assert torch.equal(lists.pair_of_slot[lists.first_slot.long()[pairs] + nth].long(), pairs)
    assert lists.ranges[-1].any(), "some slots are left over"
    scene = gaussians, cameras, backgrounds(2), make_weights(2, 21, 27)
    assert all(number.isfinite().all() for number in bits(*render_and_differentiate(emulator.render, *scene)))


@pytest.mark.parametrize("mutant", ROUNDING)
def test_lists_that_disagree_with_their_counts_leave_no_garbage(mutants, mutant):
    assert passes(mutants, judge_slots, NUMBERS[mutant])
