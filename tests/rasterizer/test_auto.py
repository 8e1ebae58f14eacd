"""The automatic choice: compiled kernels that pass their tests, or else what works, and a reason."""

from dataclasses import dataclass, replace

import pytest
import torch

from cadam3d.commands import messages
from cadam3d.compiled.library import find_compiler
from cadam3d.core.cameras import turntable
from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.rasterizer import auto, gsplat
from cadam3d.rasterizer.auto import AutoRasterizer, choose, require_agreement
from cadam3d.rasterizer.base import Backend
from cadam3d.rasterizer.cuda import CudaRasterizer
from cadam3d.rasterizer.gsplat import GsplatRasterizer
from cadam3d.rasterizer.reference import ReferenceRasterizer
from cadam3d.rasterizer.selftest import GSPLAT, OWN, self_test

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
    monkeypatch.setattr(auto, "FASTEST", {"cpu": [(Flat(), None)]})
    assert AutoRasterizer().prepare(CPU) == Backend("flat", reason=None)
    assert brightest(AutoRasterizer()) == 0


def test_the_reference_is_the_fallback_and_gives_the_reason(monkeypatch):
    monkeypatch.setattr(auto, "FASTEST", {"cpu": [(Refusing(), None)]})
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

    monkeypatch.setattr(auto, "FASTEST", {"cpu": [(Ahead(), None)]})
    cameras = turntable(1, elevation_deg=0.0, distance=2.0, fov_y_deg=40.0, size=8)
    arguments = a_ball(), cameras, torch.zeros(1, 3)
    assert AutoRasterizer().render_ahead(*arguments).overflowed
    assert AutoRasterizer().render(*arguments).overflowed is None


# -------------------------------------------------------------------------- the gate before CUDA


@pytest.fixture
def a_gpu(monkeypatch):
    """Fake a CUDA device on which our kernels load; the test provides the self-test's result.

    gsplat is not installed.
    """
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 0)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: "a GPU")
    monkeypatch.setattr(torch.cuda, "synchronize", lambda device: None)
    monkeypatch.setattr(CudaRasterizer, "prepare", lambda self, device: Backend("cuda"))
    monkeypatch.setattr(gsplat, "find_spec", lambda name: None)

    def behave(test):
        def counted(rasterizer, device, demands):
            tested.append((rasterizer, device, demands))
            return test()

        tested = []
        monkeypatch.setattr(auto, "self_test", counted)
        return tested

    return behave


@pytest.fixture(scope="module")
def agreement():
    return self_test(ReferenceRasterizer(), CPU)


def raising(error):
    def test():
        raise error

    return test


def test_cuda_kernels_that_pass_the_self_test_are_used_and_tested_once(a_gpu, agreement):
    tested = a_gpu(lambda: agreement)
    for device in (GPU, torch.device("cuda"), GPU):  # two names of one device
        assert choose(device).backend == Backend("cuda", reason=None)
    assert tested == [(CudaRasterizer(cache_dir=None), GPU, OWN)]


@pytest.mark.parametrize(
    "change", [{"gradients": {"means": 0.5}}, {"images": {"rgb": 0.5}}, {"repeats": False}]
)
def test_cuda_kernels_that_fail_the_self_test_are_not_used(change, a_gpu, agreement):
    a_gpu(lambda: replace(agreement, **change))
    backend = choose(GPU).backend
    assert backend.name == "reference"
    assert "rasterizer=cuda fails its self-test on a GPU: " in backend.reason
    assert "\n" not in backend.reason


# -------------------------------------------------------------------------- gsplat, if ours do not work


@pytest.fixture
def with_gsplat(a_gpu, monkeypatch):
    """Install gsplat, and return a function that sets the result of each rasterizer's self-test."""
    monkeypatch.setattr(GsplatRasterizer, "prepare", lambda self, device: Backend("gsplat"))

    def behave(**tests):
        def test(rasterizer, device, demands):
            name = rasterizer.prepare(device).name
            tested.append((name, demands))
            return replace(tests[name](), demands=demands)

        tested = []
        monkeypatch.setattr(auto, "self_test", test)
        return tested

    return behave


def test_gsplat_replaces_kernels_that_fail_and_one_note_tells_which_and_why(with_gsplat, agreement, capsys):
    bad, unordered = replace(agreement, gradients={"means": 0.5}), replace(agreement, repeats=False)
    tested = with_gsplat(cuda=lambda: bad, gsplat=lambda: unordered)
    choice = choose(GPU)
    assert choice.rasterizer == GsplatRasterizer()
    assert choice.backend.name == "gsplat"
    assert tested == [("cuda", OWN), ("gsplat", GSPLAT)]
    messages.note.cache_clear()
    messages.note_backend(choice.backend)
    note = capsys.readouterr().err
    assert note.startswith(
        "Note: rendering with rasterizer=gsplat: rasterizer=cuda fails its self-test on a GPU: disagrees"
    )
    assert note.endswith(" Try: cadam3d doctor\n")
    assert note.count("\n") == note.count(" Try: ") == 1


def test_gsplat_must_pass_its_self_test_too(with_gsplat, agreement):
    bad = replace(agreement, images={"rgb": 0.5})
    with_gsplat(cuda=raising(RuntimeError("no kernel image")), gsplat=lambda: bad)
    backend = choose(GPU).backend
    assert backend.name == "reference"
    assert "rasterizer=cuda fails its self-test" in backend.reason
    assert backend.reason.count(" Try: ") == 1


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_the_kernels_pass_the_self_test_on_this_gpu():
    require_agreement(CudaRasterizer(cache_dir=None), GPU, OWN)
