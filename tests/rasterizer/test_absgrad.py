"""Laws of absgrad: the absolute contributions of all pixels to the gradient of a projected mean, summed."""

import pytest
import torch
from emulation import Emulator, passes
from mutants import ABSOLUTE_GRADIENTS, NUMBERS
from splats import (
    IMAGES,
    assert_agrees,
    assert_close,
    assert_same_bits,
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

from cadam3d.rasterizer import cuda
from cadam3d.rasterizer.reference import ReferenceRasterizer

pytestmark = pytest.mark.usefixtures("garbage_in_new_memory")

# -------------------------------------------------------------------------- the definition


@pytest.mark.parametrize(
    "gaussians",
    [
        pytest.param(make_gaussians(12, degree=1, log_scale=-1.5), id="random"),
        pytest.param(saturated(12), id="opacity one, deep stacks"),
        pytest.param(needles(12), id="needles"),
    ],
)
def test_absgrad_is_the_sum_of_the_absolute_gradients_of_single_pixels(gaussians):
    cameras, (v, h, w) = make_cameras(2, 7, 9), (2, 7, 9)
    scene = gaussians.to(torch.float64).map(lambda tensor: tensor.requires_grad_())
    output = ReferenceRasterizer().render(scene, cameras, backgrounds(v).double(), absgrad=True)
    losses = sum(
        (getattr(output, name) * weight.double()).view(v, h, w, -1).sum(dim=-1)
        for name, weight in zip(IMAGES, make_weights(v, h, w), strict=True)
    )
    alone = [
        torch.autograd.grad(loss, output.means2d, retain_graph=True)[0].abs() for loss in losses.flatten()
    ]
    losses.sum().backward()
    wanted = torch.stack(alone).sum(dim=0)
    assert (wanted > 1.1 * output.means2d.grad.abs()).any(), "somewhere contributions cancel"
    torch.testing.assert_close(output.absgrad.grad, wanted, rtol=1e-9, atol=1e-12 * float(wanted.max()))


# -------------------------------------------------------------------------- agreement with the reference


@pytest.mark.parametrize(
    "gaussians",
    [
        pytest.param(make_gaussians(150, degree=1), id="random"),
        pytest.param(needles(80), id="needles"),
        pytest.param(flat_discs(80), id="flat discs"),
        pytest.param(saturated(60), id="opacity one, deep stacks"),
        pytest.param(make_gaussians(300, seed=11, log_scale=-9.0, opacity=3.0), id="smaller than a pixel"),
        pytest.param(make_gaussians(50, seed=12, log_scale=1.0, opacity=-2.0), id="each covers the screen"),
        pytest.param(make_gaussians(300, seed=14, spread=4.0, log_scale=-1.0), id="around the camera"),
    ],
)
def test_every_backend_agrees(backend, gaussians):
    cameras = make_cameras(2, 37, 50, seed=1)
    backend.agrees(gaussians, cameras, most=0.5, tolerance=backend.rounding, absgrad=True)


def test_runs_of_records_that_need_a_whole_warp_agree(backend):
    gaussians = make_gaussians(4, seed=16, log_scale=1.5)
    backend.agrees(gaussians, make_cameras(1, 75, 70), most=0.5, absgrad=True)


# -------------------------------------------------------------------------- laws that need no reference


def test_requesting_absgrad_changes_no_other_bit(any_backend):
    scene = make_gaussians(200, degree=1), make_cameras(2, 40, 50)
    plain, plain_grads = any_backend.differentiate(*scene)
    asked, asked_grads = any_backend.differentiate(*scene, absgrad=True)
    assert asked_grads.pop("absgrad").any()
    assert_same_bits(bits(plain, plain_grads), bits(asked, asked_grads))


def test_absgrad_is_none_unless_requested(any_backend):
    scene = any_backend.put(make_gaussians(20)), make_cameras(1, 9, 9), any_backend.put(backgrounds(1))
    assert any_backend.render(*scene).absgrad is None
    with torch.no_grad():
        assert any_backend.render(*scene, True).absgrad is None


def test_absgrad_is_zero_and_its_gradient_is_at_least_that_of_means2d(any_backend):
    gaussians, cameras = make_gaussians(100), make_cameras(2, 30, 40)
    scene = any_backend.put(gaussians), cameras, any_backend.put(backgrounds(2))
    assert not any_backend.render(*scene, True).absgrad.any()
    output, grads = any_backend.differentiate(gaussians, cameras, absgrad=True)
    slack = 1e-5 * float(grads["absgrad"].max())
    assert (grads["absgrad"] >= grads["means2d"].abs() - slack).all()
    assert not grads["absgrad"][~output.visible].any()


def test_nothing_cancels_for_a_loss_on_one_pixel(any_backend):
    gaussians, cameras, (y, x) = make_gaussians(60), make_cameras(1, 30, 30), (14, 17)
    spot = torch.zeros(1, 30, 30)
    spot[0, y, x] = 1.0
    weights = [spot[..., None] * make_weights(1, 30, 30)[0], spot, spot]
    _, grads = any_backend.differentiate(gaussians, cameras, weights, absgrad=True)
    assert_close("absgrad", grads["absgrad"], grads["means2d"].abs(), 1e-5)


def test_a_batch_equals_its_single_views(any_backend):
    gaussians, cameras = make_gaussians(100), make_cameras(3, 23, 37)
    weights, background = make_weights(3, 23, 37), backgrounds(3)
    _, whole = any_backend.differentiate(gaussians, cameras, weights, background, absgrad=True)
    for i in range(3):
        view = slice(i, i + 1)
        parts = cameras.index(view), [weight[view] for weight in weights], background[view]
        _, one = any_backend.differentiate(gaussians, *parts, absgrad=True)
        assert torch.equal(one["absgrad"], whole["absgrad"][view])


def test_the_bits_are_the_same_on_every_run(any_backend):
    scene = make_gaussians(300, log_scale=-3.0), make_cameras(2, 40, 50)
    _, first = any_backend.differentiate(*scene, absgrad=True)
    _, again = any_backend.differentiate(*scene, absgrad=True)
    assert torch.equal(first["absgrad"], again["absgrad"])


# -------------------------------------------------------------------------- the CUDA kernels, on fibers


def test_the_bits_do_not_depend_on_the_schedule_of_threads(emulator):
    scene = saturated(60), make_cameras(2, 37, 50), backgrounds(2), make_weights(2, 37, 50)
    results = [
        render_and_differentiate(emulator.shuffled(seed).render, *scene, absgrad=True)[1]["absgrad"]
        for seed in (0, 1, 77)
    ]
    assert_same_bits(results[:1] * 2, results[1:])


def test_groups_of_views_give_the_same_bits_and_account_for_absgrad_memory(emulator, monkeypatch):
    gaussians = make_gaussians(120, spread=3.0, log_scale=-1.5)
    scene = gaussians, make_cameras(4, 29, 38), backgrounds(4), make_weights(4, 29, 38)
    _, whole = render_and_differentiate(emulator.render, *scene, absgrad=True)
    monkeypatch.setattr(cuda, "RECORD_MEMORY", 1)
    _, split = render_and_differentiate(emulator.render, *scene, absgrad=True)
    assert_same_bits(whole.values(), split.values())

    def groups(absgrad: bool) -> int:
        views = cuda._CudaPass(emulator, scene[1], torch.device("cpu"), absgrad)
        with views:
            views.project(list(gaussians.tensors().values()))
        slots = views.read_slots()
        monkeypatch.setattr(cuda, "RECORD_MEMORY", 4 * cuda.RECORD * sum(slots))
        return len(views._split(slots, len(gaussians)))

    assert groups(absgrad=False) == 1
    assert groups(absgrad=True) > 1


def judge(emulator: Emulator) -> None:
    """Check the absolute gradients; every mutant must fail."""
    for gaussians in (saturated(40), make_gaussians(4, seed=16, log_scale=1.5)):
        assert_agrees(emulator.render, gaussians, make_cameras(1, 75, 70), most=0.3, absgrad=True)


def test_kernels_without_a_mistake_pass(emulator, mutants):
    assert passes(emulator, judge)
    assert passes(mutants, judge)


@pytest.mark.parametrize("mutant", ABSOLUTE_GRADIENTS)
def test_a_mutant_is_caught(mutants, mutant):
    assert not passes(mutants, judge, NUMBERS[mutant])
