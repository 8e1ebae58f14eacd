"""``cadam3d doctor`` checks the machine, prints hints, and fails only if training would fail."""

import json
import re
import sys
import tomllib
from pathlib import Path

import pytest

from cadam3d.commands import doctor
from cadam3d.commands.finding import Finding, Verdict, attempt

REPOSITORY = Path(__file__).parent.parent.parent


@pytest.fixture(scope="module")
def findings():
    return {finding.topic: finding for finding in doctor.examine()}


def test_this_machine_can_train(findings):
    assert not [finding for finding in findings.values() if finding.verdict is Verdict.BROKEN]


@pytest.mark.parametrize(
    "topic", ["python", "torch", "device", "ffmpeg", "configs", "c++", "nvcc", "diffusers"]
)
def test_doctor_reports_on(topic, findings):
    assert findings[topic].found


def test_every_rasterizer_that_this_machine_supports_is_tested(findings):
    assert findings["rasterizer=reference"].verdict is Verdict.OK
    assert findings["rasterizer=auto"].found.startswith("chooses ")
    assert "kernels for cpu" in findings
    assert "kernels for cuda" in findings


def test_every_prior_is_checked(findings):
    for path in (REPOSITORY / "configs" / "prior").glob("*.yaml"):
        assert f"prior={path.stem}" in findings
    assert findings["prior=shapes"].verdict is Verdict.OK


def test_rasterizers_that_cannot_be_imported_are_one_finding(monkeypatch):
    monkeypatch.setitem(sys.modules, "cadam3d.commands.doctor_kernels", None)
    [finding] = doctor._kernels()
    assert finding.verdict is Verdict.BROKEN
    assert "cadam3d.commands.doctor_kernels" in finding.found


def test_every_dependency_is_checked():
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    declared = {re.match(r"[\w-]+", line).group() for line in project["dependencies"]}
    assert set(doctor.PACKAGES) == declared


def test_a_package_that_does_not_import_is_broken_and_has_a_hint(monkeypatch):
    monkeypatch.setitem(sys.modules, "tqdm", None)
    finding = doctor._package("tqdm")
    assert finding.verdict is Verdict.BROKEN
    assert finding.hint == "Try: pip install --force-reinstall tqdm"


def test_a_torchvision_that_does_not_fit_torch_is_broken(monkeypatch):
    monkeypatch.setattr(doctor.metadata, "version", lambda name: "0.28.0")
    output = "Traceback ...\nRuntimeError: operator torchvision::nms does not exist"
    monkeypatch.setattr(doctor, "_run_program", lambda command: (1, output))
    finding = doctor._torchvision()
    assert finding.verdict is Verdict.BROKEN
    assert "nms does not exist" in finding.found
    assert finding.hint == "Try: pip uninstall torchvision"


def test_no_ffmpeg_is_broken(monkeypatch):
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", "/nowhere/ffmpeg")
    assert attempt("ffmpeg", doctor._ffmpeg, is_needed=True).verdict is Verdict.BROKEN


def test_no_compiler_is_only_a_note():
    assert doctor._compiler("no-such-compiler").verdict is Verdict.NOTE


def test_models_on_disk_are_listed_by_name(monkeypatch, tmp_path):
    (tmp_path / "models--someone--some-model").mkdir()
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path))
    assert doctor._models().found == "someone/some-model"


def test_a_program_that_does_not_end_is_stopped_after_a_while(monkeypatch):
    monkeypatch.setattr(doctor, "SECONDS", 0.1)
    code, output = doctor._run_program([sys.executable, "-c", "import time; time.sleep(30)"])
    assert code == 127
    assert "timed out" in output


def replace_findings(monkeypatch, *findings: Finding) -> None:
    monkeypatch.setattr(doctor, "examine", lambda: iter(findings))


def test_without_problems_the_exit_code_is_0_and_no_file_is_left(monkeypatch, tmp_path, type_line):
    replace_findings(monkeypatch, Finding("torch", Verdict.OK, "2"), Finding("nvcc", Verdict.NOTE, "none"))
    code, out, _ = type_line("doctor")
    assert code == 0
    assert "Ready to train." in out
    assert not list(tmp_path.iterdir())


def test_a_broken_finding_prints_its_hint_and_causes_exit_code_1(monkeypatch, type_line):
    replace_findings(monkeypatch, Finding("torch", Verdict.BROKEN, "gone", "Try: pip install torch"))
    code, out, _ = type_line("doctor")
    assert code == 1
    assert "Try: pip install torch" in out


@pytest.mark.parametrize("word", ["json=true", "--json"])
def test_json_is_one_object_for_other_programs(word, monkeypatch, type_line):
    replace_findings(monkeypatch, Finding("torch", Verdict.BROKEN, "gone", "hint"))
    code, out, _ = type_line("doctor", word)
    report = json.loads(out)
    assert code == 1
    assert report["ok"] is False
    [finding] = report["findings"]
    assert finding == {"topic": "torch", "verdict": "broken", "found": "gone", "hint": "hint"}


def test_python_that_is_too_old_is_broken(monkeypatch):
    monkeypatch.setattr(doctor.sys, "version_info", (3, 10, 0))
    assert doctor._python().verdict is Verdict.BROKEN


def test_a_gpu_that_torch_cannot_use_gets_a_hint(monkeypatch):
    import torch

    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(doctor.shutil, "which", lambda name: f"/usr/bin/{name}")
    monkeypatch.setattr(doctor, "_run_program", lambda command: (0, "GPU 0"))
    finding = doctor._device()
    assert finding.verdict is Verdict.NOTE
    assert "torch cannot use the GPU" in finding.found
    assert finding.hint.startswith("Try: pip install")
