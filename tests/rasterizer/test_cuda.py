"""The CUDA rasterizer: the same kernels on fibers on every machine, and on a GPU if there is one."""

import pytest
import torch
from emulation import Emulator, passes
from mutants import NUMBERS, RENDERING, ROUNDING
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
from cadam3d.rasterizer.cuda import CudaRasterizer
from cadam3d.rasterizer.sources import KERNELS

pytestmark = pytest.mark.usefixtures("garbage_in_new_memory")

CPU = torch.device("cpu")


# -------------------------------------------------------------------------- order and limits


def test_the_bits_do_not_depend_on_the_schedule_of_threads(emulator):
    scene = saturated(60), make_cameras(2, 37, 50), backgrounds(2), make_weights(2, 37, 50)
    results = [
        bits(*render_and_differentiate(emulator.shuffled(seed).render, *scene)) for seed in (0, 1, 2, 77)
    ]
    for other in results[1:]:
        assert_same_bits(results[0], other)


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
    rasterizer, scene = CudaRasterizer(cache_dir=None), (make_cameras(1, 64, 64), backgrounds(1).cuda())
    gaussians = make_gaussians(1000).to("cuda")
    want = rasterizer.render(gaussians, *scene).rgb
    torch.cuda.synchronize()
    with torch.cuda.stream(torch.cuda.Stream()):
        # Kernels on another stream would overtake this pause.
        torch.cuda._sleep(10**8)
        got = rasterizer.render(gaussians.map(lambda tensor: tensor + 0), *scene).rgb
    torch.cuda.synchronize()
    assert torch.equal(got, want)


def test_rendering_on_a_cpu_is_refused_with_a_hint():
    with pytest.raises(UserError, match="rasterizer=auto"):
        CudaRasterizer(cache_dir=None).render(make_gaussians(1), make_cameras(1, 9, 9), backgrounds(1))
    with pytest.raises(UserError, match="rasterizer=auto"):
        CudaRasterizer(cache_dir=None).prepare(CPU)


def test_a_missing_cuda_device_is_reported_before_anything_is_compiled(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(UserError, match="sees no CUDA device"):
        CudaRasterizer(cache_dir=None).prepare(torch.device("cuda"))


# -------------------------------------------------------------------------- the parts


def as_unsigned(tensor: torch.Tensor) -> torch.Tensor:
    return tensor.long() & 0xFFFFFFFF


@pytest.mark.parametrize("n", [1, 255, 2047, 2048, 2049, 16384, 16385, 20000])
def test_prefix_sums_are_exact_up_to_32_bits(emulator, n):
    values = torch.randint(0, 2**32 // n, (n,), generator=torch.Generator().manual_seed(n))
    with emulator.on(CPU) as launch:
        sums = cuda._scan(launch, torch.where(values < 2**31, values, values - 2**32).int())
    assert torch.equal(as_unsigned(sums), values.cumsum(0) - values)


def check_sort(emulator: Emulator, n: int, distinct: int, bit_count: int) -> None:
    values = torch.randint(0, 2**bit_count, (distinct,), generator=torch.Generator().manual_seed(n))
    picks = torch.randint(0, distinct, (n,), generator=torch.Generator().manual_seed(n + 1))
    keys = values[picks]
    with emulator.on(CPU) as launch:
        got, order = cuda._sort(launch, torch.where(keys < 2**31, keys, keys - 2**32).int(), bit_count)
    want, want_order = keys.sort(stable=True)
    assert torch.equal(as_unsigned(got), want)
    assert torch.equal(order.long(), want_order)


@pytest.mark.parametrize("n", [0, 1, 2, 31, 32, 33, 255, 256, 257, 4095, 4096, 4097, 5000, 12289])
def test_the_sort_is_exact_and_stable(emulator, n):
    for distinct, bit_count in ((1, 32), (7, 32), (10**6, 32), (10**6, 17), (2, 1)):
        check_sort(emulator, n, distinct, bit_count)


def test_the_sort_is_exact_when_its_counts_need_three_kernels(emulator):
    assert 270_000 // cuda.SORT_CHUNK * 2**cuda.RADIX_BITS > cuda.SCAN_SHORT
    check_sort(emulator, 270_000, 10**6, 16)


@pytest.mark.gpu
def test_the_sort_handles_more_than_2_to_27_keys(tmp_path):
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    n = 2**27 + 1
    keys = torch.randint(0, 2**31 - 1, (n,), dtype=torch.int32, device="cuda")
    with cuda.load_kernels(str(tmp_path)).on(keys.device) as launch:
        got, order = cuda._sort(launch, keys, 32)
    want, want_order = keys.sort(stable=True)
    assert torch.equal(got, want)
    assert torch.equal(order.long(), want_order)


@pytest.mark.parametrize(
    ("gaussians", "cameras"),
    [
        pytest.param(needles(120), make_cameras(2, 61, 83), id="needles"),
        pytest.param(flat_discs(120), make_cameras(2, 61, 83), id="flat discs"),
        pytest.param(make_gaussians(120), make_cameras(2, 61, 83), id="random"),
        pytest.param(*at_tile_corners([-0.9, -1.9, -4.0]), id="ends at corners of tiles"),
    ],
)
def test_every_tile_with_a_pixel_in_reach_is_listed_and_few_others(emulator, gaussians, cameras):
    v, n, height, width = len(cameras), len(gaussians), cameras.height, cameras.width
    views = cuda._CudaPass(emulator, cameras, CPU)
    views.project(list(gaussians.tensors().values()))
    with emulator.on(CPU) as launch:
        lists = views._list(launch, *views._split()[0])
    listed = torch.zeros(v * views.tiles, v * n, dtype=torch.bool)
    for tile, (begin, end) in enumerate(lists.ranges[:-1].tolist()):
        pairs = lists.pair_of_slot[lists.slots[begin:end].long()].long()
        depths = views.splats.view(-1, cuda.SPLAT)[pairs, 7]
        assert (depths.diff() >= 0).all()
        listed[tile, pairs] = True
    assert listed.sum() == lists.slots.shape[0], "as many as were counted, and none of them twice"
    assert not lists.ranges[-1].any(), "no slot is left over"

    x, y, l11, l12, l22, cut, *_ = views.splats.double().view(-1, cuda.SPLAT, 1, 1).unbind(dim=1)
    tiles_y, tiles_x = -(-height // cuda.TILE), -(-width // cuda.TILE)
    rows, columns = (torch.arange(tiles * cuda.TILE)[None] + 0.5 for tiles in (tiles_y, tiles_x))
    dx, dy = columns.double() - x, rows.double().mT - y
    is_reached = (l11 * dx + l12 * dy).square() + (l22 * dy).square() <= cut * (1 - 1e-5)
    is_reached &= (rows.mT < height) & (columns < width)
    is_seen = views.depth_keys.flatten() != -1
    in_tile = is_reached.view(-1, tiles_y, cuda.TILE, tiles_x, cuda.TILE).any(dim=4).any(dim=2).flatten(1)
    wanted = (in_tile & is_seen[:, None]).view(v, n, -1)
    want = torch.zeros_like(listed).view(v, views.tiles, v, n)
    for view in range(v):
        want[view, :, view] = wanted[view].T
    want = want.view_as(listed)
    assert not (want & ~listed).any()
    assert listed.sum() < 1.25 * want.sum()


def test_constants_mirror_those_of_the_kernels():
    source = "".join((KERNELS / f"{name}.cuh").read_text() for name in ("device", "sort", "project", "blend"))
    for line in (
        f"BLOCK = {cuda.BLOCK};",
        f"PROJECT_BLOCK = {cuda.PROJECT_BLOCK};",
        f"BLEND_BLOCK = {cuda.BLEND_BLOCK};",
        f"WARP = {cuda.WARP};",
        f"TILE = {cuda.TILE};",
        f"RECORD = {cuda.RECORD};",
        f"ABSOLUTES = {cuda.ABSOLUTES};",
        f"RADIX_BITS = {cuda.RADIX_BITS};",
        f"sizeof(Camera) == {cuda.CAMERA} * sizeof(float)",
    ):
        assert line in source
    assert (cuda.SCAN_CHUNK, cuda.SORT_CHUNK) == (cuda.BLOCK * 8, cuda.BLOCK * 16)
    assert "SCAN_ITEMS = 8;" in source
    assert "SORT_ROUNDS = 16;" in source


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


def judge_slots(emulator: Emulator) -> None:
    """Check that each pair fills exactly its own slots and that every rendered number is finite."""
    gaussians, cameras = make_gaussians(60, log_scale=-1.0), make_cameras(2, 21, 27)
    views = cuda._CudaPass(emulator, cameras, CPU)
    views.project(list(gaussians.tensors().values()))
    with emulator.on(CPU) as launch:
        group = views._list(launch, *views._split()[0])
    counts = views.slot_count.flatten().long()
    pairs = torch.arange(counts.numel()).repeat_interleave(counts)
    nth = torch.arange(pairs.numel()) - (counts.cumsum(0) - counts)[pairs]
    assert torch.equal(group.pair_of_slot[views.first_slot.flatten().long()[pairs] + nth].long(), pairs)
    assert group.ranges[-1].any(), "some slots are left over"
    scene = gaussians, cameras, backgrounds(2), make_weights(2, 21, 27)
    assert all(number.isfinite().all() for number in bits(*render_and_differentiate(emulator.render, *scene)))


@pytest.mark.parametrize("mutant", ROUNDING)
def test_lists_that_disagree_with_their_counts_leave_no_garbage(mutants, mutant):
    assert passes(mutants, judge_slots, NUMBERS[mutant])
