"""The rasterizer checks of ``cadam3d doctor`` test every backend that works and name the missing parts."""

import ctypes
import math
from dataclasses import replace

import pytest
import torch

from cadam3d.commands import doctor_kernels
from cadam3d.commands.doctor_kernels import TRACER, check_kernels
from cadam3d.commands.finding import Finding, Verdict, attempt
from cadam3d.compiled import library
from cadam3d.compiled.library import find_compiler
from cadam3d.io.cache import kernels_dir
from cadam3d.rasterizer import auto, gsplat, nvrtc
from cadam3d.rasterizer.base import Backend
from cadam3d.rasterizer.cpu import cpu_library, load_kernels
from cadam3d.rasterizer.gsplat import GsplatRasterizer
from cadam3d.rasterizer.reference import ReferenceRasterizer
from cadam3d.rasterizer.selftest import ATOMIC, GSPLAT, OWN, Agreement, self_test

needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="no C++ compiler")


def clear_caches() -> None:
    auto._choose.cache_clear()
    load_kernels.cache_clear()


@pytest.fixture(autouse=True)
def empty_caches():
    """Clear the caches of the process before and after each test."""
    clear_caches()
    yield
    clear_caches()


@pytest.fixture
def bare(monkeypatch, tmp_path):
    """Simulate a machine without compilers, compiled kernels and GPUs."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(library, "find_compiler", lambda: None)
    monkeypatch.setattr(nvrtc, "find_compiler", lambda: None)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)


@pytest.fixture(scope="module")
def agreement() -> Agreement:
    return self_test(ReferenceRasterizer(), torch.device("cpu"))


def by_topic() -> dict[str, Finding]:
    return {finding.topic: finding for finding in check_kernels()}


@needs_compiler
def test_the_native_kernels_are_named_and_tested():
    cache = kernels_dir(None)
    found = by_topic()
    kernels, test, choice = (
        found[topic] for topic in ("kernels for cpu", "rasterizer=cpu", "rasterizer=auto")
    )
    assert find_compiler().version in kernels.found
    assert kernels.found.endswith(f" in {cache}")
    assert test.verdict is Verdict.OK
    assert test.found.startswith("agrees with the reference: images ")
    assert test.found.endswith("same bits twice, on cpu")
    assert choice.found.startswith("chooses cpu on cpu")


@needs_compiler
@pytest.mark.parametrize(
    ("seconds", "words"), [(0.0, "from the cache in "), (1.26, "compiled now in 1.3 s, kept in ")]
)
def test_the_finding_states_whether_kernels_were_compiled_now(seconds, words, monkeypatch):
    built = replace(library.build(cpu_library(), kernels_dir(None)), seconds=seconds)
    monkeypatch.setattr(library, "build", lambda library, cache_dir: built)
    assert words in doctor_kernels._cpu_kernels().found


def test_with_nothing_installed_the_reference_is_tested_and_the_rest_is_named_as_missing(bare):
    found = by_topic()
    assert found["rasterizer=reference"].verdict is Verdict.OK
    assert not [finding for finding in found.values() if finding.verdict is Verdict.BROKEN]
    assert "pip install '.[compiler]'" in found["kernels for cpu"].found
    assert "rasterizer=cpu" not in found
    assert found["kernels for cuda"].found == "torch sees no CUDA device; no NVRTC was found"
    choice = found["rasterizer=auto"]
    assert choice.verdict is Verdict.NOTE
    assert choice.found.startswith("chooses reference on cpu: rasterizer=cpu: expected a C++ compiler")


def an_nvrtc() -> nvrtc.Nvrtc:
    return nvrtc.Nvrtc(
        library=ctypes.CDLL(None), path="/there/libnvrtc.so.13", version=(13, 0), architectures=(90,)
    )


@pytest.fixture
def a_gpu(bare, monkeypatch, tmp_path):
    """Simulate one CUDA device, for which the kernels have just been compiled."""
    built = nvrtc.Cubin(tmp_path / "kernels.cubin", 7.0)
    monkeypatch.setattr(nvrtc, "find_compiler", an_nvrtc)
    monkeypatch.setattr(nvrtc, "build", lambda cache_dir, capability: built)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: (9, 0))
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: "a GPU")
    monkeypatch.setattr(auto.AutoRasterizer, "prepare", lambda self, device: Backend("cuda"))


def test_cuda_kernels_are_named_with_device_architecture_compiler_and_time(a_gpu, monkeypatch, agreement):
    monkeypatch.setattr(doctor_kernels, "self_test", lambda rasterizer, device, demands: agreement)
    found = by_topic()
    assert found["kernels for cuda"].found.startswith(
        "sm_90 for a GPU (compute capability 9.0) by NVRTC 13.0 in /there/libnvrtc.so.13, compiled now in 7.0"
    )
    assert found["rasterizer=cuda"].verdict is Verdict.OK
    assert found["rasterizer=cuda"].found == f"{agreement}, on cuda:0"
    assert found["rasterizer=auto"].found == "chooses cuda on cuda:0: the fastest there is, and it works"


def test_gsplat_is_tested_on_a_gpu_with_its_own_demands(a_gpu, monkeypatch, agreement):
    monkeypatch.setattr(GsplatRasterizer, "prepare", lambda self, device: Backend("gsplat"))
    monkeypatch.setattr(doctor_kernels, "version", lambda name: "1.5.3")
    monkeypatch.setattr(
        doctor_kernels,
        "self_test",
        lambda rasterizer, device, demands: replace(
            agreement, demands=demands, repeats=demands is not GSPLAT
        ),
    )
    found = by_topic()
    assert found["kernels for gsplat"].found.startswith("gsplat 1.5.3 for a GPU, loaded in ")
    assert found["rasterizer=gsplat"].verdict is Verdict.OK
    assert found["rasterizer=gsplat"].found.endswith("different bits the second time, on cuda:0")


def test_a_gpu_without_gsplat_gets_the_command_that_installs_it(a_gpu, monkeypatch, agreement):
    monkeypatch.setattr(doctor_kernels, "self_test", lambda rasterizer, device, demands: agreement)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(gsplat, "find_spec", lambda name: None)
    found = by_topic()
    assert found["kernels for gsplat"].verdict is Verdict.NOTE
    assert found["kernels for gsplat"].found.endswith("Try: pip install '.[gsplat]'")
    assert "rasterizer=gsplat" not in found


@pytest.mark.parametrize(
    ("topic", "device", "change", "verdict"),
    [
        ("rasterizer=cpu", "cpu", {"gradients": {"means": 0.1}}, Verdict.BROKEN),
        ("rasterizer=cpu", "cpu", {"images": {"rgb": math.inf}}, Verdict.BROKEN),
        ("rasterizer=cpu", "cpu", {"repeats": False}, Verdict.BROKEN),
        # Without its self-test, auto chooses another backend.
        ("rasterizer=cuda", "cuda:0", {"repeats": False}, Verdict.NOTE),
        ("rasterizer=gsplat", "cuda:0", {"repeats": False}, Verdict.OK),
        ("rasterizer=gsplat", "cuda:0", {"gradients": {"means": 0.1}}, Verdict.NOTE),
        ("rasterizer=reference", "cpu", {"repeats": False}, Verdict.BROKEN),
        # On a GPU, the sums of the reference use atomics.
        ("rasterizer=reference", "cuda:0", {"repeats": False}, Verdict.OK),
    ],
)
def test_a_failed_self_test_is_reported(topic, device, change, verdict, monkeypatch, agreement):
    monkeypatch.setattr(
        doctor_kernels,
        "self_test",
        lambda rasterizer, device, demands: replace(agreement, demands=demands, **change),
    )
    on_gpu = {"rasterizer=gsplat": GSPLAT, "rasterizer=reference": ATOMIC}
    demands = OWN if device == "cpu" else on_gpu.get(topic, OWN)
    finding = doctor_kernels._tested(topic, ReferenceRasterizer(), torch.device(device), demands)
    assert finding.verdict is verdict
    assert ("report" in finding.hint) is (verdict is not Verdict.OK)


def test_a_self_test_that_crashes_is_a_finding(monkeypatch):
    def crash(rasterizer, device, demands):
        raise RuntimeError("an illegal memory access\nsomewhere")

    monkeypatch.setattr(doctor_kernels, "self_test", crash)
    finding = doctor_kernels._tested("rasterizer=cuda", ReferenceRasterizer(), torch.device("cpu"), OWN)
    assert finding.verdict is Verdict.BROKEN
    assert finding.found == "RuntimeError: an illegal memory access"


@needs_compiler
def test_the_native_tracer_is_named_and_agrees_with_torch():
    finding = attempt(TRACER, doctor_kernels._tracer)
    assert (finding.topic, finding.verdict) == (TRACER, Verdict.OK)
    assert f" by {find_compiler().version}, " in finding.found


@needs_compiler
def test_a_native_tracer_that_draws_something_else_is_broken(monkeypatch):
    trace = doctor_kernels.trace_natively

    def brighter(*case):
        layers = trace(*case)
        return replace(layers, paints=1.01 * layers.paints)

    monkeypatch.setattr(doctor_kernels, "trace_natively", brighter)
    finding = attempt(TRACER, doctor_kernels._tracer)
    assert finding.verdict is Verdict.BROKEN
    assert finding.hint.endswith("use prior.tracer=torch")


def test_without_a_compiler_the_tracer_in_torch_is_named_with_the_reason(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(library, "find_compiler", lambda: None)
    finding = attempt(TRACER, doctor_kernels._tracer)
    assert finding.verdict is Verdict.NOTE
    assert finding.found.startswith("torch, which is slow: prior.tracer=native: expected a C++ compiler")
