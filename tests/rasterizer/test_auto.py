"""The automatic choice: compiled kernels that pass their tests, or else what works, and a reason."""

from dataclasses import dataclass, replace

import pytest
import torch

from cadam3d.compiled.library import find_compiler
from cadam3d.core.cameras import turntable
from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.rasterizer import auto
from cadam3d.rasterizer.auto import AutoRasterizer, choose, require_agreement
from cadam3d.rasterizer.base import Backend
from cadam3d.rasterizer.cuda import CudaRasterizer
from cadam3d.rasterizer.reference import ReferenceRasterizer
from cadam3d.rasterizer.selftest import self_test

CPU, GPU = torch.device("cpu"), torch.device("cuda", 0)


@dataclass(frozen=True, kw_only=True)
class Flat(ReferenceRasterizer):
    """Renders everything transparent, which shows that it was chosen."""

    def render(self, gaussians, cameras, background, absgrad=False):
        return super().render(gaussians.index(slice(0, 0)), cameras, background, absgrad)


@pytest.fixture(autouse=True)
def _fresh_choice():
    auto._choose.cache_clear()
    yield
    auto._choose.cache_clear()


def a_ball() -> Gaussians:
    return Gaussians(
        means=torch.zeros(1, 3),
        log_scales=torch.full((1, 3), -1.0),
        quats=torch.tensor([[1.0, 0, 0, 0]]),
        opacity_logits=torch.ones(1),
        sh=torch.ones(1, 1, 3),
    )


def brightest(rasterizer: AutoRasterizer) -> float:
    cameras = turntable(1, elevation_deg=0.0, distance=2.0, fov_y_deg=40.0, size=8)
    return rasterizer.render(a_ball(), cameras, torch.zeros(1, 3)).alpha.max().item()


class Refusing(ReferenceRasterizer):
    def prepare(self, device):
        raise UserError("no compiler. Try: install one")


def test_the_fastest_rasterizer_for_the_device_is_used(monkeypatch):
    monkeypatch.setattr(auto, "FASTEST", {"cpu": Flat()})
    assert AutoRasterizer().prepare(CPU) == Backend("flat", reason=None)
    assert brightest(AutoRasterizer()) == 0


def test_the_reference_is_the_fallback_and_gives_the_reason(monkeypatch):
    monkeypatch.setattr(auto, "FASTEST", {"cpu": Refusing()})
    assert AutoRasterizer().prepare(CPU) == Backend("reference", reason="no compiler. Try: install one")
    assert brightest(AutoRasterizer()) > 0


@pytest.mark.skipif(find_compiler() is None, reason="no C++ compiler")
def test_on_a_cpu_auto_renders_the_images_of_the_native_rasterizer():
    choice = choose(CPU)
    assert choice.backend == Backend("cpu", reason=None)
    cameras = turntable(2, elevation_deg=10.0, distance=2.0, fov_y_deg=40.0, size=8)
    background = torch.rand(2, 3)
    got = AutoRasterizer().render(a_ball(), cameras, background)
    want = choice.rasterizer.render(a_ball(), cameras, background)
    assert torch.equal(got.rgb, want.rgb)
    assert torch.equal(got.depth, want.depth)


def test_auto_also_renders_ahead_with_the_chosen_rasterizer(monkeypatch):
    class Ahead(ReferenceRasterizer):
        def render_ahead(self, gaussians, cameras, background, absgrad=False):
            output = self.render(gaussians, cameras, background, absgrad)
            return replace(output, overflowed=torch.ones((), dtype=torch.bool))

    monkeypatch.setattr(auto, "FASTEST", {"cpu": Ahead()})
    cameras = turntable(1, elevation_deg=0.0, distance=2.0, fov_y_deg=40.0, size=8)
    arguments = a_ball(), cameras, torch.zeros(1, 3)
    assert AutoRasterizer().render_ahead(*arguments).overflowed
    assert AutoRasterizer().render(*arguments).overflowed is None


# -------------------------------------------------------------------------- the gate before CUDA


@pytest.fixture
def a_gpu(monkeypatch):
    """Fake a CUDA device on which our kernels load; the test provides the self-test's result."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 0)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: "a GPU")
    monkeypatch.setattr(CudaRasterizer, "prepare", lambda self, device: Backend("cuda"))

    def behave(test):
        def counted(rasterizer, device):
            tested.append((rasterizer, device))
            return test()

        tested = []
        monkeypatch.setattr(auto, "self_test", counted)
        return tested

    return behave


@pytest.fixture(scope="module")
def agreement():
    return self_test(ReferenceRasterizer(), CPU)


def test_cuda_kernels_that_pass_the_self_test_are_used_and_tested_once(a_gpu, agreement):
    tested = a_gpu(lambda: agreement)
    for device in (GPU, torch.device("cuda"), GPU):  # two names of one device
        assert choose(device).backend == Backend("cuda", reason=None)
    assert tested == [(CudaRasterizer(cache_dir=None), GPU)]


@pytest.mark.parametrize(
    "change", [{"gradients": {"means": 0.5}}, {"images": {"rgb": 0.5}}, {"repeats": False}, None]
)
def test_cuda_kernels_that_fail_the_self_test_are_not_used(change, a_gpu, agreement):
    def test():
        if change is None:
            raise RuntimeError("no kernel image")
        return replace(agreement, **change)

    a_gpu(test)
    backend = choose(GPU).backend
    assert backend.name == "reference"
    assert "rasterizer=cuda fails its self-test on a GPU: " in backend.reason
    assert "\n" not in backend.reason


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_the_kernels_pass_the_self_test_on_this_gpu():
    require_agreement(CudaRasterizer(cache_dir=None), GPU)
