"""The CUDA rasterizer: its very kernels, on fibers everywhere, and on a GPU where there is one."""

import faulthandler
import math
import os
import shutil
from dataclasses import dataclass
from multiprocessing import get_context

import pytest
import torch
from emulation import Emulator, compile_emulator
from splats import (
    IMAGES,
    POISON,
    assert_agrees,
    assert_close,
    assert_same_bits,
    backgrounds,
    bits,
    duplicated,
    flat_discs,
    make_cameras,
    make_gaussians,
    make_weights,
    needles,
    render_and_differentiate,
    saturated,
)

from cadam3d.core.checks import UserError
from cadam3d.core.gaussians import FIELDS, Gaussians
from cadam3d.rasterizer import cuda
from cadam3d.rasterizer.build import KERNELS
from cadam3d.rasterizer.cuda import CudaRasterizer, rasterize, works_on
from cadam3d.rasterizer.reference import ReferenceRasterizer

pytestmark = pytest.mark.usefixtures("garbage_in_new_memory")

CPU = torch.device("cpu")


@dataclass(frozen=True)
class Backend:
    """Where a test renders."""

    rasterizer: Emulator | CudaRasterizer
    device: str

    def agrees(self, gaussians, cameras, **kwargs):
        return assert_agrees(self.rasterizer.render, gaussians, cameras, device=self.device, **kwargs)

    def differentiate(self, *scene):
        return render_and_differentiate(self.rasterizer.render, *scene, device=self.device)


@pytest.fixture(scope="session", params=["emulator", pytest.param("gpu", marks=pytest.mark.gpu)])
def backend(request, tmp_path_factory) -> Backend:
    if request.param == "emulator":
        return Backend(request.getfixturevalue("emulator"), "cpu")
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    return Backend(CudaRasterizer(cache_dir=str(tmp_path_factory.mktemp("cubin"))), "cuda")


# -------------------------------------------------------------------------- agreement with the reference


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_agrees_on_random_scenes(backend, degree):
    backend.agrees(make_gaussians(150, degree=degree, seed=degree), make_cameras(2, 45, 61))


@pytest.mark.parametrize(
    "gaussians",
    [
        pytest.param(needles(80), id="needles"),
        pytest.param(flat_discs(80), id="flat discs"),
        pytest.param(saturated(60), id="opacity one, deep stacks"),
        pytest.param(duplicated(90), id="equal depths"),
        pytest.param(make_gaussians(300, seed=11, log_scale=-9.0, opacity=3.0), id="smaller than a pixel"),
        pytest.param(make_gaussians(40, seed=12, log_scale=1.0, opacity=-2.0), id="each covers the screen"),
        pytest.param(make_gaussians(80, seed=13, opacity=-5.0), id="faint"),
        pytest.param(make_gaussians(200, seed=14, spread=4.0, log_scale=-1.0), id="around the camera"),
        pytest.param(make_gaussians(1, seed=15), id="alone"),
    ],
)
def test_agrees_on_adversarial_scenes(backend, gaussians):
    backend.agrees(gaussians, make_cameras(2, 37, 50, seed=1), most=0.5, tolerance=5e-5)


@pytest.mark.parametrize(("height", "width"), [(1, 1), (1, 19), (8, 8), (9, 7), (33, 7)])
def test_agrees_at_any_image_size(backend, height, width):
    backend.agrees(
        make_gaussians(60, seed=2, degree=1, log_scale=-1.0), make_cameras(3, height, width), most=0.3
    )


@pytest.mark.parametrize("image", IMAGES)
def test_agrees_for_a_loss_on_one_image_alone(backend, image):
    backend.agrees(make_gaussians(60, degree=1), make_cameras(1, 30, 30), images=(image,))


def test_agrees_where_whole_warps_help_one_splat(backend):
    # 120 tiles each: more than one thread lists alone, and more records than one thread sums.
    backend.agrees(make_gaussians(5, seed=16, log_scale=1.5, opacity=-1.0), make_cameras(1, 75, 90), most=0.8)


def test_stops_many_screen_filling_splats_where_the_reference_does(backend):
    gaussians = make_gaussians(1500, seed=4, log_scale=1.5, opacity=-1.0)
    output, _ = backend.agrees(gaussians, make_cameras(1, 12, 12), most=0.4)
    assert (output.alpha < 1).all()
    assert (output.alpha > 0.999).all()


# -------------------------------------------------------------------------- laws


def test_the_bits_do_not_depend_on_who_comes_first(emulator):
    scene = saturated(60), make_cameras(2, 37, 50), backgrounds(2), make_weights(2, 37, 50)
    results = [
        bits(*render_and_differentiate(emulator.shuffled(seed).render, *scene)) for seed in (0, 1, 2, 77)
    ]
    for other in results[1:]:
        assert_same_bits(results[0], other)


def test_the_bits_are_the_same_on_every_run(backend):
    scene = make_gaussians(2000, degree=1, log_scale=-3.0), make_cameras(2, 40, 50)
    scene = *scene, backgrounds(2), make_weights(2, 40, 50)
    first = bits(*backend.differentiate(*scene))
    for _ in range(1 if backend.device == "cpu" else 5):
        assert_same_bits(first, bits(*backend.differentiate(*scene)))


def test_a_batch_is_its_views(backend):
    gaussians, cameras = make_gaussians(100, degree=2), make_cameras(3, 23, 37)
    weights, background = make_weights(3, 23, 37), backgrounds(3)
    whole, whole_grads = backend.differentiate(gaussians, cameras, background, weights)
    totals = {name: torch.zeros_like(grad) for name, grad in whole_grads.items() if name in FIELDS}
    for i in range(3):
        view = slice(i, i + 1)
        one, grads = backend.differentiate(
            gaussians, cameras.index(view), background[view], [w[view] for w in weights]
        )
        assert_same_bits(
            [getattr(one, name) for name in (*IMAGES, "means2d", "radii")] + [grads["means2d"]],
            [getattr(whole, name)[view] for name in (*IMAGES, "means2d", "radii")]
            + [whole_grads["means2d"][view]],
        )
        totals = {name: total + grads[name] for name, total in totals.items()}
    for name, total in totals.items():
        assert_close(name, whole_grads[name], total, 2e-6)


def test_order_of_the_rows_does_not_matter(backend):
    gaussians, cameras = make_gaussians(300, degree=1), make_cameras(1, 30, 30)
    scene = cameras, backgrounds(1), make_weights(1, 30, 30)
    shuffle = torch.randperm(300, generator=torch.Generator().manual_seed(1))
    plain, plain_grads = backend.differentiate(gaussians, *scene)
    other, other_grads = backend.differentiate(gaussians.index(shuffle), *scene)
    assert_same_bits([getattr(plain, n) for n in IMAGES], [getattr(other, n) for n in IMAGES])
    for name in FIELDS:
        assert torch.equal(plain_grads[name][shuffle], other_grads[name])


@pytest.mark.parametrize("n", [0, 40])
def test_background_alone_where_nobody_is_seen(backend, n):
    gaussians, cameras = make_gaussians(n), make_cameras(2, 20, 30)
    gaussians.opacity_logits -= 50.0
    output, grads = backend.differentiate(gaussians, cameras, backgrounds(2), make_weights(2, 20, 30))
    assert torch.equal(output.rgb, backgrounds(2)[:, None, None].expand(2, 20, 30, 3))
    assert not output.alpha.any()
    assert not output.depth.any()
    assert not output.visible.any()
    for name, grad in grads.items():
        assert grad.shape == (output.means2d.shape if name == "means2d" else getattr(gaussians, name).shape)
        assert not grad.any()


@pytest.mark.parametrize(
    ("field", "value"),
    # A colour of 1e38 is seen, and what it gives its neighbours exceeds float32 by right.
    [(field, value) for field in FIELDS for value in POISON if (field, abs(value)) != ("sh", 1e38)],
)
def test_poison_never_spreads(backend, field, value):
    gaussians, cameras = make_gaussians(30, degree=1), make_cameras(2, 17, 17)
    scene = cameras, backgrounds(2), make_weights(2, 17, 17)
    getattr(gaussians, field).view(30, -1)[7] = value
    output, grads = backend.differentiate(gaussians, *scene)
    for tensor in bits(output, grads):
        assert tensor.isfinite().all()
    if not output.visible[:, 7].any():  # whoever is culled leaves no trace
        rest = gaussians.index(torch.arange(30) != 7)
        clean, clean_grads = backend.differentiate(rest, *scene)
        assert_same_bits([getattr(output, n) for n in IMAGES], [getattr(clean, n) for n in IMAGES])
        for name in FIELDS:
            assert not grads[name][7].any()
            assert torch.equal(grads[name][torch.arange(30) != 7], clean_grads[name])
    assert math.isfinite(value) or not output.visible[:, 7].any()


@pytest.mark.parametrize(("z", "is_visible"), [(1e14, True), (1e20, False), (1e38, False)])
def test_poison_at_the_horizon_never_spreads(backend, z, is_visible):
    gaussians, cameras = make_gaussians(30, degree=1, spread=0.2), make_cameras(1, 17, 17)
    cameras.world_to_camera[0] = torch.eye(4)
    gaussians.means[:, 2] += 2.0
    gaussians.means[7] = torch.tensor([0.0, 0.0, z])
    output, grads = backend.differentiate(gaussians, cameras, backgrounds(1), make_weights(1, 17, 17))
    assert output.visible[0, 7].item() is is_visible
    for tensor in bits(output, grads):
        assert tensor.isfinite().all()


def test_behaves_as_a_step_of_an_autograd_graph(emulator):
    cameras, background = make_cameras(2, 20, 20), backgrounds(2).requires_grad_()
    leaves = make_gaussians(40, degree=1).map(lambda tensor: tensor.requires_grad_())
    output = emulator.render(leaves, cameras, background)
    (output.rgb.square().sum() + output.means2d.square().sum()).backward(retain_graph=True)
    once = [tensor.grad.clone() for tensor in (*leaves.tensors().values(), background, output.means2d)]
    (output.rgb.square().sum() + output.means2d.square().sum()).backward()
    twice = [tensor.grad for tensor in (*leaves.tensors().values(), background, output.means2d)]
    assert_same_bits([2 * grad for grad in once], twice)

    wanted = make_gaussians(40, degree=1).to(torch.float64).map(lambda tensor: tensor.requires_grad_())
    wanted_background = backgrounds(2).double().requires_grad_()
    reference = ReferenceRasterizer().render(wanted, cameras, wanted_background)
    (reference.rgb.square().sum() + reference.means2d.square().sum()).backward()
    means, *others = (tensor.grad for tensor in wanted.tensors().values())
    for got, want in zip(once, (means, *others, wanted_background.grad, reference.means2d.grad), strict=True):
        assert_close("gradient", got, want, 1e-3)  # no pixel is left out here


def test_parameters_changed_in_place_before_backward_are_refused(emulator):
    leaves = make_gaussians(10).map(lambda tensor: tensor.requires_grad_())
    output = emulator.render(leaves, make_cameras(1, 9, 9), backgrounds(1))
    with torch.no_grad():
        leaves.log_scales.add_(1)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        output.rgb.sum().backward()


def test_takes_strides_and_dtypes_as_they_come_and_ignores_autocast(emulator):
    gaussians, cameras = make_gaussians(30, degree=1), make_cameras(1, 20, 20)
    weights = make_weights(1, 20, 20)
    plain = render_and_differentiate(emulator.render, gaussians, cameras, backgrounds(1), weights)
    strided = gaussians.map(lambda tensor: tensor.repeat_interleave(2, dim=0)[::2])
    assert not strided.means.is_contiguous()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        other = render_and_differentiate(emulator.render, strided, cameras, backgrounds(1), weights)
    assert_same_bits(bits(*plain), bits(*other))
    double = emulator.render(gaussians.to(torch.float64), cameras, backgrounds(1))
    assert double.rgb.dtype == double.means2d.dtype == double.radii.dtype == torch.float64
    assert torch.equal(double.rgb.float(), plain[0].rgb)


def test_keeps_nothing_for_a_backward_that_cannot_come(emulator):
    with torch.no_grad():
        output = emulator.render(make_gaussians(10), make_cameras(1, 9, 9), backgrounds(1))
    assert not output.rgb.requires_grad
    assert not output.means2d.requires_grad


def test_refuses_what_would_make_kernels_read_foreign_memory(emulator):
    gaussians, cameras = make_gaussians(4), make_cameras(2, 9, 9)
    with pytest.raises(ValueError, match="wanted"):
        rasterize(emulator, gaussians, cameras.index(slice(0, 1)), backgrounds(2))
    torn = Gaussians(**gaussians.tensors() | {"sh": torch.zeros(4, 5, 3)})
    with pytest.raises(ValueError, match="wanted"):
        rasterize(emulator, torn, cameras, backgrounds(2))


@pytest.mark.parametrize("most", [100, 500])  # fewer than pixels; fewer than (splat, tile) pairs
def test_more_than_numbers_can_count_is_refused_before_it_is_allocated(emulator, monkeypatch, most):
    monkeypatch.setattr(cuda, "MOST", most)
    with pytest.raises(UserError, match=r"too many\. Try: fewer"):
        emulator.render(make_gaussians(200, log_scale=0.0), make_cameras(1, 20, 20), backgrounds(1))


@pytest.mark.gpu
def test_runs_on_the_stream_that_is_current():
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    rasterizer, scene = CudaRasterizer(cache_dir=None), (make_cameras(1, 64, 64), backgrounds(1).cuda())
    gaussians = make_gaussians(1000).to("cuda")
    want = rasterizer.render(gaussians, *scene).rgb
    torch.cuda.synchronize()
    with torch.cuda.stream(torch.cuda.Stream()):
        torch.cuda._sleep(10**8)  # what another stream would overtake
        got = rasterizer.render(gaussians.map(lambda tensor: tensor + 0), *scene).rgb
    torch.cuda.synchronize()
    assert torch.equal(got, want)


def test_off_cuda_it_says_what_to_type():
    with pytest.raises(UserError, match="rasterizer=auto"):
        CudaRasterizer(cache_dir=None).render(make_gaussians(1), make_cameras(1, 9, 9), backgrounds(1))
    assert not works_on(CPU)
    assert works_on(torch.device("cuda")) is torch.cuda.is_available()


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


def test_the_sort_is_exact_where_its_counts_need_three_kernels(emulator):
    assert 270_000 // cuda.SORT_CHUNK * 2**cuda.RADIX_BITS > cuda.SCAN_SHORT
    check_sort(emulator, 270_000, 10**6, 16)


@pytest.mark.gpu
def test_the_sort_takes_more_than_2_to_27_keys(tmp_path):
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    n = 2**27 + 1
    keys = torch.randint(0, 2**31 - 1, (n,), dtype=torch.int32, device="cuda")
    with cuda.load_kernels(str(tmp_path)).on(keys.device) as launch:
        got, order = cuda._sort(launch, keys, 32)
    want, want_order = keys.sort(stable=True)
    assert torch.equal(got, want)
    assert torch.equal(order.long(), want_order)


@pytest.mark.parametrize("make", [needles, flat_discs, make_gaussians])
def test_every_tile_with_a_pixel_in_reach_is_listed_and_few_others(emulator, make):
    gaussians, cameras = make(120), make_cameras(2, 61, 83)
    frame = cuda._Frame(emulator, cameras, CPU)
    frame.project(list(gaussians.tensors().values()))
    with emulator.on(CPU) as launch:
        lists = frame._list(launch, *frame._split()[0])
    listed = torch.zeros(2 * frame.tiles, 2 * len(gaussians), dtype=torch.bool)
    for tile, (begin, end) in enumerate(lists.ranges[:-1].tolist()):
        pairs = lists.pair_of_slot[lists.slots[begin:end].long()].long()
        depths = frame.splats.view(-1, cuda.SPLAT)[pairs, 7]
        assert (depths.diff() >= 0).all()
        listed[tile, pairs] = True
    assert listed.sum() == lists.slots.shape[0]
    assert not lists.ranges[-1].any()

    x, y, l11, l12, l22, cut, *_ = frame.splats.double().view(-1, cuda.SPLAT, 1, 1).unbind(dim=1)
    rows, columns = torch.meshgrid(torch.arange(64) + 0.5, torch.arange(88) + 0.5, indexing="ij")
    dx, dy = columns.double() - x, rows.double() - y
    is_reached = (l11 * dx + l12 * dy).square() + (l22 * dy).square() <= cut * (1 - 1e-5)
    is_reached &= (rows < 61) & (columns < 83)
    is_seen = frame.depth_keys.flatten() != -1
    wanted = is_reached.view(-1, 8, 8, 11, 8).any(dim=4).any(dim=2).flatten(1) & is_seen[:, None]
    in_view = wanted.view(2, 120, -1)
    want = torch.zeros_like(listed).view(2, frame.tiles, 2, 120)
    for v in range(2):
        want[v, :, v] = in_view[v].T
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
        f"RADIX_BITS = {cuda.RADIX_BITS};",
        f"sizeof(Camera) == {cuda.CAMERA} * sizeof(float)",
    ):
        assert line in source
    assert (cuda.SCAN_CHUNK, cuda.SORT_CHUNK) == (cuda.BLOCK * 8, cuda.BLOCK * 16)
    assert "SCAN_ITEMS = 8;" in source
    assert "SORT_ROUNDS = 16;" in source


# -------------------------------------------------------------------------- the judge is judged


def judge(emulator: Emulator) -> None:
    """What every mutant below must fail."""
    for seed in (1, 2):
        check_sort(emulator.shuffled(seed), 5000, 7, 9)
    scene = saturated(40), make_cameras(1, 21, 27)
    assert_agrees(emulator.render, *scene, most=0.5)
    assert_agrees(
        emulator.render, make_gaussians(4, seed=16, log_scale=1.5), make_cameras(1, 75, 70), most=0.5
    )


MUTANTS = {
    "no barrier in the prefix sum": (
        "sort.cuh",
        "    sums[t] = inclusive;\n    __syncthreads();\n  }",
        "    sums[t] = inclusive;\n  }",
    ),
    "a barrier that not all reach": (
        "sort.cuh",
        "  __syncthreads();  // the",
        "  if (t) __syncthreads();  // the",
    ),
    "no wait before a bin moves on": ("sort.cuh", "    __syncwarp();  // all", "    // all"),
    "a bin that does not move on": ("sort.cuh", "= at + 1;", "= at;"),
    "no barrier before bins become positions": (
        "sort.cuh",
        "  __syncthreads();\n  u32 position",
        "  u32 position",
    ),
    "the last row of tiles forgotten": ("tiles.cuh", "row <= rows.last / TILE", "row < rows.last / TILE"),
    "a list that misses its last splat": ("tiles.cuh", "= u32(e + 1);", "= u32(e);"),
    "no wait for the stage": ("blend.cuh", "    __syncwarp();\n    const int count", "    const int count"),
    "the last splat off by one": ("blend.cuh", "u32(base - begin) + j + 1)", "u32(base - begin) + j)"),
    "a pixel that never closes": ("blend.cuh", "    pixel.is_open = false;\n", ""),
    "no gate at the largest alpha": (
        "blend.cuh",
        "free <= float(SPLAT_ALPHA_MAX) ? -alpha * g_alpha : 0.0f",
        "-alpha * g_alpha",
    ),
    "a shuffle in a branch": ("blend.cuh", "if (__any_sync(ALL, hit0 || hit1))", "if (hit0 || hit1)"),
    "two sums swapped": ("blend.cuh", "fold(b4, s.gt, s.green, 16)", "fold(b4, s.green, s.gt, 16)"),
    "records left as they were": ("blend.cuh", "e = begin + used + lane;", "e = end;"),
    "half of a long run": (
        "project.cuh",
        "slot < from + many; slot += WARP",
        "slot < from + many / 2; slot += WARP",
    ),
}


def is_acquitted(emulator: Emulator) -> bool:
    """In a process of its own: a mutant may write anywhere."""

    def trial() -> None:
        torch.set_num_threads(1)  # threads do not survive a fork
        faulthandler.disable()  # to crash is one way to be found guilty
        try:
            judge(emulator)
        except (AssertionError, UserError):
            os._exit(1)
        os._exit(0)

    process = get_context("fork").Process(target=trial)
    process.start()
    process.join(60)
    process.kill()  # no more than a mutant that never ends is left
    process.join()
    return process.exitcode == 0


def test_the_judge_acquits_the_innocent(emulator):
    assert is_acquitted(emulator)


@pytest.mark.parametrize("mutant", MUTANTS)
def test_a_mutant_is_caught(tmp_path, mutant):
    name, original, changed = MUTANTS[mutant]
    shutil.copytree(KERNELS, tmp_path / "kernels")
    path = tmp_path / "kernels" / name
    source = path.read_text()
    assert source.count(original) == 1
    path.write_text(source.replace(original, changed))
    assert not is_acquitted(compile_emulator(tmp_path, tmp_path / "kernels", "-O0"))
