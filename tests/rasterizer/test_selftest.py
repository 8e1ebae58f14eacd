"""The self-test accepts rounding errors and notices everything else."""

import math
from dataclasses import dataclass, replace

import pytest
import torch
from splats import undecided

from cadam3d.compiled.library import find_compiler
from cadam3d.core.gaussians import FIELDS, Gaussians
from cadam3d.rasterizer import reference
from cadam3d.rasterizer.base import NEAR, Rasterizer
from cadam3d.rasterizer.cpu import CpuRasterizer
from cadam3d.rasterizer.cuda import rasterize_ahead
from cadam3d.rasterizer.forecast import find_forecast
from cadam3d.rasterizer.reference import ReferenceRasterizer
from cadam3d.rasterizer.selftest import (
    GSPLAT,
    HEIGHT,
    OWN,
    WIDTH,
    make_scene,
    self_test,
)

CPU = torch.device("cpu")


@dataclass(frozen=True, kw_only=True)
class Bent(Rasterizer):
    """The reference with one mistake: ``before`` changes its scene, or ``after`` changes its output."""

    before: object = staticmethod(lambda gaussians, cameras, background: (gaussians, cameras, background))
    after: object = staticmethod(lambda output: output)

    def render(self, gaussians, cameras, background, absgrad=False):
        scene = self.before(gaussians, cameras, background)
        return self.after(ReferenceRasterizer().render(*scene, absgrad))


class _Bend(torch.autograd.Function):
    """The identity, with a wrong gradient."""

    @staticmethod
    def forward(ctx, tensor, bend):
        ctx.bend = bend
        return tensor.clone()

    @staticmethod
    def backward(ctx, grad):
        return ctx.bend(grad), None


def bent_gradient(field, bend) -> Bent:
    def before(gaussians, cameras, background):
        tensors = gaussians.tensors()
        return Gaussians(**tensors | {field: _Bend.apply(tensors[field], bend)}), cameras, background

    return Bent(before=before)


def test_float32_agrees_with_float64_far_inside_the_limits():
    agreement = self_test(ReferenceRasterizer(), CPU)
    assert agreement.holds
    assert agreement.repeats
    assert agreement.worst_image < OWN.images / 5
    assert agreement.worst_gradient < OWN.gradients / 20
    assert set(agreement.gradients) == {*FIELDS, "means2d", "absgrad"}


@pytest.mark.skipif(find_compiler() is None, reason="no C++ compiler")
def test_the_native_kernels_pass(kernel_build):
    agreement = self_test(CpuRasterizer(cache_dir=str(kernel_build.parent)), CPU)
    assert agreement.holds, agreement
    assert agreement.repeats


def test_the_cuda_kernels_pass_in_the_emulator(emulator):
    @dataclass(frozen=True)
    class Emulated(Rasterizer):
        def render(self, gaussians, cameras, background, absgrad=False):
            return emulator.render(gaussians, cameras, background, absgrad)

        def render_ahead(self, gaussians, cameras, background, absgrad=False):
            output = rasterize_ahead(emulator, gaussians, cameras, background, absgrad)
            ahead.append(output.overflowed is not None)
            return output

    ahead = []
    find_forecast.cache_clear()
    agreement = self_test(Emulated(), CPU)
    assert agreement.holds, agreement
    assert agreement.repeats
    assert ahead == [False, True, True], "what training does is tested, too"


def test_rendering_ahead_with_other_bits_is_noticed():
    @dataclass(frozen=True)
    class Overflowing(ReferenceRasterizer):
        def render_ahead(self, gaussians, cameras, background, absgrad=False):
            output = self.render(gaussians, cameras, background, absgrad)
            return replace(output, rgb=background[:, None, None].expand_as(output.rgb))

    assert not self_test(Overflowing(), CPU).passes


# -------------------------------------------------------------------------- the scene


@pytest.mark.parametrize("demands", [OWN, GSPLAT])
def test_no_number_of_the_scene_is_near_a_step(demands):
    scene = make_scene(demands.most_opacity)
    assert not undecided(scene.gaussians, scene.cameras, within=1e-4).any()


@pytest.mark.parametrize(
    "name", ["BLUR", "ALPHA_MIN", "ALPHA_MAX", "TRANSMITTANCE_MIN", "FRUSTUM_MARGIN", "NEAR"]
)
def test_a_change_of_any_constant_of_the_model_is_noticed(name, monkeypatch):
    original = {name: getattr(reference, name)}
    moved = {"BLUR": 0.31, "ALPHA_MIN": 1 / 250, "ALPHA_MAX": 0.98, "TRANSMITTANCE_MIN": 2e-4}
    moved |= {"FRUSTUM_MARGIN": 0.1, "NEAR": 0.3}

    def before(*scene):
        monkeypatch.setattr(reference, name, moved[name])
        return scene

    def after(output):
        monkeypatch.setattr(reference, name, original[name])
        return output

    assert not self_test(Bent(before=before, after=after), CPU).holds


def test_the_scene_has_gaussians_behind_beside_and_across_the_border():
    scene = make_scene()
    output = ReferenceRasterizer().render(scene.gaussians, scene.cameras, scene.background)
    assert 0.5 < output.visible.double().mean() < 1
    is_outside = (output.means2d < 0) | (output.means2d > torch.tensor([WIDTH, HEIGHT]))
    assert (is_outside.any(dim=-1) & output.visible).any()
    homogeneous = torch.nn.functional.pad(scene.gaussians.means, (0, 1), value=1.0)
    depths = homogeneous @ scene.cameras.world_to_camera[:, 2].T
    assert (depths < NEAR).any()
    assert output.alpha.min() < 0.1
    assert output.alpha.max() > 0.99


# -------------------------------------------------------------------------- mistakes


@pytest.mark.parametrize("field", FIELDS)
def test_a_gradient_that_is_a_thousandth_too_large_is_noticed(field):
    agreement = self_test(bent_gradient(field, lambda grad: grad * 1.001), CPU)
    assert not agreement.holds
    assert agreement.gradients[field] == pytest.approx(1e-3, rel=0.01)
    assert agreement.worst_image <= OWN.images


@pytest.mark.parametrize("bend", [lambda grad: grad * math.nan, lambda grad: grad / 0, torch.zeros_like])
def test_a_gradient_that_is_zero_or_not_finite_is_noticed(bend):
    agreement = self_test(bent_gradient("opacity_logits", bend), CPU)
    assert not agreement.holds
    assert agreement.worst_gradient >= 1


@pytest.mark.parametrize("bend", [lambda grad: grad * 1.001, torch.zeros_like, None])
def test_an_absgrad_that_is_wrong_or_missing_is_noticed(bend):
    def after(output):
        if output.absgrad is None:
            return output
        if bend is None:
            return replace(output, absgrad=None)
        output.absgrad.register_hook(bend)
        return output

    agreement = self_test(Bent(after=after), CPU)
    assert not agreement.holds
    assert max(agreement.gradients, key=agreement.gradients.get) == "absgrad"


@pytest.mark.parametrize(
    "after",
    [
        lambda output: replace(output, rgb=output.rgb.flip(0)),
        lambda output: replace(output, alpha=output.alpha.roll(1, dims=2)),
        lambda output: replace(output, depth=output.depth * 1.0001),
        lambda output: replace(output, radii=output.radii + 0.01),
        lambda output: replace(output, rgb=output.rgb * math.nan),
    ],
    ids=["views swapped", "pixels shifted", "depth", "radii", "not a number"],
)
def test_a_wrong_image_is_noticed(after):
    assert not self_test(Bent(after=after), CPU).holds


def test_the_scene_for_gsplat_comes_near_no_cap_and_still_stops_pixels():
    scene = make_scene(GSPLAT.most_opacity)
    assert scene.gaussians.opacities.max() == pytest.approx(0.98)
    output = ReferenceRasterizer().render(scene.gaussians, scene.cameras, scene.background)
    assert output.alpha.max() > 0.999
    capped = replace(scene.gaussians, opacity_logits=make_scene().gaussians.opacity_logits)
    other = ReferenceRasterizer().render(capped, scene.cameras, scene.background)
    assert (output.alpha - other.alpha).abs().max() > 1e-3


def test_bits_that_differ_from_run_to_run_are_noticed():
    runs = []

    def after(output):
        runs.append(1)
        return replace(output, alpha=output.alpha * (1 + 1e-6 * len(runs)))

    agreement = self_test(Bent(after=after), CPU)
    assert agreement.holds
    assert not agreement.repeats
    assert not agreement.passes
    assert replace(agreement, demands=GSPLAT).passes
    assert str(agreement).endswith("; different bits the second time")
