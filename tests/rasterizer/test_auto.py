"""The automatic choice: the first backend that works on the device, asked once, and then simply used."""

from dataclasses import dataclass

import pytest
import torch

from cadam3d.core.cameras import turntable
from cadam3d.core.checks import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.rasterizer import auto
from cadam3d.rasterizer.auto import AutoRasterizer, Candidate
from cadam3d.rasterizer.reference import ReferenceRasterizer

CPU, META = torch.device("cpu"), torch.device("meta")


@dataclass(frozen=True, kw_only=True)
class Flat(ReferenceRasterizer):
    """Shows that it was chosen: everything is transparent."""

    def render(self, gaussians, cameras, background):
        return super().render(gaussians.index(slice(0, 0)), cameras, background)


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


def test_the_first_candidate_that_works_on_the_device_renders(monkeypatch):
    candidates = (
        Candidate("elsewhere", lambda device: device.type == "meta", Flat),
        Candidate("flat", lambda device: True, Flat),
        Candidate("reference", lambda device: True, ReferenceRasterizer),
    )
    monkeypatch.setattr(auto, "CANDIDATES", candidates)
    assert AutoRasterizer().chosen(CPU) == "flat"
    assert AutoRasterizer().chosen(META) == "elsewhere"
    assert brightest(AutoRasterizer()) == 0


def test_a_backend_is_asked_and_built_once(monkeypatch):
    asked, built = [], []

    def works_on(device: torch.device) -> bool:
        asked.append(device)
        return True

    def build() -> ReferenceRasterizer:
        built.append(1)
        return ReferenceRasterizer()

    monkeypatch.setattr(auto, "CANDIDATES", (Candidate("counted", works_on, build),))
    assert brightest(AutoRasterizer()) > 0
    assert brightest(AutoRasterizer()) > 0
    assert AutoRasterizer().chosen(CPU) == "counted"
    assert asked == [CPU]
    assert built == [1]


def test_nothing_is_asked_before_the_first_render(monkeypatch):
    def works_on(device: torch.device) -> bool:
        raise AssertionError("asked too early")

    monkeypatch.setattr(auto, "CANDIDATES", (Candidate("eager", works_on, Flat),))
    AutoRasterizer()


@pytest.mark.parametrize("device", ["cpu", "cuda", "mps", "meta"])
def test_there_is_a_backend_for_every_device(device):
    assert auto.CANDIDATES[-1].works_on(torch.device(device))
    assert AutoRasterizer().chosen(torch.device(device)) in {candidate.name for candidate in auto.CANDIDATES}


def test_what_auto_shows_is_what_its_choice_shows():
    chosen = AutoRasterizer().chosen(CPU)
    candidate = next(candidate for candidate in auto.CANDIDATES if candidate.name == chosen)
    cameras = turntable(2, elevation_deg=10.0, distance=2.0, fov_y_deg=40.0, size=8)
    background = torch.rand(2, 3)
    got = AutoRasterizer().render(a_ball(), cameras, background)
    want = candidate.build().render(a_ball(), cameras, background)
    assert torch.equal(got.rgb, want.rgb)
    assert torch.equal(got.depth, want.depth)


def test_a_cuda_device_that_cannot_be_served_gets_the_reference_and_a_warning(monkeypatch):
    def fail(device: torch.device) -> bool:
        raise UserError("rasterizer=cuda found no NVRTC")

    monkeypatch.setattr(auto.cuda, "works_on", fail)
    with pytest.warns(UserWarning, match="slow reference rasterizer, for rasterizer=cuda found no NVRTC"):
        assert AutoRasterizer().chosen(torch.device("cuda")) == "reference"


def test_a_cuda_device_that_works_gets_the_cuda_kernels(monkeypatch):
    monkeypatch.setattr(auto.cuda, "works_on", lambda device: device.type == "cuda")
    assert AutoRasterizer().chosen(torch.device("cuda")) == "cuda"
    assert AutoRasterizer().chosen(CPU) != "cuda"
