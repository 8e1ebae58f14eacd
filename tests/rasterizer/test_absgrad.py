"""Laws of absgrad: what every pixel adds to the gradient of a projected mean, with nothing cancelled."""

import shutil

import pytest
import torch
from emulation import Emulator, compile_emulator, is_acquitted
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
from cadam3d.rasterizer.build import KERNELS
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
def test_it_is_the_sum_of_the_absolute_gradients_of_every_pixel_by_itself(gaussians):
    cameras, (v, h, w) = make_cameras(2, 11, 13), (2, 11, 13)
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
    assert (wanted > 1.1 * output.means2d.grad.abs()).any(), "somewhere pulls cancel"
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


def test_runs_of_records_long_enough_for_a_whole_warp_agree(backend):
    gaussians = make_gaussians(4, seed=16, log_scale=1.5)
    backend.agrees(gaussians, make_cameras(1, 75, 70), most=0.5, absgrad=True)


@pytest.mark.parametrize("image", IMAGES)
def test_it_agrees_for_a_loss_on_one_image_alone(backend, image):
    backend.agrees(make_gaussians(60), make_cameras(1, 30, 30), images=(image,), absgrad=True)


# -------------------------------------------------------------------------- laws that need no reference


def test_to_ask_for_it_changes_no_other_bit(any_backend):
    scene = make_gaussians(200, degree=1), make_cameras(2, 40, 50)
    plain, plain_grads = any_backend.differentiate(*scene)
    asked, asked_grads = any_backend.differentiate(*scene, absgrad=True)
    assert asked_grads.pop("absgrad").any()
    assert_same_bits(bits(plain, plain_grads), bits(asked, asked_grads))


def test_who_does_not_ask_does_not_get_it(any_backend):
    scene = any_backend.put(make_gaussians(20)), make_cameras(1, 9, 9), any_backend.put(backgrounds(1))
    assert any_backend.render(*scene).absgrad is None
    with torch.no_grad():
        assert any_backend.render(*scene, True).absgrad is None


def test_it_is_zero_itself_and_as_large_as_the_gradient_at_least(any_backend):
    gaussians, cameras = make_gaussians(100), make_cameras(2, 30, 40)
    scene = any_backend.put(gaussians), cameras, any_backend.put(backgrounds(2))
    assert not any_backend.render(*scene, True).absgrad.any()
    output, grads = any_backend.differentiate(gaussians, cameras, absgrad=True)
    slack = 1e-5 * float(grads["absgrad"].max())
    assert (grads["absgrad"] >= grads["means2d"].abs() - slack).all()
    assert not grads["absgrad"][~output.visible].any()


def test_a_loss_on_one_pixel_has_nothing_to_cancel(any_backend):
    gaussians, cameras, (y, x) = make_gaussians(60), make_cameras(1, 30, 30), (14, 17)
    spot = torch.zeros(1, 30, 30)
    spot[0, y, x] = 1.0
    weights = [spot[..., None] * make_weights(1, 30, 30)[0], spot, spot]
    _, grads = any_backend.differentiate(gaussians, cameras, weights, absgrad=True)
    assert_close("absgrad", grads["absgrad"], grads["means2d"].abs(), 1e-5)


def test_the_sign_of_the_loss_does_not_matter(any_backend):
    scene, weights = (make_gaussians(60), make_cameras(2, 30, 30)), make_weights(2, 30, 30)
    _, grads = any_backend.differentiate(*scene, weights, absgrad=True)
    _, turned = any_backend.differentiate(*scene, [-weight for weight in weights], absgrad=True)
    assert torch.equal(grads["absgrad"], turned["absgrad"])
    assert torch.equal(grads["means2d"], -turned["means2d"])


def test_a_batch_is_its_views(any_backend):
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


def test_no_gaussians_are_no_trouble(any_backend):
    nobody = any_backend.put(make_gaussians(0)).map(lambda tensor: tensor.requires_grad_())
    output = any_backend.render(nobody, make_cameras(2, 9, 9), any_backend.put(backgrounds(2)), True)
    assert output.absgrad.shape == (2, 0, 2)


# -------------------------------------------------------------------------- the CUDA kernels, on fibers


def test_the_bits_do_not_depend_on_who_comes_first(emulator):
    scene = saturated(60), make_cameras(2, 37, 50), backgrounds(2), make_weights(2, 37, 50)
    results = [
        render_and_differentiate(emulator.shuffled(seed).render, *scene, absgrad=True)[1]["absgrad"]
        for seed in (0, 1, 77)
    ]
    assert_same_bits(results[:1] * 2, results[1:])


def test_groups_of_views_have_the_same_bits_and_count_what_it_needs(emulator, monkeypatch):
    gaussians = make_gaussians(120, spread=3.0, log_scale=-1.5)
    scene = gaussians, make_cameras(4, 29, 38), backgrounds(4), make_weights(4, 29, 38)
    _, whole = render_and_differentiate(emulator.render, *scene, absgrad=True)
    monkeypatch.setattr(cuda, "RECORD_MEMORY", 1)
    _, split = render_and_differentiate(emulator.render, *scene, absgrad=True)
    assert_same_bits(whole.values(), split.values())

    def groups(absgrad: bool) -> int:
        frame = cuda._Frame(emulator, scene[1], torch.device("cpu"), absgrad)
        frame.project(list(gaussians.tensors().values()))
        slots = int(frame.slot_count.sum())
        monkeypatch.setattr(cuda, "RECORD_MEMORY", 4 * cuda.RECORD * slots)
        return len(frame._split())

    assert groups(absgrad=False) == 1
    assert groups(absgrad=True) > 1


def judge(emulator: Emulator) -> None:
    """What every mutant below must fail."""
    for gaussians in (saturated(40), make_gaussians(4, seed=16, log_scale=1.5)):
        assert_agrees(emulator.render, gaussians, make_cameras(1, 75, 70), most=0.3, absgrad=True)


MUTANTS = {
    "pulls that cancel": ("blend.cuh", "absolutes.u += fabsf(gu);", "absolutes.u += gu;"),
    "slots left as they were": ("blend.cuh", "j < ABSOLUTES; ++j) absolutes", "j < 0; ++j) absolutes"),
}


def test_the_judge_acquits_the_innocent(emulator):
    assert is_acquitted(emulator, judge)


@pytest.mark.parametrize("mutant", MUTANTS)
def test_a_mutant_is_caught(tmp_path, mutant):
    name, original, changed = MUTANTS[mutant]
    shutil.copytree(KERNELS, tmp_path / "kernels")
    path = tmp_path / "kernels" / name
    source = path.read_text()
    assert source.count(original) == 1
    path.write_text(source.replace(original, changed))
    assert not is_acquitted(compile_emulator(tmp_path, tmp_path / "kernels", "-O0"), judge)
