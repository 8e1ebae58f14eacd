"""``cadam3d doctor`` checks the machine, prints hints, and fails only if training would fail."""

import json
import math
import sys
from dataclasses import replace
from functools import partial

import pytest
import torch

from cadam3d.commands import doctor
from cadam3d.commands.doctor import BROKEN, NOTE, OK, Finding, attempt
from cadam3d.compiled import library
from cadam3d.rasterizer import auto, gsplat, nvrtc
from cadam3d.rasterizer.base import Backend, Rasterizer
from cadam3d.rasterizer.cpu import load_kernels
from cadam3d.rasterizer.reference import ReferenceRasterizer
from cadam3d.rasterizer.selftest import ATOMIC, GSPLAT, OWN, self_test
from cadam3d.settings.options import option_names

needs_compiler = pytest.mark.skipif(library.find_compiler() is None, reason="no C++ compiler")


@pytest.fixture(scope="module")
def findings():
    # The imports behind some priors take many seconds.
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(doctor, "check_prior", lambda name: Finding(f"prior={name}", OK, "ready"))
        return {finding.topic: finding for finding in doctor.examine()}


@pytest.fixture(scope="module")
def agreement():
    return self_test(ReferenceRasterizer(), torch.device("cpu"))


@pytest.fixture
def bare(monkeypatch, tmp_path):
    """Simulate a machine without compilers, compiled kernels and GPUs."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(library, "find_compiler", lambda: None)
    monkeypatch.setattr(nvrtc, "find_compiler", lambda: None)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    for cached in (auto._choose, load_kernels):
        cached.cache_clear()
    yield
    for cached in (auto._choose, load_kernels):
        cached.cache_clear()


def test_this_machine_can_train_and_everything_is_examined(findings):
    assert not [finding for finding in findings.values() if finding.verdict == BROKEN]
    assert {"python", "torch", "device", "ffmpeg", "configs", "compilers", "rasterizer=cpu"} <= set(findings)
    assert findings["rasterizer=reference"].verdict == OK
    assert findings["rasterizer=auto"].found.startswith("chooses ")
    for name in option_names("prior"):
        assert f"prior={name}" in findings
    assert doctor.check_prior("shapes").verdict == OK


@needs_compiler
def test_the_native_kernels_agree_with_the_reference(findings):
    assert findings["compilers"].found.startswith(library.find_compiler().version)
    assert findings["rasterizer=cpu"].found.startswith("agrees with the reference: images ")
    assert findings["prior.tracer=auto"].verdict == OK


def test_a_package_that_does_not_import_is_broken_and_has_a_hint(monkeypatch):
    monkeypatch.setitem(sys.modules, "tqdm", None)
    monkeypatch.setattr(doctor, "dependencies", lambda: ["tqdm"])
    finding = next(each for each in doctor.examine() if each.topic == "tqdm")
    assert finding.verdict == BROKEN
    assert finding.hint == "Try: pip install --force-reinstall tqdm"


def test_a_gpu_that_torch_cannot_use_gets_a_hint(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(doctor.shutil, "which", lambda name: "/bin/true")
    monkeypatch.setattr(doctor.subprocess, "run", lambda command, **_: replace_code(0))
    finding = attempt("device", doctor.check_device)
    assert finding.verdict == NOTE
    assert finding.hint.startswith("Try: pip install")


def replace_code(code):
    return doctor.subprocess.CompletedProcess([], code)


def test_with_nothing_installed_the_reference_is_tested_and_the_rest_is_named_as_missing(bare):
    found = {finding.topic: finding for finding in doctor.check_rasterizers()}
    assert found["rasterizer=reference"].verdict == OK
    assert found["rasterizer=cpu"].verdict == NOTE
    assert "pip install '.[compiler]'" in found["rasterizer=cpu"].found
    assert found["rasterizer=auto"].found.startswith(
        "chooses reference on cpu: rasterizer=cpu: expected a C++"
    )
    assert attempt("prior.tracer=auto", doctor.check_tracer).verdict == NOTE
    assert attempt("compilers", doctor.check_compilers).verdict == NOTE


def test_a_gpu_without_gsplat_gets_the_command_that_installs_it(bare, monkeypatch, agreement):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(doctor.CudaRasterizer, "prepare", lambda self, device: Backend("cuda"))
    monkeypatch.setattr(doctor.AutoRasterizer, "prepare", lambda self, device: Backend("cuda"))
    monkeypatch.setattr(gsplat, "find_spec", lambda name: None)
    monkeypatch.setattr(doctor, "self_test", lambda *_: agreement)
    found = {finding.topic: finding for finding in doctor.check_rasterizers()}
    assert found["rasterizer=cuda"].found == f"{agreement}, on cuda:0"
    assert found["rasterizer=gsplat"].verdict == NOTE
    assert found["rasterizer=gsplat"].found.endswith("Try: pip install '.[gsplat]'")


class Prepared(ReferenceRasterizer):
    """A rasterizer that is ready on every device."""

    def prepare(self, device):
        """Return a name."""
        return Backend("prepared")


@pytest.mark.parametrize(
    ("topic", "demands", "change", "verdict"),
    [
        ("cpu", OWN, {"gradients": {"means": 0.1}}, BROKEN),
        ("cpu", OWN, {"images": {"rgb": math.inf}}, BROKEN),
        ("cpu", OWN, {"repeats": False}, BROKEN),
        # Without its self-test, auto chooses another backend.
        ("cuda", OWN, {"repeats": False}, NOTE),
        ("gsplat", GSPLAT, {"repeats": False}, OK),
        ("gsplat", GSPLAT, {"gradients": {"means": 0.1}}, NOTE),
        # On a GPU, the sums of the reference use atomics.
        ("reference", ATOMIC, {"repeats": False}, OK),
    ],
)
def test_a_failed_self_test_is_reported(topic, demands, change, verdict, monkeypatch, agreement):
    monkeypatch.setattr(doctor, "self_test", lambda *_: replace(agreement, demands=demands, **change))
    check = partial(doctor.check_rasterizer, topic, Prepared(), torch.device("cpu"), demands)
    finding = attempt(topic, check)
    assert finding.verdict == verdict
    assert ("report" in finding.hint) is (verdict != OK)


def test_a_self_test_that_crashes_is_a_finding():
    class Crashing(Rasterizer):
        def render(self, *_):
            raise RuntimeError("an illegal memory access\nsomewhere")

    finding = attempt(
        "rasterizer=cuda",
        lambda: doctor.check_rasterizer("cuda", Crashing(), torch.device("cpu"), OWN),
    )
    assert finding.verdict == BROKEN
    assert finding.found == "RuntimeError: an illegal memory access"


def replace_findings(monkeypatch, *findings: Finding) -> None:
    monkeypatch.setattr(doctor, "examine", lambda: iter(findings))


def test_without_problems_the_exit_code_is_0_and_no_file_is_left(monkeypatch, tmp_path, type_line):
    replace_findings(monkeypatch, Finding("torch", OK, "2"), Finding("nvcc", NOTE, "none"))
    code, out, _ = type_line("doctor")
    assert code == 0
    assert "Ready to train." in out
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("word", ["json=true", "--json"])
def test_a_broken_finding_causes_exit_code_1_and_json_is_one_object(word, monkeypatch, type_line):
    replace_findings(monkeypatch, Finding("torch", BROKEN, "gone", "hint"))
    code, out, _ = type_line("doctor", word)
    report = json.loads(out)
    assert code == 1
    assert report["ok"] is False
    [finding] = report["findings"]
    assert finding == {"topic": "torch", "verdict": "broken", "found": "gone", "hint": "hint"}
