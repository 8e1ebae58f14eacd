"""Laws of every rasterizer with native kernels: on this CPU, on a GPU, and of the GPU's kernels on fibers."""

import math
from dataclasses import replace

import pytest
import torch
from splats import (
    IMAGES,
    assert_close,
    assert_same_bits,
    backgrounds,
    bits,
    duplicated,
    flat_discs,
    make_cameras,
    make_gaussians,
    make_weights,
    multiply_quats,
    needles,
    saturated,
    undecided,
)
from torch.nn.functional import normalize

from cadam3d.core.gaussians import FIELDS, concatenate
from cadam3d.rasterizer.reference import ReferenceRasterizer

pytestmark = pytest.mark.usefixtures("garbage_in_new_memory")

OF_A_VIEW = (*IMAGES, "means2d", "radii")

# -------------------------------------------------------------------------- agreement with the reference


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_every_backend_agrees_on_random_scenes(backend, degree):
    backend.agrees(make_gaussians(150, degree=degree, seed=degree), make_cameras(2, 45, 61))


@pytest.mark.parametrize(
    "gaussians",
    [
        pytest.param(needles(80), id="needles"),
        pytest.param(flat_discs(80), id="flat discs"),
        pytest.param(saturated(60), id="opacity one, deep stacks"),
        pytest.param(duplicated(90), id="equal depths"),
        pytest.param(make_gaussians(300, seed=11, log_scale=-9.0, opacity=3.0), id="smaller than a pixel"),
        pytest.param(make_gaussians(50, seed=12, log_scale=1.0, opacity=-2.0), id="each covers the screen"),
        pytest.param(make_gaussians(80, seed=13, opacity=-5.0), id="faint"),
        pytest.param(make_gaussians(300, seed=14, spread=4.0, log_scale=-1.0), id="around the camera"),
        pytest.param(make_gaussians(1, seed=15), id="alone"),
    ],
)
def test_every_backend_agrees_on_adversarial_scenes(backend, gaussians):
    backend.agrees(gaussians, make_cameras(2, 37, 50, seed=1), most=0.5, tolerance=backend.rounding)


@pytest.mark.parametrize("image", IMAGES)
def test_every_backend_agrees_for_a_loss_on_one_image_only(backend, image):
    backend.agrees(make_gaussians(60, degree=1), make_cameras(1, 30, 30), images=(image,))


# -------------------------------------------------------------------------- laws that need no reference


def test_the_bits_are_the_same_on_every_run(any_backend):
    scene = make_gaussians(1000, degree=1, log_scale=-3.0), make_cameras(2, 40, 50)
    first = bits(*any_backend.differentiate(*scene))
    for _ in range(5 if any_backend.name in ("cpu", "gpu") else 1):
        assert_same_bits(first, bits(*any_backend.differentiate(*scene)))


def test_a_batch_equals_its_single_views(any_backend):
    gaussians, cameras = make_gaussians(100, degree=2), make_cameras(3, 23, 37)
    weights, background = make_weights(3, 23, 37), backgrounds(3)
    whole, whole_grads = any_backend.differentiate(gaussians, cameras, weights, background)
    totals = {name: torch.zeros_like(whole_grads[name]) for name in FIELDS}
    for i in range(3):
        view = slice(i, i + 1)
        one, grads = any_backend.differentiate(
            gaussians, cameras.index(view), [w[view] for w in weights], background[view]
        )
        assert_same_bits(
            [getattr(one, name) for name in OF_A_VIEW], [getattr(whole, name)[view] for name in OF_A_VIEW]
        )
        assert torch.equal(grads["means2d"], whole_grads["means2d"][view])
        totals = {name: total + grads[name] for name, total in totals.items()}
    for name, total in totals.items():
        assert_close(name, whole_grads[name], total, 2e-6)


def test_the_order_of_rows_does_not_matter(any_backend):
    gaussians, cameras = make_gaussians(300, degree=1), make_cameras(1, 30, 30)
    shuffle = torch.randperm(300, generator=torch.Generator().manual_seed(1))
    plain, plain_grads = any_backend.differentiate(gaussians, cameras)
    other, other_grads = any_backend.differentiate(gaussians.index(shuffle), cameras)
    assert_same_bits([getattr(plain, n) for n in IMAGES], [getattr(other, n) for n in IMAGES])
    for name in FIELDS:
        assert_close(name, other_grads[name], plain_grads[name][shuffle], any_backend.order_of_sums)


def test_moving_scene_and_cameras_together_changes_nothing(any_backend):
    gaussians, cameras = make_gaussians(120), make_cameras(2, 31, 42)
    turn, shift = normalize(torch.tensor([0.3, -0.5, 0.7, 0.2]), dim=0), torch.tensor([0.4, -1.0, 0.5])
    rotation = replace(make_gaussians(1), quats=turn[None]).rotations[0]
    motion = torch.eye(4)
    motion[:3, :3], motion[:3, 3] = rotation, shift
    moved = replace(
        gaussians, means=gaussians.means @ rotation.T + shift, quats=multiply_quats(turn, gaussians.quats)
    )
    with_them = replace(cameras, world_to_camera=cameras.world_to_camera @ motion.inverse())
    decided = ~undecided(gaussians, cameras)
    weights = [w * decided.view(*decided.shape, *[1] * (w.ndim - 3)) for w in make_weights(2, 31, 42)]
    plain, grads = any_backend.differentiate(gaussians, cameras, weights)
    other, moved_grads = any_backend.differentiate(moved, with_them, weights)
    for name in IMAGES:
        assert_close(name, getattr(other, name)[decided], getattr(plain, name)[decided], 2e-5)
    # The gradients turn with the scene.
    grads["means"] = grads["means"] @ rotation.T.to(grads["means"])
    grads["quats"] = multiply_quats(turn.to(grads["quats"]), grads["quats"])
    for name, grad in grads.items():
        assert_close(f"gradient of {name}", moved_grads[name], grad, 2e-4)


def test_culled_gaussians_change_nothing_and_get_no_gradient(any_backend):
    seen, cameras = make_gaussians(60, degree=1), make_cameras(2, 25, 25)
    culled = make_gaussians(5, degree=1, seed=9)
    culled.means[:] = 3 * cameras.positions.mean(dim=0)  # behind both cameras
    culled.means[1:], culled.opacity_logits[1] = 0.0, -50.0
    culled.quats[2] = 0.0
    culled.log_scales[3, 1] = math.inf
    culled.means[4, 2] = math.nan
    rows = torch.arange(65).roll(2)  # two of them first, three last
    output, grads = any_backend.differentiate(concatenate([seen, culled]).index(rows), cameras)
    clean, clean_grads = any_backend.differentiate(seen, cameras)
    is_culled = rows >= 60
    assert not output.visible[:, is_culled].any()
    assert_same_bits([getattr(output, n) for n in IMAGES], [getattr(clean, n) for n in IMAGES])
    assert not grads["means2d"][:, is_culled].any()
    for name in FIELDS:
        assert not grads[name][is_culled].any(), name
        assert torch.equal(grads[name][~is_culled], clean_grads[name][rows[~is_culled]]), name


def test_fading_a_gaussian_out_removes_it_without_a_jump(any_backend):
    gaussians, cameras = make_gaussians(10), make_cameras(2, 25, 25)
    gaussians.means[0] = 0.3 * cameras.positions.mean(dim=0)  # in front of the others
    without = any_backend.show(gaussians.index(slice(1, None)), cameras)
    for opacity, least, most in ((0.05, 0.02, 0.1), (1.02 / 255, 1e-3, 0.01), (0.98 / 255, 0.0, 0.0)):
        gaussians.opacity_logits[0] = math.log(opacity / (1 - opacity))
        output = any_backend.show(gaussians, cameras)
        assert output.visible[:, 0].all().item() is (most > 0)
        for name in ("rgb", "alpha"):
            assert least <= (getattr(output, name) - getattr(without, name)).abs().max() <= most


# -------------------------------------------------------------------------- autograd


def test_a_backward_can_be_repeated_and_means2d_and_background_have_gradients(backend):
    cameras = make_cameras(2, 20, 20)

    def differentiate(render, put, times):
        leaves = put(make_gaussians(40, degree=1)).map(lambda tensor: tensor.requires_grad_())
        background = put(backgrounds(2)).requires_grad_()
        output = render(leaves, cameras, background)
        for left in reversed(range(times)):
            loss = output.rgb.square().sum() + output.means2d.square().sum()
            loss.backward(retain_graph=left > 0)
        return [tensor.grad.cpu() for tensor in (*leaves.tensors().values(), background, output.means2d)]

    once, twice = (differentiate(backend.render, backend.put, times) for times in (1, 2))
    assert_same_bits([2 * grad for grad in once], twice)
    wanted = differentiate(ReferenceRasterizer().render, lambda tensors: tensors.to(torch.float64), 1)
    for got, want in zip(once, wanted, strict=True):
        # The tolerance includes the pixels on a step of the model.
        assert_close("gradient", got, want, 1e-3)


def test_parameters_changed_in_place_before_backward_are_refused(backend):
    leaves = backend.put(make_gaussians(10)).map(lambda tensor: tensor.requires_grad_())
    output = backend.render(leaves, make_cameras(1, 9, 9), backend.put(backgrounds(1)))
    with torch.no_grad():
        leaves.log_scales.add_(1)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        output.rgb.sum().backward()


@pytest.mark.parametrize("field", FIELDS)
def test_a_single_tensor_can_require_a_gradient(backend, field):
    gaussians, cameras, weights = (
        make_gaussians(30, degree=1),
        make_cameras(1, 20, 20),
        make_weights(1, 20, 20),
    )
    _, grads = backend.differentiate(gaussians, cameras, weights)
    leaves = backend.put(gaussians)
    getattr(leaves, field).requires_grad_()
    output = backend.render(leaves, cameras, backend.put(backgrounds(1)))
    terms = [(getattr(output, name) * backend.put(w)).sum() for name, w in zip(IMAGES, weights, strict=True)]
    torch.stack(terms).sum().backward()
    assert torch.equal(getattr(leaves, field).grad.cpu(), grads[field])
    assert torch.equal(output.means2d.grad.cpu(), grads["means2d"])


def test_without_gradients_the_images_are_the_same_and_there_is_no_graph(backend):
    leaves = backend.put(make_gaussians(60, degree=1)).map(lambda tensor: tensor.requires_grad_())
    scene = make_cameras(2, 31, 31), backend.put(backgrounds(2))
    with torch.no_grad():
        plain = backend.render(leaves, *scene)
    output = backend.render(leaves, *scene)
    for name in OF_A_VIEW:
        assert not getattr(plain, name).requires_grad
        assert torch.equal(getattr(plain, name), getattr(output, name))


def test_inputs_are_not_modified(any_backend):
    gaussians, cameras = any_backend.put(make_gaussians(20, degree=1)), make_cameras(1, 9, 9)
    before = gaussians.map(torch.clone)
    any_backend.differentiate(gaussians, cameras)
    assert_same_bits(gaussians.tensors().values(), before.tensors().values())
