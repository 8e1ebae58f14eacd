"""Inputs that are known to break rasterizers, and the rule that every backend follows for each of them."""

import math
from dataclasses import replace

import pytest
import torch
from splats import (
    IMAGES,
    POISON,
    assert_close,
    assert_same_bits,
    at_tile_corners,
    backgrounds,
    bits,
    ellipses,
    facing_camera,
    make_cameras,
    make_gaussians,
    make_weights,
    saturated,
    stack,
)

from cadam3d.core.gaussians import FIELDS, Gaussians
from cadam3d.rasterizer.base import ALPHA_MIN, NEAR

pytestmark = pytest.mark.usefixtures("garbage_in_new_memory")

NAN, INF = math.nan, math.inf
ABOVE_NEAR = torch.tensor(NEAR).nextafter(torch.tensor(1.0)).item()  # the next float32


def changed_gaussian(**fields):
    """Return twenty Gaussians around (0, 0, 2), in view of ``facing_camera``, with row 7 changed."""
    gaussians = make_gaussians(20, degree=1, spread=0.2)
    gaussians.means[:, 2] += 2.0
    for name, value in fields.items():
        getattr(gaussians, name)[7] = torch.as_tensor(value)
    return gaussians


def render_finite(backend, gaussians, cameras):
    """Return the output and the gradients, all of which must be finite."""
    output, grads = backend.differentiate(gaussians, cameras)
    for tensor in bits(output, grads):
        assert tensor.isfinite().all()
    return output, grads


def assert_leaves_no_trace(backend, gaussians, row, cameras):
    """Check that ``row`` is not visible, gets no gradient, and does not change the bits of the others."""
    assert_is_traceless(backend, gaussians, row, cameras, *render_finite(backend, gaussians, cameras))


def assert_is_traceless(backend, gaussians, row, cameras, output, grads):
    others = torch.arange(len(gaussians)) != row
    clean, clean_grads = backend.differentiate(gaussians.index(others), cameras)
    assert not output.visible[:, row].any()
    assert not output.means2d[:, row].any()
    assert not grads["means2d"][:, row].any()
    assert_same_bits([getattr(output, n) for n in IMAGES], [getattr(clean, n) for n in IMAGES])
    for name in FIELDS:
        assert not grads[name][row].any(), name
        assert torch.equal(grads[name][others], clean_grads[name]), name


def assert_is_drawn(backend, gaussians, row, cameras):
    """Check that ``row`` is visible and all numbers are finite; return its gradients."""
    output, grads = render_finite(backend, gaussians, cameras)
    assert output.visible[0, row]
    return {name: grads[name][row] for name in FIELDS}


# -------------------------------------------------------------------------- numbers that break others


@pytest.mark.parametrize("quat", [[0.0] * 4, [9e-7, 0.0, 0.0, 0.0], [0.0, 0.0, 1e-30, 0.0], [1e-45] * 4])
def test_a_zero_or_tiny_quaternion_is_culled(any_backend, quat):
    assert_leaves_no_trace(any_backend, changed_gaussian(quats=quat), 7, facing_camera(11, 13))


@pytest.mark.parametrize("length", [1.1e-6, 1e-3, 1e3, 1e18])
def test_the_length_of_any_other_quaternion_does_not_matter(any_backend, length):
    gaussians, cameras = changed_gaussian(), facing_camera(11, 13)
    gaussians.quats[7] /= gaussians.quats[7].norm()
    plain = any_backend.show(gaussians, cameras)
    gaussians.quats[7] *= length
    assert_is_drawn(any_backend, gaussians, 7, cameras)
    output = any_backend.show(gaussians, cameras)
    assert_close("alpha", output.alpha, plain.alpha, 1e-5)


# The last two scales are exactly zero.
@pytest.mark.parametrize("log_scale", [-60.0, -104.0, -1e3, -1e38])
def test_a_zero_scale_is_a_dot_of_the_blurs_size(any_backend, log_scale):
    cameras = facing_camera(11, 13)
    grads = assert_is_drawn(any_backend, changed_gaussian(log_scales=[log_scale] * 3), 7, cameras)
    assert grads["log_scales"].abs().max() < 1e-20
    assert grads["means"].any()
    small, none = (
        any_backend.show(changed_gaussian(log_scales=[value] * 3), cameras) for value in (-30.0, log_scale)
    )
    assert_close("rgb", none.rgb, small.rgb, 1e-6)


@pytest.mark.parametrize(
    "log_scale", [[5.0] * 3, [46.0] * 3, [46.0, -46.0, 0.0], [88.0, 0.0, 0.0], [0.0, 0.0, 700.0]]
)
@pytest.mark.parametrize("z", [0.0, -2.0])
def test_a_huge_scale_at_depth_zero_or_behind_is_culled(any_backend, log_scale, z):
    gaussians = changed_gaussian(means=[0.0, 0.0, z], log_scales=log_scale)
    assert_leaves_no_trace(any_backend, gaussians, 7, facing_camera(11, 13))


@pytest.mark.parametrize("log_scale", [INF, 1e38, NAN])
def test_an_infinite_scale_is_culled(any_backend, log_scale):
    for axis in range(3):
        scales = [0.0, 0.0, 0.0]
        scales[axis] = log_scale
        assert_leaves_no_trace(any_backend, changed_gaussian(log_scales=scales), 7, facing_camera(11, 13))


@pytest.mark.parametrize(("z", "is_seen"), [(NEAR, False), (ABOVE_NEAR, True), (0.0, False), (-1.0, False)])
def test_a_centre_on_the_near_plane_is_culled_and_one_just_behind_it_is_not(any_backend, z, is_seen):
    gaussians = changed_gaussian(means=[0.0, 0.0, z], log_scales=[-8.0] * 3)
    if is_seen:
        assert_is_drawn(any_backend, gaussians, 7, facing_camera(11, 13))
    else:
        assert_leaves_no_trace(any_backend, gaussians, 7, facing_camera(11, 13))


@pytest.mark.parametrize(("z", "is_seen"), [(1e14, True), (1e20, False), (1e38, False)])
def test_nothing_overflows_at_very_large_depths(any_backend, z, is_seen):
    gaussians = changed_gaussian(means=[0.0, 0.0, z])
    if is_seen:
        assert_is_drawn(any_backend, gaussians, 7, facing_camera(11, 13))
    else:
        assert_leaves_no_trace(any_backend, gaussians, 7, facing_camera(11, 13))


@pytest.mark.parametrize(
    ("field", "culled", "seen"),
    [
        ("opacity_logits", -math.log(256.0), -math.log(250.0)),
        ("means", [40.0, 0.0, 2.0], [0.1, 0.0, 2.0]),
        ("means", [0.0, -40.0, 2.0], [0.0, -0.1, 2.0]),
    ],
)
def test_a_gaussian_that_is_too_faint_or_off_screen_is_culled(any_backend, field, culled, seen):
    assert_leaves_no_trace(any_backend, changed_gaussian(**{field: culled}), 7, facing_camera(11, 13))
    assert_is_drawn(any_backend, changed_gaussian(**{field: seen}), 7, facing_camera(11, 13))


@pytest.mark.parametrize(
    ("field", "value"),
    # A colour of 1e38 is visible, and the gradients of its neighbours rightly exceed float32.
    [(field, value) for field in FIELDS for value in POISON if (field, abs(value)) != ("sh", 1e38)],
)
def test_a_bad_number_never_spreads_to_other_gaussians(backend, field, value):
    gaussians, cameras = make_gaussians(30, degree=1), make_cameras(2, 11, 13)
    getattr(gaussians, field).view(30, -1)[7] = value
    output, grads = render_finite(backend, gaussians, cameras)
    if not output.visible[:, 7].any():
        assert_is_traceless(backend, gaussians, 7, cameras, output, grads)
    assert math.isfinite(value) or not output.visible[:, 7].any()


@pytest.mark.parametrize("field", FIELDS)
def test_one_poisoned_number_is_enough_to_cull(any_backend, field):
    gaussians, cameras = make_gaussians(1, degree=3, spread=0.0), make_cameras(1, 9, 9)
    assert any_backend.show(gaussians, cameras).visible.all()
    getattr(gaussians, field).view(-1)[-1] = NAN
    assert not any_backend.show(gaussians, cameras).visible.any()


# -------------------------------------------------------------------------- large, many and opaque splats


def test_huge_splats_that_touch_more_tiles_than_one_thread_handles_agree(backend):
    # Each touches 100 tiles of 8x8 pixels: on a GPU, a whole warp lists such a splat and sums its records.
    backend.agrees(make_gaussians(5, seed=16, log_scale=1.5, opacity=-1.0), make_cameras(1, 75, 80), most=0.8)


def test_many_huge_splats_stop_where_those_of_the_reference_do(backend):
    gaussians = make_gaussians(10_000, seed=4, log_scale=1.5, opacity=-1.0)
    output, _ = backend.agrees(gaussians, make_cameras(1, 5, 6), most=0.4)
    assert (output.alpha < 1).all()
    assert (output.alpha > 0.999).all()


# The last three opacities are exactly one.
@pytest.mark.parametrize("logit", [5.0, 20.0, 40.0, 1e38])
def test_a_saturated_alpha_has_a_gradient_for_colour_but_not_for_opacity_or_shape(any_backend, logit):
    output, grads = any_backend.differentiate(stack(logit), facing_camera(5, 6))
    assert_close("alpha", output.alpha, torch.full_like(output.alpha, 0.99), 1e-6)
    for name in ("log_scales", "quats", "opacity_logits", "means2d"):
        assert not grads[name].any(), name
    assert grads["sh"].any()
    assert grads["means"][0, 2] != 0  # through the depth of the pixel
    assert any_backend.differentiate(stack(4.0), facing_camera(5, 6))[1]["opacity_logits"].any()


def test_deep_stacks_of_saturated_splats_have_the_gradients_of_the_reference(backend):
    gaussians = saturated(60)
    gaussians.means *= 0.5
    _, grads = backend.agrees(gaussians, make_cameras(1, 13, 14), most=0.5, tolerance=backend.rounding)
    assert grads["opacity_logits"].any()


def test_forward_and_backward_stop_at_the_same_splat(any_backend):
    # Transmittance 0.02, 0.0004, then 0.000008 < 1e-4: the third is not drawn, nor the fourth.
    logit = math.log(0.98 / 0.02)
    gaussians = stack(logit, logit, logit, -2.0)
    output, grads = any_backend.differentiate(gaussians, facing_camera(2, 3))
    assert_close("alpha", 1 - output.alpha, torch.full_like(output.alpha, 0.0004), 0.05)
    for name in FIELDS:
        assert not grads[name][2:].any(), name
    for name in ("opacity_logits", "sh", "log_scales"):
        assert grads[name].view(4, -1)[:2].any(dim=1).all(), name
    assert output.visible.all(), "hidden splats are not culled"


# -------------------------------------------------------------------------- borders


@pytest.mark.parametrize("log_scales", [[-1.5, -2.5, -3.0], [-0.9, -4.0, -4.0], [-2.5, -2.5, -2.5]])
def test_an_ellipse_reaches_a_pixel_across_the_border_of_a_tile_exactly_or_not_at_all(
    any_backend, log_scales
):
    gaussians, cameras = at_tile_corners(log_scales)
    output = any_backend.show(gaussians, cameras)
    exponents = torch.cat(
        [ellipses(gaussians, cameras, view).exponents(32, 32) for view in range(len(cameras))]
    )
    cut = torch.log(gaussians.opacities.double() / ALPHA_MIN)
    is_decided = (exponents / cut - 1).abs() > 1e-5
    assert is_decided.double().mean() > 0.999
    corner = (exponents / cut - 1)[:, 15:17, 15:17].flatten(1).abs().amin(dim=1)
    assert (corner < 1e-2).all(), "every view has a pixel at the very edge"
    assert torch.equal((output.alpha > 0)[is_decided], (exponents < cut)[is_decided])


@pytest.mark.parametrize(("height", "width"), [(1, 1), (1, 19), (8, 8), (9, 7), (16, 16), (17, 15), (33, 7)])
def test_image_sizes_that_are_not_multiples_of_a_tile_agree(backend, height, width):
    gaussians = make_gaussians(60, seed=2, degree=1, log_scale=-1.0)
    backend.agrees(gaussians, make_cameras(3, height, width), most=0.3)


@pytest.mark.parametrize(("height", "width"), [(1, 8192), (8192, 1)])
def test_images_of_8192_pixels_agree(backend, height, width):
    # In float32, centres near pixel 8000 are exact to 1/2000 of a pixel; the splats are wide enough for that.
    gaussians, cameras = make_gaussians(15, seed=6, spread=1.0, log_scale=-2.0), facing_camera(height, width)
    cameras.intrinsics[:, 0, 0], cameras.intrinsics[:, 1, 1] = width / 2.0, height / 2.0
    gaussians.means[:, 2] += 3.0
    output, _ = backend.agrees(gaussians, cameras, most=0.8, tolerance=1e-3, gradient_tolerance=1e-3)
    drawn = (output.alpha[0] > 0).amax(dim=0 if width > height else 1).nonzero()
    assert drawn.min() < 1000
    assert drawn.max() > 7000


# -------------------------------------------------------------------------- nothing to do


@pytest.mark.parametrize("n", [0, 40])
def test_an_empty_image_shows_the_background_and_has_zero_gradients(any_backend, n):
    gaussians, cameras = make_gaussians(n), make_cameras(2, 20, 30)
    gaussians.opacity_logits -= 50.0
    output, grads = any_backend.differentiate(gaussians, cameras)
    behind = backgrounds(2).to(any_backend.dtype)[:, None, None].expand(2, 20, 30, 3)
    assert torch.equal(output.rgb, behind)
    assert not output.alpha.any()
    assert not output.depth.any()
    assert not output.visible.any()
    for name, grad in grads.items():
        assert grad.shape == (output.means2d.shape if name == "means2d" else getattr(gaussians, name).shape)
        assert not grad.any()


def test_an_empty_view_among_others_agrees_and_gets_no_gradient(backend):
    cameras = make_cameras(3, 20, 30)
    cameras.world_to_camera[1, 2, 3] = -9.0  # everything is behind this camera
    output, grads = backend.agrees(make_gaussians(40), cameras)
    assert output.visible.any(dim=1).tolist() == [True, False, True]
    assert not grads["means2d"][1].any()


# -------------------------------------------------------------------------- kinds of tensors


def test_tensors_need_not_be_contiguous(any_backend):
    gaussians, cameras = any_backend.put(make_gaussians(60, degree=1)), make_cameras(2, 31, 31)
    background = any_backend.put(backgrounds(2))

    def scatter(tensor):
        return torch.stack([tensor, torch.full_like(tensor, NAN)], dim=-1)[..., 0]

    def everything(change):
        leaves = gaussians.map(lambda tensor: change(tensor).requires_grad_())
        views = replace(
            cameras,
            world_to_camera=change(cameras.world_to_camera),
            intrinsics=change(cameras.intrinsics),
        )
        output = any_backend.render(leaves, views, change(background))
        # The gradient of alpha is one number, expanded with stride 0.
        output.alpha.sum().backward()
        images = [getattr(output, name).detach() for name in IMAGES]
        return [
            *images,
            *(tensor.grad for tensor in (leaves.means, leaves.log_scales, leaves.opacity_logits)),
        ]

    assert not gaussians.map(scatter).means.is_contiguous()
    plain = everything(torch.clone)
    assert_same_bits(plain, everything(scatter))
    assert plain[3].any()


@pytest.mark.parametrize("dtype", [torch.float64, torch.bfloat16, torch.float16])
def test_other_dtypes_are_converted_in_and_out(backend, dtype):
    gaussians, cameras = make_gaussians(40).to(dtype), make_cameras(1, 20, 20)
    weights, background = (
        [w.to(dtype).float() for w in make_weights(1, 20, 20)],
        backgrounds(1).to(dtype).float(),
    )
    output, grads = replace(backend, dtype=dtype).differentiate(gaussians, cameras, weights, background)
    same, same_grads = backend.differentiate(gaussians, cameras, weights, background)
    for got, want in zip(bits(output, grads), bits(same, same_grads), strict=True):
        assert got.dtype == dtype
        assert_close("output", got.float(), want, 0.02)
    if dtype == torch.float64:
        assert torch.equal(output.rgb.float(), same.rgb)


def test_autocast_has_no_effect_inside(any_backend):
    gaussians, cameras = make_gaussians(30, degree=1), make_cameras(1, 20, 20)
    plain = bits(*any_backend.differentiate(gaussians, cameras))
    with torch.autocast(any_backend.device, dtype=torch.bfloat16):
        assert_same_bits(plain, bits(*any_backend.differentiate(gaussians, cameras)))


def test_cameras_and_background_are_converted_to_the_dtype_of_the_gaussians(any_backend):
    gaussians, cameras = any_backend.put(make_gaussians(20)), make_cameras(2, 9, 9)
    wanted = any_backend.render(gaussians, cameras, any_backend.put(backgrounds(2)))
    output = any_backend.render(gaussians, cameras.to(torch.float64), backgrounds(2).double())
    for name in IMAGES:
        assert getattr(output, name).dtype == any_backend.dtype
        assert getattr(output, name).device.type == any_backend.device
        assert torch.equal(getattr(output, name), getattr(wanted, name))


def test_shapes_that_would_make_kernels_read_outside_their_tensors_are_refused(backend):
    gaussians, cameras, background = backend.put(make_gaussians(4)), make_cameras(2, 9, 9), backgrounds(2)
    with pytest.raises(ValueError, match="expected"):
        backend.render(gaussians, cameras.index(slice(0, 1)), background)
    # These numbers belong to no degree, or to a degree that is too high.
    for coefficients in (2, 5, 25):
        torn = Gaussians(**gaussians.tensors() | {"sh": torch.zeros(4, coefficients, 3)})
        with pytest.raises(ValueError, match="expected"):
            backend.render(torn, cameras, background)
    assert backend.render(gaussians, cameras, background).visible.any()
