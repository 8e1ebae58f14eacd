"""Scores of models in the commands: train and eval record their methods, and tables never mix them."""

import csv
from pathlib import Path

import pipelines
import pytest
from composed import as_yaml
from splats import make_gaussians

from cadam3d.io.jsonl import read_json, write_json
from cadam3d.io.ply import write_ply
from cadam3d.io.records import Score, difference, read_scores
from cadam3d.sweep.folder import Job, Plan, load, write_plan
from cadam3d.sweep.table import as_text, write_table

SMALL = ("protocol.views=2", "protocol.size=24")


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    folder = tmp_path_factory.mktemp("models")
    pipelines.clip(folder / "clip")
    pipelines.clip(folder / "other", seed=1)
    return folder


@pytest.fixture
def clip(models):
    return f"metric.clip_score.model={models / 'clip'}"


def make_run(folder: Path) -> Path:
    folder.mkdir(parents=True)
    (folder / "config.yaml").write_text(as_yaml("prompt=a red cube", "rasterizer=auto"), "utf-8")
    write_ply(folder / "asset.ply", make_gaussians(6, spread=0.3), up="-y", pad_sh=0)
    write_json(folder / "summary.json", {"num_gaussians": 6, "outcome": "finished", "prompt": "a red cube"})
    return folder


def make_sweep(folder: Path, *names: str) -> Path:
    for name in names:
        make_run(folder / name)
    jobs = [Job("", name, [], {}) for name in names]
    write_plan(folder, Plan(cwd=str(folder), flags=[], threads=None, jobs=jobs))
    return folder


def test_eval_prints_and_records_how_a_score_was_measured(tmp_path, type_line, clip):
    run = make_run(tmp_path / "run")
    code, out, _ = type_line(
        "eval", "run=run", "metric=[clip_score]", "protocol=gaussiandreamer", clip, *SMALL
    )
    assert code == 0
    result = read_json(run / "eval.json")
    record = result["measurements"]["clip_score"]
    assert (
        result["clip_score"] == record["value"] == record["mean"] == pytest.approx(sum(record["views"]) / 2)
    )
    assert record["protocol"]["name"] == "gaussiandreamer"
    [line] = [line for line in out.splitlines() if line.startswith("clip_score")]
    assert line.endswith(", protocol=gaussiandreamer")
    assert "measurements" not in out
    assert read_scores(run, read_json(run / "summary.json"))["clip_score"].value == result["clip_score"]


def test_an_evaluation_keeps_what_others_have_measured(tmp_path, type_line, clip):
    run = make_run(tmp_path / "run")
    type_line("eval", "run=run", "metric=[clip_score,size]", clip, *SMALL)
    before = read_json(run / "eval.json")
    _, out, _ = type_line("eval", "run=run", "metric=[niqe]", "protocol.views=2", "protocol.size=192")
    after = read_json(run / "eval.json")
    assert "clip_score" not in out
    assert set(after["measurements"]) == {"clip_score", "niqe"}
    kept = [name for name in before if name not in ("measurements", "numbers", "warnings")]
    assert [after[name] for name in kept] == [before[name] for name in kept]
    assert after["numbers"]["clip_score"] == before["numbers"]["clip_score"]
    # What is measured again is new, and numbers of another asset are not kept.
    type_line("eval", "run=run", "metric=[clip_score]", clip, *SMALL, "protocol.name=mine")
    again = read_json(run / "eval.json")["measurements"]
    assert again["clip_score"]["protocol"]["name"] == "mine"
    assert again["niqe"] == after["measurements"]["niqe"]
    write_json(run / "summary.json", read_json(run / "summary.json") | {"steps": 5})
    type_line("eval", "run=run", "metric=[size]")
    assert "measurements" in read_json(run / "eval.json")  # an evaluation without steps is of any
    write_json(run / "summary.json", read_json(run / "summary.json") | {"steps": 10})
    type_line("eval", "run=run", "metric=[size]")
    assert "measurements" not in read_json(run / "eval.json")


def test_training_measures_scores_too(tmp_path, type_line, clip):
    fast = ("steps=2", "camera.size=8", "rasterizer=auto", "exporter=[]", "callback=[]")
    line = ("train", "prompt=a red cube", "hydra.run.dir=run", "metric=[clip_score]", "initializer.count=20")
    assert type_line(*line, *fast, clip, *SMALL).code == 0
    summary = read_json(tmp_path / "run/summary.json")
    assert summary["measurements"]["clip_score"]["value"] == summary["clip_score"]
    page = (tmp_path / "run/report.html").read_text(encoding="utf-8")
    assert "weights_sha256" not in page.partition("Settings")[0]


@pytest.mark.parametrize("command", ["train", "eval"])
def test_missing_weights_are_refused_before_anything_is_done(tmp_path, type_line, monkeypatch, command):
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    run = make_run(tmp_path / "run")
    words = {"train": ("prompt=a cube", "hydra.run.dir=new"), "eval": ("run=run",)}[command]
    result = type_line(command, *words, "metric=[size,pick_score]")
    assert result.code == 1
    assert result.message.startswith("metric.pick_score.model: yuvalkirstain/PickScore_v1 is not available (")
    assert (
        "Try, with a network connection: hf download yuvalkirstain/PickScore_v1 --revision" in result.message
    )
    assert not (tmp_path / "new/config.yaml").exists()
    assert not (run / "eval.json").exists()


def test_eval_of_a_sweep_prints_and_writes_a_table_of_scores(tmp_path, type_line, clip):
    sweep = make_sweep(tmp_path / "sweep", "a", "b")
    code, out, _ = type_line("eval", "run=sweep", "metric=[clip_score]", clip, *SMALL)
    assert code == 0
    value = read_json(sweep / "a/eval.json")["clip_score"]
    header, *lines = [
        line.split() for line in out.splitlines() if "clip_score" in line or f"{value:.4g}" in line
    ]
    column = header.index("clip_score")
    assert [line[column] for line in lines] == [f"{value:.4g}"] * 2
    with (sweep / "sweep.csv").open(encoding="utf-8") as file:
        assert [float(row["clip_score"]) for row in csv.DictReader(file)] == [value, value]


@pytest.mark.parametrize(
    ("again", "key"),
    [
        (("protocol=gaussiandreamer",), "protocol.name is gaussiandreamer and paper"),
        (("protocol.background=[0,0,0]",), "protocol.background is"),
        (("metric.clip_score.model=OTHER",), "weights_sha256 is"),
    ],
)
def test_numbers_of_different_methods_are_never_in_one_table(tmp_path, type_line, clip, models, again, key):
    sweep = make_sweep(tmp_path / "sweep", "a", "b")
    changed = [word.replace("OTHER", str(models / "other")) for word in again]
    type_line("eval", "run=sweep/a", "metric=[clip_score]", clip, *SMALL)
    type_line(
        "eval",
        "run=sweep/b",
        "metric=[clip_score]",
        *([] if "OTHER" in again[0] else [clip]),
        *changed,
        *SMALL,
    )
    rows = write_table(sweep)
    with (sweep / "sweep.csv").open(encoding="utf-8") as file:
        assert "clip_score" not in (csv.DictReader(file).fieldnames or ())
    text = as_text(rows)
    assert "clip_score" not in text.splitlines()[0]
    assert key in text
    assert type_line("eval", "run=sweep", "metric=[clip_score]", clip, *SMALL).code == 0
    assert "clip_score" in as_text(load(sweep)).splitlines()[0]


def record(**changes):
    return {"value": 1.0, "protocol": {"name": "paper"}, "weights_sha256": "a", "text": "x"} | changes


def test_values_texts_and_places_of_a_model_may_differ():
    one = Score(1.0, record(model="clip", views=[1.0]))
    assert difference("n", [one, Score(2.0, record(model="/a/b", text="y", views=[2.0]))]) is None
    # A whole number is the same setting as a float and as an integer.
    whole, real = ({"name": "paper", "distance": 3, "elevations_deg": [kind(15)]} for kind in (int, float))
    scores = [Score(1.0, record(protocol=each)) for each in (whole, real | {"distance": 3.0})]
    assert difference("n", scores) is None
    # Without a hash, the name of a model is all that is known of it.
    nameless = [Score(1.0, record(weights_sha256=None, model=model)) for model in ("clip", "other")]
    assert "model is clip and other" in str(difference("n", nameless))


def test_an_evaluation_of_another_asset_is_not_used(tmp_path):
    run = make_run(tmp_path / "run")
    found = {"clip_score": 3.0, "measurements": {"clip_score": record()}}
    write_json(run / "eval.json", found | {"num_gaussians": 7})
    assert read_scores(run, read_json(run / "summary.json")) == {}
    write_json(run / "eval.json", found | {"num_gaussians": 6})
    assert read_scores(run, read_json(run / "summary.json"))["clip_score"].value == 3.0


@pytest.mark.parametrize("records", [None, [], "text", {"clip_score": 3}, {"clip_score": None}])
def test_records_of_an_unknown_kind_are_not_used(tmp_path, records):
    run = make_run(tmp_path / "run")
    write_json(run / "eval.json", {"clip_score": 3.0, "num_gaussians": 6, "measurements": records})
    assert read_scores(run, read_json(run / "summary.json")) == {}
