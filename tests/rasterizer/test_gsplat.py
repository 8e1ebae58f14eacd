"""The adapter to gsplat, with gsplat's own pure torch functions in place of its CUDA kernels.

Nothing here shows that gsplat's kernels are right. The tests marked ``gpu`` do, on a GPU.
"""

import math
import sys
from dataclasses import dataclass

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
    facing_camera,
    flat_discs,
    make_cameras,
    make_gaussians,
    make_weights,
    needles,
    render_and_differentiate,
    stack,
)

from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import FIELDS
from cadam3d.rasterizer import gsplat as adapter
from cadam3d.rasterizer.base import FAR, Rasterizer
from cadam3d.rasterizer.gsplat import GsplatRasterizer
from cadam3d.rasterizer.reference import ReferenceRasterizer
from cadam3d.rasterizer.selftest import GSPLAT, self_test

pytest.importorskip("gsplat", reason="pip install -e .[dev]")

from gsplat_on_cpu import SIGNATURE, rasterization

pytestmark = pytest.mark.usefixtures("garbage_in_new_memory")

CPU, GPU = torch.device("cpu"), torch.device("cuda", 0)
NAN = math.nan


@dataclass(frozen=True)
class OnCpu(Rasterizer):
    """The adapter, with a function in place of ``gsplat.rasterization``."""

    library: object = staticmethod(rasterization)

    def render(self, gaussians, cameras, background, absgrad=False):
        return adapter.rasterize(self.library, gaussians, cameras, background, absgrad)


render = OnCpu().render


def differentiate(gaussians, cameras, library=rasterization, **options):
    """Return the output and all gradients, with absgrad, of a weighted sum of the images."""
    v, size = len(cameras), (cameras.height, cameras.width)
    scene = gaussians, cameras, backgrounds(v), make_weights(v, *size)
    return render_and_differentiate(OnCpu(library).render, *scene, absgrad=True, **options)


# -------------------------------------------------------------------------- agreement with the reference


@pytest.mark.parametrize(
    "gaussians",
    [
        *(
            pytest.param(make_gaussians(40, degree=degree, seed=degree), id=f"degree {degree}")
            for degree in range(4)
        ),
        pytest.param(needles(30), id="needles"),
        pytest.param(flat_discs(30), id="flat discs"),
        pytest.param(make_gaussians(30, seed=12, log_scale=1.0, opacity=-2.0), id="each covers the screen"),
        pytest.param(make_gaussians(60, seed=15, spread=4.0, log_scale=-1.0), id="around the camera"),
        pytest.param(make_gaussians(10, seed=10).index(torch.arange(10).repeat(3)), id="equal depths"),
    ],
)
def test_images_centres_radii_and_all_gradients_agree(gaussians):
    # gsplat caps alpha elsewhere, so nothing here comes near a cap.
    gaussians.opacity_logits.clamp_(max=3.5)
    assert_agrees(render, gaussians, make_cameras(2, 19, 26, seed=1), most=0.5, absgrad=True)


def test_the_self_test_is_passed_and_notices_the_other_cap():
    agreement = self_test(OnCpu(), CPU, GSPLAT)
    assert agreement.passes, agreement
    assert agreement.worst_image < GSPLAT.images / 5
    assert agreement.worst_gradient < GSPLAT.gradients / 5
    capped = stack(40.0)
    view = facing_camera(5, 6)
    wanted = ReferenceRasterizer().render(capped, view, backgrounds(1)).alpha
    assert_close("alpha of ours", wanted, torch.full_like(wanted, 0.99), 1e-6)
    assert_close("alpha", render(capped, view, backgrounds(1)).alpha, torch.full_like(wanted, 0.999), 1e-6)


def transposed(given):
    given["viewmats"] = given["viewmats"].transpose(1, 2).contiguous()


def of_the_other_view(given):
    given["backgrounds"] = given["backgrounds"].flip(0)


def swapped(given):
    given["Ks"] = given["Ks"].flip(1).flip(2).roll((1, 1), (1, 2))
    given["Ks"][:, 2] = torch.tensor([0.0, 0.0, 1.0])


MISTAKES = {
    "view matrices transposed": transposed,
    "cameras to world": lambda given: given.update(viewmats=torch.inverse(given["viewmats"])),
    "no background": lambda given: given.update(backgrounds=None),
    "background of another view": of_the_other_view,
    "no low-pass": lambda given: given.update(eps2d=0.0),
    "compensated opacity": lambda given: given.update(rasterize_mode="antialiased"),
    "accumulated depth": lambda given: given.update(render_mode="RGB+D"),
    "logarithms of scales": lambda given: given.update(scales=given["scales"].log().abs()),
    "quaternions xyzw": lambda given: given.update(quats=given["quats"].roll(-1, dims=1)),
    "focal lengths exchanged": swapped,
    "no view dependence": lambda given: given.update(sh_degree=0),
    "opacities squared": lambda given: given.update(opacities=given["opacities"] ** 2),
    "a far near plane": lambda given: given.update(near_plane=2.5),
    "no absolute gradients": lambda given: given.update(absgrad=False),
    "detached means": lambda given: given.update(means=given["means"].detach().requires_grad_()),
}


def judge(library):
    """Check one small scene, on which every mistake must show."""
    gaussians = make_gaussians(20, degree=1, log_scale=-1.5)
    differentiated = differentiate(gaussians, make_cameras(2, 9, 11), library)
    reference = ReferenceRasterizer().render
    scene = gaussians, make_cameras(2, 9, 11), backgrounds(2), make_weights(2, 9, 11)
    wanted = render_and_differentiate(reference, *scene, dtype=torch.float64, absgrad=True)
    for got, want in zip(bits(*differentiated), bits(*wanted), strict=True):
        assert_close("number", got, want, 1e-3)


def test_without_a_mistake_the_small_scene_passes():
    judge(rasterization)


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_in_the_call_is_caught(mistake):
    def mistaken(**given):
        MISTAKES[mistake](given)
        return rasterization(**given)

    with pytest.raises((AssertionError, AttributeError)):
        judge(mistaken)


# -------------------------------------------------------------------------- the call


def test_the_call_fits_the_installed_gsplat():
    calls = []

    def spy(*args, **kwargs):
        calls.append(SIGNATURE.bind(*args, **kwargs))
        return rasterization(*args, **kwargs)

    adapter.rasterize(spy, make_gaussians(3, degree=2), make_cameras(2, 9, 11), backgrounds(2))
    [call] = calls
    assert (call.arguments["width"], call.arguments["height"], call.arguments["sh_degree"]) == (11, 9, 2)
    assert call.arguments["opacities"].shape == (3,)
    # Packed results have no rows of a view.
    assert call.arguments["packed"] is False
    assert all(
        tensor.is_contiguous() for tensor in call.arguments.values() if isinstance(tensor, torch.Tensor)
    )


# -------------------------------------------------------------------------- what is culled


def assert_is_traceless(gaussians, row, cameras):
    output, grads = differentiate(gaussians, cameras)
    for tensor in bits(output, grads):
        assert tensor.isfinite().all()
    assert not output.radii[:, row].any()
    assert not output.means2d[:, row].any()
    others = torch.arange(len(gaussians)) != row
    clean, clean_grads = differentiate(gaussians.index(others), cameras)
    assert_same_bits([getattr(output, n) for n in IMAGES], [getattr(clean, n) for n in IMAGES])
    for name in FIELDS:
        assert not grads[name][row].any(), name
        assert torch.equal(grads[name][others], clean_grads[name]), name


@pytest.mark.parametrize("field", FIELDS)
def test_a_number_that_is_not_finite_is_culled_and_leaves_no_trace(field):
    for value in (NAN, math.inf, -math.inf):
        gaussians = make_gaussians(6, degree=1)
        getattr(gaussians, field).view(6, -1)[3, -1] = value
        assert_is_traceless(gaussians, 3, make_cameras(2, 7, 9))


@pytest.mark.parametrize("field", FIELDS)
def test_a_bad_number_reaches_neither_gsplat_nor_other_gaussians(field):
    def spy(**given):
        assert all(t.isfinite().all() for t in given.values() if isinstance(t, torch.Tensor))
        # Products with a matrix stay finite.
        assert (given["means"].abs() < FAR).all()
        return rasterization(**given)

    # A colour of 1e38 is visible, and the gradients of its neighbours rightly exceed float32.
    for value in (value for value in POISON if (field, abs(value)) != ("sh", 1e38)):
        gaussians, cameras = make_gaussians(6, degree=1), make_cameras(1, 7, 9)
        getattr(gaussians, field).view(6, -1)[3] = value
        output, grads = differentiate(gaussians, cameras, spy)
        for tensor in bits(output, grads):
            assert tensor.isfinite().all(), value


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("quats", [0.0] * 4),
        ("quats", [9e-7, 0.0, 0.0, 0.0]),
        ("log_scales", [46.0, -46.0, 0.0]),
        ("means", [0.0, 0.0, 0.0]),
        ("means", [0.0, 0.0, -2.0]),
        ("means", [0.0, 0.0, 1e20]),
        ("means", [40.0, 0.0, 2.0]),
        ("opacity_logits", -math.log(256.0)),
    ],
)
def test_what_the_interface_culls_leaves_no_trace(field, value):
    gaussians = make_gaussians(6, degree=1, spread=0.2)
    gaussians.means[:, 2] += 2.0
    getattr(gaussians, field)[3] = torch.tensor(value)
    assert_is_traceless(gaussians, 3, facing_camera(7, 9))


def test_a_gaussian_that_ends_less_than_a_pixel_outside_is_not_seen():
    gaussians, cameras = make_gaussians(200, spread=0.8, log_scale=-3.0), make_cameras(2, 20, 20)
    listed = []

    def spy(**given):
        images, alphas, info = rasterization(**given)
        listed.append((info["radii"] > 0).all(dim=-1))
        return images, alphas, info

    output = adapter.rasterize(spy, gaussians, cameras, backgrounds(2))
    wanted = ReferenceRasterizer().render(gaussians, cameras, backgrounds(2))
    assert listed[0].sum() > wanted.visible.sum(), "gsplat lists some more"
    assert torch.equal(output.visible, wanted.visible)
    assert_close("radii", output.radii, wanted.radii, 1e-5)


def test_gsplat_never_gets_zero_gaussians():
    def refuse(**given):
        raise AssertionError("it would divide by zero")

    output = adapter.rasterize(
        refuse, make_gaussians(0), make_cameras(2, 9, 11), backgrounds(2), absgrad=True
    )
    assert torch.equal(output.rgb, backgrounds(2)[:, None, None].expand(2, 9, 11, 3))
    assert output.means2d.shape == output.absgrad.shape == (2, 0, 2)


# -------------------------------------------------------------------------- autograd


def backward_twice(renderer, dtype):
    leaves = make_gaussians(12, degree=1).to(dtype).map(lambda tensor: tensor.requires_grad_())
    background = backgrounds(2).to(dtype).requires_grad_()
    output = renderer(leaves, make_cameras(2, 9, 11), background, absgrad=True)
    for left in (1, 0):
        loss = output.rgb.square().sum() + output.means2d.square().sum()
        loss.backward(retain_graph=left > 0)
    others = (background, output.means2d, output.absgrad)
    return [tensor.grad for tensor in (*leaves.tensors().values(), *others)]


def test_gradients_of_repeated_backward_passes_and_of_means2d_and_background_add_up():
    wanted = backward_twice(ReferenceRasterizer().render, torch.float64)
    for got, want in zip(backward_twice(render, torch.float32), wanted, strict=True):
        assert_close("gradient", got, want, 1e-4)


def test_a_loss_may_use_means2d_alone_and_then_absgrad_is_zero_or_none():
    leaves = make_gaussians(8).map(lambda tensor: tensor.requires_grad_())
    exact = make_gaussians(8).to(torch.float64).map(lambda tensor: tensor.requires_grad_())
    output = render(leaves, make_cameras(1, 9, 9), backgrounds(1), absgrad=True)
    output.means2d.square().sum().backward()
    ReferenceRasterizer().render(
        exact, make_cameras(1, 9, 9), backgrounds(1)
    ).means2d.square().sum().backward()
    assert_close("gradient of means", leaves.means.grad, exact.means.grad, 1e-5)
    assert output.absgrad.grad is None or not output.absgrad.grad.any()


@pytest.mark.parametrize("field", [*FIELDS, None])
def test_means2d_has_its_gradient_whatever_else_requires_one(field):
    gaussians, cameras = make_gaussians(8, degree=1), make_cameras(1, 9, 9)
    _, grads = differentiate(gaussians, cameras)
    if field:
        getattr(gaussians, field).requires_grad_()
    output = render(gaussians, cameras, backgrounds(1))
    sum((getattr(output, n) * w).sum() for n, w in zip(IMAGES, make_weights(1, 9, 9), strict=True)).backward()
    assert torch.equal(output.means2d.grad, grads["means2d"])
    assert field is None or torch.equal(getattr(gaussians, field).grad, grads[field])


def test_without_gradients_the_images_are_the_same_and_there_is_no_graph():
    leaves = make_gaussians(8).map(lambda tensor: tensor.requires_grad_())
    scene = make_cameras(2, 9, 9), backgrounds(2)
    with torch.no_grad():
        plain = render(leaves, *scene, absgrad=True)
    output = render(leaves, *scene)
    assert plain.absgrad is None
    assert output.absgrad is None
    for name in (*IMAGES, "means2d", "radii"):
        assert not getattr(plain, name).requires_grad
        assert torch.equal(getattr(plain, name), getattr(output, name))


@pytest.mark.parametrize("dtype", [torch.float64, torch.bfloat16])
def test_gsplat_computes_in_float32_and_images_have_the_dtype_of_the_gaussians(dtype):
    def spy(**given):
        assert not torch.is_autocast_enabled("cpu")
        assert all(t.dtype == torch.float32 for t in given.values() if isinstance(t, torch.Tensor))
        return rasterization(**given)

    leaves = make_gaussians(8).to(dtype).map(lambda tensor: tensor.requires_grad_())
    scene = make_cameras(1, 9, 9), backgrounds(1).to(dtype)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        output = adapter.rasterize(spy, leaves, *scene)
    assert {getattr(output, name).dtype for name in (*IMAGES, "radii")} == {dtype}
    plain = render(leaves.to(torch.float32), *scene)
    assert_close("rgb", output.rgb.float(), plain.rgb, 0.01)
    output.rgb.sum().backward()
    assert all(tensor.grad.dtype == dtype for tensor in leaves.tensors().values() if tensor.grad is not None)


# -------------------------------------------------------------------------- when gsplat is missing or broken


@pytest.fixture
def a_gpu(monkeypatch):
    """Fake a CUDA device, and forget what earlier tests have loaded."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "synchronize", lambda device: None)
    monkeypatch.setattr(torch, "ones", lambda *size, device: None)
    monkeypatch.delitem(sys.modules, "gsplat.cuda._backend", raising=False)
    adapter.load_rasterization.cache_clear()
    yield
    adapter.load_rasterization.cache_clear()


def library(monkeypatch, first_call):
    """Replace the first kernel that the adapter calls."""
    monkeypatch.setattr("gsplat.quat_scale_to_covar_preci", first_call)


def message_of(device=GPU) -> str:
    with pytest.raises(UserError) as caught:
        GsplatRasterizer().prepare(device)
    message = str(caught.value)
    assert message.startswith("rasterizer=gsplat: ")
    assert "\n" not in message
    assert " Try: " in message
    return message


def test_a_missing_package_is_refused_with_the_command_that_installs_it(a_gpu, monkeypatch):
    monkeypatch.setattr(adapter, "find_spec", lambda name: None)
    assert message_of().endswith("got none. Try: pip install '.[gsplat]'")


def test_a_failed_build_is_quoted_in_one_line(a_gpu, monkeypatch):
    def first_call(*args, **kwargs):
        raise RuntimeError("Error building extension 'gsplat_cuda': [1/20] nvcc\nerror: no g++\n")

    library(monkeypatch, first_call)
    message = message_of()
    assert "RuntimeError: Error building extension 'gsplat_cuda': [1/20] nvcc" in message


# -------------------------------------------------------------------------- on a GPU


@pytest.fixture
def on_gpu():
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    try:
        GsplatRasterizer().prepare(GPU)
    except UserError as error:
        pytest.skip(str(error))


@pytest.mark.gpu
@pytest.mark.usefixtures("on_gpu")
def test_gsplat_passes_the_self_test_on_this_gpu():
    agreement = self_test(GsplatRasterizer(), GPU, GSPLAT)
    assert agreement.passes, agreement


@pytest.mark.gpu
@pytest.mark.usefixtures("on_gpu")
@pytest.mark.parametrize("degree", range(4))
def test_gsplat_agrees_on_this_gpu(degree):
    gaussians = make_gaussians(150, degree=degree, seed=degree)
    gaussians.opacity_logits.clamp_(max=3.5)
    tolerances = {"tolerance": GSPLAT.images, "gradient_tolerance": 2e-3, "most": 0.5}
    assert_agrees(
        GsplatRasterizer().render,
        gaussians,
        make_cameras(2, 45, 61),
        device="cuda",
        absgrad=True,
        **tolerances,
    )


@pytest.mark.gpu
@pytest.mark.usefixtures("on_gpu")
@pytest.mark.parametrize("field", FIELDS)
def test_a_number_that_is_not_finite_leaves_no_trace_on_this_gpu(field):
    for value in (NAN, math.inf, -math.inf):
        gaussians, cameras = make_gaussians(30, degree=1), make_cameras(2, 11, 13)
        getattr(gaussians, field).view(30, -1)[7, -1] = value
        scene = cameras, backgrounds(2), make_weights(2, 11, 13)
        output, grads = render_and_differentiate(GsplatRasterizer().render, gaussians, *scene, device="cuda")
        for tensor in bits(output, grads):
            assert tensor.isfinite().all()
        assert not output.visible[:, 7].any()
        assert not any(grads[name][7].any() for name in FIELDS)
