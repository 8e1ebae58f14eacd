"""A run on any prior may name a truth, in training, in eval and in sweeps."""

import shutil
from pathlib import Path

import pytest
from composed import as_yaml
from splats import make_gaussians

from cadam3d.io.jsonl import read_json, write_json
from cadam3d.io.ply import write_ply
from cadam3d.metric import turn
from cadam3d.sweep.folder import Job, Plan, write_plan

EYES = ["metric.fidelity.views=2", "metric.fidelity.elevations_deg=[0]", "metric.fidelity.size=24"]
EYES += ["metric.outline.views=2", "metric.outline.elevations_deg=[0]", "metric.outline.size=24"]
SMALL = ["prompt=a red mug", "prior=tiny", "rasterizer=auto", "camera.size=8", "views=1", *EYES]
SMALL += [
    "initializer.count=7",
    "initializer.opacity=0.9",
    "callback=[checkpoint]",
    "exporter=[ply]",
    "hydra.run.dir=run",
]
SMALL += ["initializer.scale=0.3"]
AT_TURN = {"psnr_turned", "ssim_turned", "turn_deg", "psnr_start", "iou", "iou_start", "colour_error"}
QUALITY = {"psnr", "psnr_min", "ssim", "mode", *AT_TURN}


@pytest.fixture(autouse=True)
def small_pictures(monkeypatch):
    monkeypatch.setattr(turn, "SIZE", 16)
    monkeypatch.setattr(turn, "ELEVATIONS_DEG", (20.0,))


def quality(file: Path) -> dict[str, float]:
    return {name: value for name, value in read_json(file).items() if name in QUALITY}


def make_run(folder: Path, *overrides: str) -> Path:
    folder.mkdir(parents=True)
    settings = as_yaml("prompt=a red mug", "rasterizer=auto", "initializer.count=7", *overrides)
    (folder / "config.yaml").write_text(settings, encoding="utf-8")
    write_ply(folder / "asset.ply", make_gaussians(6, spread=0.3), up="-y", pad_sh=0)
    return folder


def test_a_prompt_of_another_world_is_refused_before_the_folder_exists(type_line, tmp_path):
    line = [word for word in SMALL if not word.startswith("prompt=")]
    message = type_line("train", *line, "prompt=a corgi", "truth=shapes", "steps=1").message
    assert message.startswith("truth: expected a prompt of the embedded world")
    assert message.endswith("Try: truth=prior")
    assert not list(tmp_path.iterdir())


def test_training_and_eval_and_a_resumed_run_measure_the_same(type_line, tmp_path):
    """The numbers come from the asset and from the start of the run, whichever command measures them."""
    steps = ["callback.checkpoint.every=2"]
    assert type_line("train", *SMALL, *steps, "truth=shapes", "steps=4").code == 0
    folder = tmp_path / "run"
    measured = quality(folder / "summary.json")
    assert measured.keys() == QUALITY
    assert read_json(folder / "summary.json")["truth"] == "shapes"
    assert "Overlap of the outlines" in (folder / "report.html").read_text(encoding="utf-8")

    evaluate = ("eval", "run=run", *EYES)
    assert type_line(*evaluate).code == 0
    assert quality(folder / "eval.json") == pytest.approx(measured)

    max((folder / "checkpoints").iterdir()).unlink()
    assert type_line("train", "resume=run").code == 0
    assert quality(folder / "summary.json") == pytest.approx(measured)


def test_the_exact_prior_has_the_same_psnr_against_both_truths(type_line, tmp_path):
    folder = make_run(tmp_path / "run")
    found = []
    for words in ((), ("truth=prior",), ("truth=shapes",), ("truth=shapes", "truth.turns=null")):
        assert type_line("eval", "run=run", *EYES, *words).code == 0
        found.append(quality(folder / "eval.json"))
    own, named, shapes, facing_front = found
    assert own == named
    assert own.keys() == QUALITY - AT_TURN
    assert shapes.keys() == QUALITY
    assert facing_front.keys() == QUALITY - {"psnr_turned", "ssim_turned", "turn_deg"}
    for name in own:
        assert own[name] == shapes[name] == facing_front[name]


def test_without_a_truth_nothing_is_compared(type_line, tmp_path):
    folder = make_run(tmp_path / "run", "truth=none")
    for words, is_compared in (((), False), (("truth=prior",), True)):
        assert type_line("eval", "run=run", *EYES, *words).code == 0
        assert bool(quality(folder / "eval.json")) == is_compared


def test_a_start_that_cannot_be_built_costs_only_its_own_number(type_line, tmp_path):
    folder = make_run(tmp_path / "run", "initializer=ply", "initializer.path=gone.ply")
    assert type_line("eval", "run=run", *EYES, "truth=shapes").code == 0
    assert quality(folder / "eval.json").keys() == QUALITY - {"psnr_start", "iou_start"}
    assert "gone.ply" in read_json(folder / "eval.json")["warnings"][0]


def test_eval_of_a_prompt_of_another_world_names_the_truth(type_line, tmp_path):
    make_run(tmp_path / "run", "prompt=a corgi", "prior=tiny")
    message = type_line("eval", "run=run", *EYES, "truth=shapes").message
    assert message.startswith("truth: expected a prompt of the embedded world")


def test_a_folder_cannot_choose_a_truth_that_runs_its_own_code(type_line, tmp_path):
    folder = make_run(tmp_path / "run")
    text = (folder / "config.yaml").read_text(encoding="utf-8")
    evil = text.replace("cadam3d.prior.truth.PriorTruth", "builtins.print")
    assert evil != text
    (folder / "config.yaml").write_text(evil, encoding="utf-8")
    message = type_line("eval", "run=run", *EYES).message
    assert "builtins.print" in message
    assert message.endswith("trust=true")


def test_a_sweep_that_names_no_truth_gets_one_from_eval(type_line, tmp_path):
    """The report then compares the jobs by what eval has measured."""
    sweep = tmp_path / "sweep"
    names = ("cadam", "baseline")
    for name in names:
        make_run(sweep / name, "prior=tiny", f"densifier={name}")
        summary = {
            "outcome": "finished",
            "num_gaussians": 6,
            "prompt": "a red mug",
            "seed": 0,
            "warnings": [],
        }
        write_json(sweep / name / "summary.json", {**summary, "densifier": name})
    jobs = [Job(name, name, [f"densifier={name}"], {}) for name in names]
    write_plan(sweep, Plan(cwd=str(tmp_path), flags=[], threads=None, jobs=jobs, figures=["growth"]))
    result = type_line("eval", "run=sweep", *EYES, "truth=shapes")
    assert result.code == 0
    measured = quality(sweep / "cadam/eval.json")
    assert f"{measured['psnr_turned']:6.2f} dB" in result.out
    page = (sweep / "report.html").read_text(encoding="utf-8")
    assert f"{measured['psnr_turned']:.2f}" in page
    assert "colour error" in page


def test_the_start_is_kept_only_if_it_is_measured(type_line, tmp_path):
    """The summary of a run on the exact prior has the entries that it has always had."""
    line = [word for word in SMALL if word != "prior=tiny"]
    assert type_line("train", *line, "prior=shapes", "steps=1").code == 0
    summary = read_json(tmp_path / "run/summary.json")
    assert not summary.keys() & {*AT_TURN, "truth"}
    assert "psnr" in summary
    shutil.rmtree(tmp_path / "run")
    blind = [word for word in SMALL if word not in EYES]
    assert type_line("train", *blind, "steps=1", "truth=shapes", "metric=[]").code == 0
    assert not read_json(tmp_path / "run/summary.json").keys() & QUALITY
