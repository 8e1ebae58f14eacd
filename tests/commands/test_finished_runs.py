"""The commands render, export, eval and view, with a run folder, a sweep folder or a single file."""

import json
from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf

from cadam3d.commands import view
from cadam3d.core.gaussians import Gaussians
from cadam3d.io.jsonl import read_json
from cadam3d.io.ply import read_ply, write_ply
from cadam3d.settings.compose import compose
from cadam3d.sweep.folder import Plan, PlannedJob, write_plan

SMALL = ("metric.fidelity.views=2", "metric.fidelity.elevations_deg=[0]", "metric.fidelity.size=24")


@pytest.fixture
def gaussians() -> Gaussians:
    draw = torch.Generator().manual_seed(0)
    return Gaussians(
        means=torch.randn(6, 3, generator=draw) * 0.3,
        log_scales=torch.full((6, 3), -1.5),
        quats=torch.randn(6, 4, generator=draw),
        opacity_logits=torch.randn(6, generator=draw),
        sh=torch.randn(6, 1, 3, generator=draw),
    )


def make_run(folder: Path, gaussians: Gaussians, *overrides: str) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    cfg = compose(["prompt=a red cube", "rasterizer=reference", *overrides])
    (folder / "config.yaml").write_text(OmegaConf.to_yaml(cfg, resolve=True), encoding="utf-8")
    write_ply(folder / "asset.ply", gaussians, up="-y", pad_sh=0)
    return folder


@pytest.fixture
def run_folder(tmp_path, gaussians) -> Path:
    return make_run(tmp_path / "a run", gaussians)


@pytest.mark.parametrize("command", ["render", "export", "view"])
@pytest.mark.parametrize(("words", "got"), [((), "neither"), (("run=a", "ply=b"), "both")])
def test_exactly_one_asset_must_be_named(command, words, got, type_line):
    code, _, err = type_line(command, *words)
    assert (code, err) == (
        1,
        f'cadam3d: run, ply: expected one of them, got {got}. Try: cadam3d train prompt="a red torus"\n',
    )


@pytest.mark.parametrize("command", ["render", "export", "view", "eval"])
def test_a_folder_without_a_run_is_named(command, type_line, tmp_path):
    (tmp_path / "empty").mkdir()
    for place, reason in (("nowhere", "no such folder"), ("empty", "it has no config.yaml")):
        code, _, err = type_line(command, f"run={place}")
        assert code == 1
        assert err.startswith(f"cadam3d: run: expected the folder of a run, got {place!r} ({reason}). Try: ")


def test_the_message_for_a_run_without_an_asset_suggests_finishing_it(run_folder, type_line):
    (run_folder / "asset.ply").unlink()
    code, _, err = type_line("render", f"run={run_folder}")
    assert code == 1
    assert "has no asset.ply yet. Try: cadam3d train 'resume=a run'" in err


def test_a_broken_file_is_one_message(type_line, tmp_path):
    (tmp_path / "broken.ply").write_bytes(b"ply\nnot really")
    code, _, err = type_line("render", "ply=broken.ply")
    assert code == 1
    assert len(err.splitlines()) == 1
    assert "broken.ply" in err


def test_render_writes_numbered_images_and_nothing_else(run_folder, type_line, tmp_path):
    words = ("exporter=[images]", "exporter.images.size=16", "exporter.images.views=3")
    code, out, _ = type_line("render", f"run={run_folder}", *words, "exporter.images.elevations_deg=[0,30]")
    assert code == 0
    names = sorted(path.name for path in (run_folder / "render/images").iterdir())
    assert names[:2] == ["000_az000_el+00.png", "001_az120_el+00.png"]
    assert len(names) == 6
    assert "6 files of 6 Gaussians" in out
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a run"]


def test_render_accepts_a_file_and_an_output_folder(run_folder, type_line, tmp_path):
    (run_folder / "asset.ply").rename(tmp_path / "thing.ply")
    words = ("exporter=[images]", "exporter.images.size=16", "exporter.images.views=1")
    assert type_line("render", "ply=thing.ply", "output=some (pictures)", *words)[0] == 0
    assert len(list((tmp_path / "some (pictures)/images").iterdir())) == 1


def test_the_message_of_render_without_an_exporter_suggests_some(run_folder, type_line):
    code, _, err = type_line("render", f"run={run_folder}", "exporter=[]")
    assert code == 1
    assert "Try: exporter=[images,turntable]" in err


def test_export_names_its_file_and_turns_its_axes(run_folder, gaussians, type_line, tmp_path):
    code, out, _ = type_line("export", f"run={run_folder}", "output=deep/thing.ply", "exporter.ply.up=+y")
    assert code == 0
    assert out.startswith("deep/thing.ply")
    assert b"asset" not in (tmp_path / "deep/thing.ply").read_bytes()[:64]
    again = read_ply(tmp_path / "deep/thing.ply")
    torch.testing.assert_close(again.means, gaussians.means)
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["thing.ply"]


def test_export_without_output_leaves_the_asset_of_the_run_alone(run_folder, type_line):
    before = (run_folder / "asset.ply").read_bytes()
    assert type_line("export", f"run={run_folder}", "exporter.ply.pad_sh=3")[0] == 0
    assert (run_folder / "asset.ply").read_bytes() == before
    assert len((run_folder / "export/asset.ply").read_bytes()) > len(before)


def test_export_to_an_unknown_format_lists_those_that_exist(run_folder, type_line):
    code, _, err = type_line("export", f"run={run_folder}", "exporter=[splat]")
    assert code == 1
    assert "images|ply|preview|turntable" in err
    code, _, err = type_line("export", f"run={run_folder}", "output=thing.obj")
    assert code == 1
    assert "suffix .ply" in err


def test_eval_measures_against_the_truth_of_the_shapes_prior(run_folder, type_line):
    code, out, _ = type_line("eval", f"run={run_folder}", *SMALL)
    assert code == 0
    result = read_json(run_folder / "eval.json")
    assert 0 < result["psnr"] < 40
    assert -1 <= result["ssim"] <= 1
    assert result["num_gaussians"] == 6
    assert result["asset_bytes"] == (run_folder / "asset.ply").stat().st_size
    assert "psnr" in out


def test_eval_notes_which_numbers_are_missing_without_true_images(tmp_path, gaussians, type_line):
    folder = make_run(tmp_path / "run", gaussians, "prior=tiny")
    code, out, _ = type_line("eval", f"run={folder}", *SMALL)
    result = read_json(folder / "eval.json")
    assert code == 0
    assert "psnr" not in result
    assert result["num_gaussians"] == 6
    assert "has no true images" in out


def make_sweep(folder: Path, *names: str) -> Path:
    folder.mkdir()
    jobs = [PlannedJob("", name, [], {}) for name in names]
    write_plan(folder, Plan(cwd=str(folder), flags=[], threads=None, jobs=jobs))
    return folder


def test_eval_of_a_sweep_measures_every_job_and_reports_those_that_fail(tmp_path, gaussians, type_line):
    sweep = make_sweep(tmp_path / "sweep", "b", "a", "never-started", "c")
    for name in ("a", "b", "c", "of-another-sweep"):
        make_run(sweep / name, gaussians)
    (sweep / "a/asset.ply").unlink()
    code, _, err = type_line("eval", "run=sweep", *SMALL)
    assert code == 0
    results = read_json(sweep / "eval.json")
    assert [Path(result["run"]).name for result in results] == ["b", "a", "never-started", "c"]
    assert ["psnr" in result for result in results] == [True, False, False, True]
    assert "cadam3d: a: " in err
    assert "cadam3d: never-started: " in err
    assert (sweep / "c/eval.json").is_file()


def test_eval_of_a_sweep_without_any_asset_fails(tmp_path, type_line):
    make_sweep(tmp_path / "sweep", "a")
    assert type_line("eval", "run=sweep")[0] == 1


def test_other_commands_suggest_a_job_of_a_sweep(tmp_path, gaussians, type_line):
    make_run(make_sweep(tmp_path / "sweep", "0_job") / "0_job", gaussians)
    code, _, err = type_line("render", "run=sweep")
    assert code == 1
    assert "it is a sweep, which has many runs). Try: run=sweep/0_job" in err


def test_view_shows_the_report_of_a_run(run_folder, type_line, monkeypatch):
    (run_folder / "report.html").write_text("<p>report</p>", encoding="utf-8")
    opened = []
    monkeypatch.setattr(view, "has_display", lambda: True)
    monkeypatch.setattr("webbrowser.open", lambda address: opened.append(address) or True)
    code, out, _ = type_line("view", f"run={run_folder}")
    assert code == 0
    assert opened == [(run_folder / "report.html").as_uri()]
    assert out.startswith("Opened a run/report.html\n")


def test_view_without_a_display_prints_the_path_and_opens_nothing(run_folder, type_line, monkeypatch):
    (run_folder / "report.html").touch()
    monkeypatch.setattr(view, "has_display", lambda: False)
    monkeypatch.setattr("webbrowser.open", lambda address: pytest.fail("a browser was started"))
    code, out, _ = type_line("view", f"run={run_folder}")
    assert code == 0
    assert "Open this in a browser: a run/report.html" in out
    assert "no live viewer" in out


def test_view_of_a_file_makes_a_picture(run_folder, type_line, tmp_path):
    (run_folder / "asset.ply").rename(tmp_path / "thing.ply")
    words = ("browser=false", "exporter.preview.size=16", "exporter.preview.views=2")
    code, out, _ = type_line("view", "ply=thing.ply", *words)
    assert code == 0
    assert (tmp_path / "thing/view/preview.png").stat().st_size > 0
    assert "thing/view/preview.png" in out


def test_the_json_of_eval_is_strict(run_folder, type_line):
    type_line("eval", f"run={run_folder}", *SMALL)
    text = (run_folder / "eval.json").read_text(encoding="utf-8")
    assert json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
