"""The native CPU rasterizer against the reference, and the laws that need no reference."""

import math

import pytest
import torch
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
from cadam3d.core.gaussians import FIELDS
from cadam3d.rasterizer.base import NEAR
from cadam3d.rasterizer.build import build, find_compiler, load
from cadam3d.rasterizer.cpu import CpuRasterizer, instruction_set, rasterize
from cadam3d.rasterizer.reference import ReferenceRasterizer

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="no C++ compiler")

CPU = torch.device("cpu")


@pytest.fixture(scope="session")
def cpu(kernel_build):
    return CpuRasterizer(cache_dir=str(kernel_build.path.parent))


@pytest.fixture(autouse=True)
def _threads():
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


# -------------------------------------------------------------------------- agreement with the reference


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_agrees_on_random_scenes(cpu, degree):
    assert_agrees(cpu.render, make_gaussians(150, degree=degree, seed=degree), make_cameras(2, 45, 61))


@pytest.mark.parametrize(
    "gaussians",
    [
        pytest.param(needles(80), id="needles"),
        pytest.param(flat_discs(80), id="flat discs"),
        pytest.param(saturated(60), id="opacity one, deep stacks"),
        pytest.param(duplicated(90), id="equal depths"),
        pytest.param(make_gaussians(300, seed=11, log_scale=-9.0, opacity=3.0), id="smaller than a pixel"),
        pytest.param(make_gaussians(60, seed=12, log_scale=1.0, opacity=-2.0), id="each covers the screen"),
        pytest.param(make_gaussians(80, seed=13, opacity=-5.0), id="faint"),
        pytest.param(make_gaussians(400, seed=14, spread=4.0, log_scale=-1.0), id="around the camera"),
        pytest.param(make_gaussians(1, seed=15), id="alone"),
    ],
)
def test_agrees_on_adversarial_scenes(cpu, gaussians):
    assert_agrees(cpu.render, gaussians, make_cameras(2, 37, 50, seed=1), most=0.5)


@pytest.mark.parametrize(("height", "width"), [(1, 1), (1, 19), (16, 16), (17, 15), (33, 7)])
def test_agrees_at_any_image_size(cpu, height, width):
    assert_agrees(
        cpu.render,
        make_gaussians(60, seed=2, degree=1, log_scale=-1.0),
        make_cameras(3, height, width),
        most=0.3,
    )


@pytest.mark.parametrize("image", IMAGES)
def test_agrees_for_a_loss_on_one_image_alone(cpu, image):
    assert_agrees(cpu.render, make_gaussians(60, degree=1), make_cameras(1, 30, 30), images=(image,))


def test_stops_many_screen_filling_splats_where_the_reference_does(cpu):
    gaussians = make_gaussians(3000, seed=4, log_scale=1.5, opacity=-1.0)
    output, _ = assert_agrees(cpu.render, gaussians, make_cameras(1, 20, 20), most=0.5)
    assert (output.alpha < 1).all()
    assert (output.alpha > 0.999).all()


@pytest.mark.parametrize("flag", ["-march=x86-64-v3", "-DSPLAT_RECORD_BUDGET=1"])
def test_narrower_vectors_and_groups_of_one_view_agree(kernel_build, tmp_path, flag):
    if flag.startswith("-march") and instruction_set(load(kernel_build)) != "avx512":
        pytest.skip("the machine's own vectors are not wider")
    kernels = load(build(tmp_path, machine_flags=((flag,),)))
    assert_agrees(
        lambda *scene: rasterize(kernels, *scene), make_gaussians(150, degree=1), make_cameras(3, 40, 50)
    )


# -------------------------------------------------------------------------- laws


def test_bits_do_not_depend_on_the_number_of_threads(cpu):
    gaussians, cameras = make_gaussians(2000, degree=1, log_scale=-2.5), make_cameras(2, 70, 90)
    results = []
    for threads in (1, 2, 3, 7):
        torch.set_num_threads(threads)
        scene = gaussians, cameras, backgrounds(2), make_weights(2, 70, 90)
        results.append(bits(*render_and_differentiate(cpu.render, *scene)))
    for other in results[1:]:
        assert_same_bits(results[0], other)


def test_a_batch_is_its_views(cpu):
    gaussians, cameras = make_gaussians(200, degree=2), make_cameras(3, 33, 47)
    weights, background = make_weights(3, 33, 47), backgrounds(3)
    whole, whole_grads = render_and_differentiate(cpu.render, gaussians, cameras, background, weights)
    totals = {name: torch.zeros_like(grad) for name, grad in whole_grads.items() if name in FIELDS}
    for i in range(3):
        view = slice(i, i + 1)
        one, grads = render_and_differentiate(
            cpu.render, gaussians, cameras.index(view), background[view], [w[view] for w in weights]
        )
        assert_same_bits(
            [getattr(one, name) for name in (*IMAGES, "means2d", "radii")] + [grads["means2d"]],
            [getattr(whole, name)[view] for name in (*IMAGES, "means2d", "radii")]
            + [whole_grads["means2d"][view]],
        )
        totals = {name: total + grads[name] for name, total in totals.items()}
    for name, total in totals.items():
        assert_close(name, whole_grads[name], total, 1e-6)


def test_order_of_the_rows_does_not_matter(cpu):
    gaussians, cameras = make_gaussians(300, degree=1), make_cameras(1, 40, 40)
    scene = cameras, backgrounds(1), make_weights(1, 40, 40)
    shuffle = torch.randperm(300, generator=torch.Generator().manual_seed(1))
    plain, plain_grads = render_and_differentiate(cpu.render, gaussians, *scene)
    other, other_grads = render_and_differentiate(cpu.render, gaussians.index(shuffle), *scene)
    assert_same_bits([getattr(plain, n) for n in IMAGES], [getattr(other, n) for n in IMAGES])
    for name in FIELDS:
        assert torch.equal(plain_grads[name][shuffle], other_grads[name])


@pytest.mark.parametrize("n", [0, 40])
def test_background_alone_where_nobody_is_seen(cpu, n):
    gaussians, cameras = make_gaussians(n), make_cameras(2, 20, 30)
    gaussians.opacity_logits -= 50.0
    output, grads = render_and_differentiate(
        cpu.render, gaussians, cameras, backgrounds(2), make_weights(2, 20, 30)
    )
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
def test_poison_never_spreads(cpu, field, value):
    gaussians, cameras = make_gaussians(50, degree=1), make_cameras(2, 25, 25)
    scene = cameras, backgrounds(2), make_weights(2, 25, 25)
    getattr(gaussians, field).view(50, -1)[7] = value
    output, grads = render_and_differentiate(cpu.render, gaussians, *scene)
    for tensor in bits(output, grads):
        assert tensor.isfinite().all()
    if not output.visible[:, 7].any():  # whoever is culled leaves no trace
        rest = gaussians.index(torch.arange(50) != 7)
        clean, clean_grads = render_and_differentiate(cpu.render, rest, *scene)
        assert_same_bits([getattr(output, n) for n in IMAGES], [getattr(clean, n) for n in IMAGES])
        for name in FIELDS:
            assert not grads[name][7].any()
            assert torch.equal(grads[name][torch.arange(50) != 7], clean_grads[name])
    assert math.isfinite(value) or not output.visible[:, 7].any()


@pytest.mark.parametrize(("z", "is_visible"), [(1e14, True), (1e20, False), (1e38, False)])
def test_poison_at_the_horizon_never_spreads(cpu, z, is_visible):
    gaussians, cameras = make_gaussians(50, degree=1, spread=0.2), make_cameras(1, 25, 25)
    cameras.world_to_camera[0] = torch.eye(4)
    gaussians.means[:, 2] += 2.0
    gaussians.means[7] = torch.tensor([0.0, 0.0, z])
    output, grads = render_and_differentiate(
        cpu.render, gaussians, cameras, backgrounds(1), make_weights(1, 25, 25)
    )
    assert output.visible[0, 7].item() is is_visible
    for tensor in bits(output, grads):
        assert tensor.isfinite().all()


def test_one_poisoned_number_is_enough_to_cull(cpu):
    for field in FIELDS:
        gaussians = make_gaussians(1, degree=3, spread=0.0)
        assert cpu.render(gaussians, make_cameras(1, 9, 9), backgrounds(1)).visible.all()
        getattr(gaussians, field).view(-1)[-1] = math.nan
        assert not cpu.render(gaussians, make_cameras(1, 9, 9), backgrounds(1)).visible.any()


@pytest.mark.parametrize(
    ("field", "culled", "seen"),
    [
        ("means", [0.0, 0.0, NEAR], [0.0, 0.0, 2 * NEAR]),
        ("means", [0.0, 0.0, -1.0], [0.0, 0.0, 1.0]),
        ("quats", [1e-7, 0.0, 0.0, 0.0], [1e-5, 0.0, 0.0, 0.0]),
        ("opacity_logits", -math.log(256.0), -math.log(250.0)),
        ("means", [40.0, 0.0, 2.0], [0.1, 0.0, 2.0]),
    ],
)
def test_culls_at_the_thresholds(cpu, field, culled, seen):
    cameras = make_cameras(1, 16, 16)
    cameras.world_to_camera[0] = torch.eye(4)
    gaussians = make_gaussians(1)
    gaussians.means[0] = torch.tensor([0.0, 0.0, 2.0])
    for value, is_visible in ((culled, False), (seen, True)):
        getattr(gaussians, field)[0] = torch.tensor(value)
        assert cpu.render(gaussians, cameras, backgrounds(1)).visible.item() is is_visible


def test_behaves_as_a_step_of_an_autograd_graph(cpu):
    cameras, background = make_cameras(2, 20, 20), backgrounds(2).requires_grad_()
    leaves = make_gaussians(40, degree=1).map(lambda tensor: tensor.requires_grad_())
    output = cpu.render(leaves, cameras, background)
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


def test_parameters_changed_in_place_before_backward_are_refused(cpu):
    leaves = make_gaussians(10).map(lambda tensor: tensor.requires_grad_())
    output = cpu.render(leaves, make_cameras(1, 9, 9), backgrounds(1))
    with torch.no_grad():
        leaves.log_scales.add_(1)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        output.rgb.sum().backward()


@pytest.mark.parametrize("field", FIELDS)
def test_one_tensor_alone_can_want_a_gradient(cpu, field):
    scene = make_cameras(1, 20, 20), backgrounds(1)
    gaussians, weights = make_gaussians(30, degree=1), make_weights(1, 20, 20)
    _, grads = render_and_differentiate(cpu.render, gaussians, *scene, weights)
    getattr(gaussians, field).requires_grad_()
    output = cpu.render(gaussians, *scene)
    sum((getattr(output, name) * w).sum() for name, w in zip(IMAGES, weights, strict=True)).backward()
    assert torch.equal(getattr(gaussians, field).grad, grads[field])
    assert torch.equal(output.means2d.grad, grads["means2d"])


def test_without_gradients_the_same_images_and_no_graph(cpu):
    gaussians = make_gaussians(60, degree=1).map(lambda tensor: tensor.requires_grad_())
    scene = make_cameras(2, 31, 31), backgrounds(2)
    with torch.no_grad():
        plain = cpu.render(gaussians, *scene)
    output = cpu.render(gaussians, *scene)
    for name in (*IMAGES, "means2d", "radii"):
        assert not getattr(plain, name).requires_grad
        assert torch.equal(getattr(plain, name), getattr(output, name))


def test_memory_layout_does_not_matter(cpu):
    gaussians, cameras = make_gaussians(60, degree=1), make_cameras(2, 31, 31)

    def scatter(tensor):
        wide = torch.stack([tensor, torch.full_like(tensor, math.nan)], dim=-1)
        return wide[..., 0]

    plain = cpu.render(gaussians, cameras, backgrounds(2))
    other = cpu.render(gaussians.map(scatter), cameras, scatter(backgrounds(2)))
    assert not gaussians.map(scatter).means.is_contiguous()
    assert_same_bits([getattr(plain, n) for n in IMAGES], [getattr(other, n) for n in IMAGES])
    leaves = gaussians.map(lambda tensor: tensor.requires_grad_())
    cpu.render(
        leaves, cameras, backgrounds(2)
    ).alpha.sum().backward()  # its gradient comes expanded, stride 0
    assert leaves.means.grad.abs().max() > 0


@pytest.mark.parametrize("dtype", [torch.float64, torch.bfloat16])
def test_other_dtypes_come_and_go(cpu, dtype):
    gaussians, cameras = make_gaussians(40).to(dtype), make_cameras(1, 20, 20)
    weights = make_weights(1, 20, 20)
    output, grads = render_and_differentiate(cpu.render, gaussians, cameras, backgrounds(1), weights, dtype)
    same, same_grads = render_and_differentiate(
        cpu.render,
        gaussians,
        cameras,
        backgrounds(1).to(dtype).float(),
        [w.to(dtype).float() for w in weights],
    )
    for got, want in zip(bits(output, grads), bits(same, same_grads), strict=True):
        assert got.dtype == dtype
        assert_close("output", got.float(), want, 0.02)


def test_refuses_what_it_cannot_render(cpu):
    gaussians, cameras = make_gaussians(3), make_cameras(1, 9, 9)
    with pytest.raises(UserError, match="rasterizer=auto"):
        cpu.render(gaussians.to("meta"), cameras, backgrounds(1))
    gaussians.sh = gaussians.sh.repeat(1, 2, 1)  # two coefficients: no degree
    with pytest.raises(ValueError, match="sh"):
        cpu.render(gaussians, cameras, backgrounds(1))
