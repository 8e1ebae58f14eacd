"""Notes are printed once, and training with slow kernels or a fallback is reported and recorded."""

import json

import pytest

from cadam3d.commands import messages
from cadam3d.core.errors import UserError
from cadam3d.rasterizer import auto, cpu

NEEDED = "rasterizer=cpu needs a C++ compiler. Install one"
SMALL = [
    "prompt=a red cube",
    "experiment=smoke",
    "prior=tiny",
    "device=cpu",
    "steps=1",
    "initializer.count=9",
]
SMALL += ["exporter=[ply]", "metric=[]", "camera.size=16"]


@pytest.fixture(autouse=True)
def empty_caches():
    messages.note.cache_clear()
    auto._choose.cache_clear()
    yield
    messages.note.cache_clear()
    auto._choose.cache_clear()


@pytest.fixture
def no_compiler(monkeypatch):
    def no_kernels(cache_dir):
        raise UserError(NEEDED)

    monkeypatch.setattr(cpu, "load_kernels", no_kernels)


def test_a_note_is_printed_once(capsys):
    messages.note("mind the gap")
    messages.note("mind the gap")
    messages.note("mind the step")
    assert capsys.readouterr().err == "Note: mind the gap\nNote: mind the step\n"


def test_training_without_a_compiler_is_noted_once_and_recorded(type_line, no_compiler, tmp_path):
    code, _, err = type_line("train", *SMALL)
    assert code == 0
    assert err.count(NEEDED) == 1
    assert f"\nNote: rendering with rasterizer=reference: {NEEDED}\n" in err
    assert "Warning" not in err
    run = tmp_path / "outputs/latest"
    summary = json.loads((run / "summary.json").read_text(encoding="utf-8"))
    assert (summary["rasterizer"], summary["backend"], summary["backend_reason"]) == (
        *("auto", "reference"),
        NEEDED,
    )
    assert NEEDED in (run / "report.html").read_text(encoding="utf-8")


def test_another_command_prints_the_note_when_it_renders(type_line, no_compiler):
    assert type_line("train", *SMALL, "rasterizer=reference")[0] == 0
    code, _, err = type_line("export", "run=outputs/latest", "output=copy.ply")
    assert (code, err.count(NEEDED)) == (0, 0)
    code, _, err = type_line("render", "run=outputs/latest", "exporter=[images]", "exporter.images.views=1")
    assert (code, err.count(NEEDED)) == (0, 1)


def test_an_unavailable_rasterizer_is_refused_before_any_file_changes(type_line, no_compiler, tmp_path):
    assert type_line("train", *SMALL, "rasterizer=reference")[0] == 0
    latest = (tmp_path / "outputs/latest").resolve()
    before = sorted(tmp_path.rglob("*"))
    code, _, err = type_line("train", *SMALL, "rasterizer=cpu")
    assert (code, err) == (1, f"cadam3d: {NEEDED}\n")
    assert (tmp_path / "outputs/latest").resolve() == latest
    assert sorted(tmp_path.rglob("*")) == before


SHAP_E = ["rasterizer=reference", "initializer=shap_e", "initializer.path=nowhere"]


def test_an_unavailable_initializer_is_refused_before_any_file_is_written(type_line, tmp_path):
    code, _, err = type_line("train", *SMALL, *SHAP_E)
    assert code == 1
    assert err.startswith("cadam3d: initializer.path: expected a folder with a model_index.json")
    assert not list(tmp_path.iterdir())


def test_the_fallback_of_an_initializer_is_reported_and_recorded(type_line, tmp_path):
    stand_in = ["initializer/fallback=ball", "initializer.fallback.count=9"]
    code, _, err = type_line("train", *SMALL, *SHAP_E, *stand_in, "hydra.run.dir=fallen")
    assert code == 0
    [line] = [line for line in err.splitlines() if "Shap-E" in line]
    assert line.startswith("Note: Ball is used instead of Shap-E. initializer.path: expected a folder")
    summary = json.loads((tmp_path / "fallen/summary.json").read_text(encoding="utf-8"))
    assert summary["initializer"] == "shap_e"
    assert f"Note: {summary['initializer_note']}" == line
    assert "Ball is used instead of Shap-E" in (tmp_path / "fallen/report.html").read_text(encoding="utf-8")

    assert type_line("train", *SMALL, "rasterizer=reference", "hydra.run.dir=asked")[0] == 0
    fallen, asked = ((tmp_path / run / "asset.ply").read_bytes() for run in ("fallen", "asked"))
    assert fallen == asked
    assert "initializer_note" not in (tmp_path / "asked/summary.json").read_text(encoding="utf-8")
