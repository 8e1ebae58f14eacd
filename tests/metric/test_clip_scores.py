"""CLIP score, R-precision and PickScore: their values equal plain calls of transformers, and have records."""

import hashlib
import json
import re
import shutil
from dataclasses import replace

import pytest
import torch
from PIL import Image
from protocols import output, ring
from splats import make_gaussians

from cadam3d.core.errors import UserError
from cadam3d.io.records import Score, difference
from cadam3d.metric import transformer
from cadam3d.metric.base import Measurand
from cadam3d.metric.clip_r_precision import ClipRPrecision
from cadam3d.metric.clip_score import ClipScore
from cadam3d.metric.pick_score import PickScore
from cadam3d.metric.transformer import TransformerFolder, weights_hash

PROMPT = "a red cube"
PROTOCOL = ring(
    elevations_deg=[0.0, 40.0],
    size=48,
    text="a view of {}",
    models={"clip": "openai/clip@abc"},
)


def scene(cameras, background, shown=None):
    """Return pictures that differ between views: coloured noise, drawn from the angles of the camera."""
    pictures = []
    for azimuth, elevation in zip(cameras.azimuth_deg, cameras.elevation_deg, strict=True):
        seed = round(float(azimuth) * 10 + float(elevation) * 10_000) + 10_000_000
        blocks = torch.rand(3, 3, 3, generator=torch.Generator().manual_seed(seed))
        pictures.append(blocks.repeat_interleave(16, 0).repeat_interleave(16, 1))
    return output(torch.stack(pictures))


@pytest.fixture
def measurand():
    return Measurand(gaussians=make_gaussians(2), render=scene, prompt=PROMPT)


@pytest.fixture
def make(clip_folder):
    def metric(kind, **changes):
        settings = {"protocol": PROTOCOL, "model": str(clip_folder)}
        return kind(**settings | changes)

    return metric


@pytest.fixture(scope="session")
def expected(clip_folder):
    """Return cosines of all views with texts, and the trained factor, by plain calls of transformers."""
    from transformers import CLIPModel, CLIPProcessor

    model, processor = CLIPModel.from_pretrained(clip_folder), CLIPProcessor.from_pretrained(clip_folder)

    def cosines(texts):
        rgb = (scene(PROTOCOL.cameras, None).rgb * 255).round().byte().numpy()
        images = [Image.fromarray(each) for each in rgb]
        inputs = processor(text=texts, images=images, return_tensors="pt", padding=True)
        with torch.no_grad():
            output = model(**inputs)
            return output.logits_per_image / model.logit_scale.exp(), model.logit_scale.exp().item()

    return cosines


@pytest.mark.parametrize(("kind", "name"), [(ClipScore, "clip_score"), (PickScore, "pick_score")])
def test_a_score_is_the_cosine_of_each_view_times_100_or_the_trained_factor(
    make, measurand, expected, kind, name
):
    measured = make(kind).measure(measurand)
    cosines, scale = expected(["a view of a red cube"])
    values = cosines[:, 0] * (scale if kind is PickScore else 100)
    assert measured.details[name]["views"] == pytest.approx(values.tolist(), abs=1e-5)
    assert measured.numbers[name] == pytest.approx(values.mean().item(), abs=1e-5)
    assert cosines.std() > 0.005


@pytest.fixture
def candidates(tmp_path):
    path = tmp_path / "prompts.txt"
    path.write_text("# a list\na blue cat\n\na corgi on the table\na red cube\na big sphere\na blue cat\n")
    return path


@pytest.mark.parametrize("prompt", ["a red cube", "a blue cat", "a corgi on the table", "a small view"])
def test_r_precision_is_the_share_of_views_that_find_their_prompt(
    make, measurand, expected, candidates, prompt
):
    """The last prompt is not in the list, and competes with all of it."""
    measured = make(ClipRPrecision, prompts=str(candidates)).measure(replace(measurand, prompt=prompt))
    prompts = ["a blue cat", "a corgi on the table", "a red cube", "a big sphere"]
    prompts += [] if prompt in prompts else [prompt]
    cosines, _ = expected([f"a view of {each}" for each in prompts])
    hits = (cosines.argmax(dim=1) == prompts.index(prompt)).double()
    record = measured.details["clip_r_precision"]
    assert record["views"] == hits.tolist()
    assert measured.numbers["clip_r_precision"] == pytest.approx(hits.mean().item())
    assert record["candidates"] == 4
    assert 0 <= record["interval"]["low"] <= hits.mean() <= record["interval"]["high"] <= 1


def test_the_record_says_how_a_number_came_about(make, measurand, clip_folder):
    record = make(ClipScore).measure(measurand).details["clip_score"]
    assert json.loads(json.dumps(record)) == record
    assert record["protocol"] == {
        "name": "small",
        "views": 3,
        "elevations_deg": [0.0, 40.0],
        "distance": 3.0,
        "fov_y_deg": 40.0,
        "size": 48,
        "background": [1.0, 1.0, 1.0],
        "text": "a view of {}",
    }
    assert record["model"] == str(clip_folder)
    assert record["revision"] is None
    weights = (clip_folder / "model.safetensors").read_bytes()
    assert record["weights_sha256"] == hashlib.sha256(weights).hexdigest()
    assert record["text"] == "a view of a red cube"
    assert record["interval"]["low"] < record["mean"] < record["interval"]["high"]


def test_the_interval_of_a_mean_is_that_of_student(make, measurand):
    from scipy.stats import ttest_1samp

    record = make(ClipScore).measure(measurand).details["clip_score"]
    known = ttest_1samp(record["views"], 0).confidence_interval(0.95)
    assert (record["interval"]["low"], record["interval"]["high"]) == pytest.approx(tuple(known))


def test_several_metrics_load_a_model_once(make, measurand, candidates, tmp_path, clip_folder, monkeypatch):
    folder = shutil.copytree(clip_folder, tmp_path / "another")
    loads = []
    load = TransformerFolder.load
    monkeypatch.setattr(TransformerFolder, "load", lambda self, kind: loads.append(kind) or load(self, kind))
    for kind, more in ((ClipScore, {}), (PickScore, {}), (ClipRPrecision, {"prompts": str(candidates)})):
        make(kind, model=str(folder), **more).measure(measurand)
    assert len(loads) == 1
    # Other weights in the same folder are another model.
    other = make(ClipScore, model=str(folder))
    before = other.measure(measurand).details["clip_score"]
    with (folder / "model.safetensors").open("r+b") as file:
        file.seek(-4, 2)
        file.write(b"\0\0\x80\x3f")
    after = other.measure(measurand).details["clip_score"]
    assert len(loads) == 2
    assert before["weights_sha256"] != after["weights_sha256"]


def test_the_hash_of_several_files_is_that_of_the_list_of_sha256sum(tmp_path):
    lines = ""
    for name in ("model-00001-of-00002.safetensors", "model-00002-of-00002.safetensors"):
        (tmp_path / name).write_text(name)
        lines += f"{hashlib.sha256(name.encode()).hexdigest()}  {name}\n"
    files = sorted(tmp_path.iterdir(), reverse=True)
    assert weights_hash(files) == hashlib.sha256(lines.encode()).hexdigest()


def test_a_long_prompt_is_cut_off_with_a_warning(make, measurand):
    long = replace(measurand, prompt="red " * 200)
    measured = make(ClipScore).measure(long)
    [warning] = measured.warnings
    assert "reads 77 tokens" in warning
    cut = replace(measurand, prompt="red " * 150)
    assert make(ClipScore).measure(cut).numbers == pytest.approx(measured.numbers)
    assert make(ClipScore).measure(measurand).warnings == ()


def test_a_model_of_the_hub_has_its_commit_in_the_record(make, measurand, clip_folder, tmp_path, monkeypatch):
    snapshot = shutil.copytree(clip_folder, tmp_path / "snapshots" / "0123456789abcdef")
    asked = []

    def download(name, **options):
        asked.append((name, options["revision"]))
        return str(snapshot)

    monkeypatch.setattr("huggingface_hub.snapshot_download", download)
    transformer.downloaded.cache_clear()
    record = make(ClipScore, model=None).measure(measurand).details["clip_score"]
    assert asked == [("openai/clip", "abc")]
    assert (record["model"], record["revision"]) == ("openai/clip", "0123456789abcdef")
    make(ClipScore, model="my/clip").measure(measurand)
    assert asked[-1] == ("my/clip", None)


def without(name):
    def damage(folder):
        (folder / name).unlink()

    return damage


def only_pickled(folder):
    torch.save({}, folder / "pytorch_model.bin")
    (folder / "model.safetensors").unlink()


def of_another_kind(folder):
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps(config | {"model_type": "siglip"}))


def with_weights_of_another_model(folder):
    from safetensors.torch import save_file

    save_file({"embeddings": torch.zeros(2)}, folder / "model.safetensors", {"format": "pt"})


def cut_short(folder):
    whole = (folder / "model.safetensors").read_bytes()
    (folder / "model.safetensors").write_bytes(whole[:-100])


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (without("config.json"), "expected a folder with the config.json"),
        (without("preprocessor_config.json"), "cannot be loaded"),
        (only_pickled, "it could run code"),
        (of_another_kind, "not a CLIP model"),
        (with_weights_of_another_model, "it is not a CLIPModel"),
        (cut_short, "cannot be loaded"),
    ],
)
def test_a_damaged_model_is_one_message(make, measurand, clip_folder, tmp_path, damage, message):
    folder = shutil.copytree(clip_folder, tmp_path / "damaged")
    damage(folder)
    with pytest.raises(UserError, match=message) as caught:
        make(ClipScore, model=str(folder)).measure(measurand)
    assert str(caught.value).startswith("metric.clip_score.model: ")


@pytest.mark.parametrize("model", ["", "~/nothing/here", "models"])
def test_a_model_that_is_no_folder_and_no_id_is_refused(make, measurand, model):
    with pytest.raises(UserError, match=r"metric\.clip_score\.model: expected a folder"):
        make(ClipScore, model=model).measure(measurand)


def test_a_protocol_may_name_no_model(make, measurand):
    metric = make(PickScore, model=None, protocol=replace(PROTOCOL, models={}))
    with pytest.raises(UserError, match=r"metric\.pick_score\.model: protocol=small names no model"):
        metric.measure(measurand)


@pytest.mark.parametrize(
    "damage", [of_another_kind, cut_short, without("preprocessor_config.json"), without("vocab.json")]
)
def test_a_damaged_model_is_found_before_a_run_begins(make, clip_folder, tmp_path, damage):
    """The tokenizer of the last one is in two files, so both are removed."""
    folder = shutil.copytree(clip_folder, tmp_path / "damaged")
    make(ClipScore, model=str(folder)).prepare()
    (folder / "tokenizer.json").unlink()
    damage(folder)
    with pytest.raises(UserError, match=r"^metric\.clip_score\.model: .*damaged cannot be used"):
        make(ClipScore, model=str(folder)).prepare()


def test_a_score_that_is_not_a_number_is_refused(make, measurand, clip_folder, tmp_path):
    from safetensors.torch import load_file, save_file

    folder = shutil.copytree(clip_folder, tmp_path / "nan")
    weights = load_file(folder / "model.safetensors")
    weights["visual_projection.weight"] *= float("nan")
    save_file(weights, folder / "model.safetensors", {"format": "pt"})
    for kind in (ClipScore, PickScore):
        with pytest.raises(UserError, match="returns NaN or infinity"):
            make(kind, model=str(folder)).measure(measurand)


def test_whatever_a_model_raises_costs_only_its_score(make, measurand, monkeypatch):
    def fail(*_):
        raise ValueError("too many <image>\ntokens")

    monkeypatch.setattr("cadam3d.metric.clip.Clip.pictures", fail)
    with pytest.raises(UserError, match=r"cannot score this prompt \(too many <image> tokens\)"):
        make(ClipScore).measure(measurand)


@pytest.mark.parametrize(
    ("file", "change"),
    [
        ("preprocessor_config.json", {"image_mean": [0.5, 0.5, 0.5]}),
        ("config.json", {"text_config": {"hidden_act": "gelu"}}),
    ],
)
def test_equal_weights_with_other_settings_are_another_method(
    make, measurand, clip_folder, tmp_path, file, change
):
    folder = shutil.copytree(clip_folder, tmp_path / "another")
    settings = json.loads((folder / file).read_text())
    for name, value in change.items():
        settings[name] = settings[name] | value if isinstance(value, dict) else value
    (folder / file).write_text(json.dumps(settings))
    found = [
        Score(each.numbers["clip_score"], json.loads(json.dumps(each.details["clip_score"])))
        for each in (make(ClipScore, model=str(path)).measure(measurand) for path in (clip_folder, folder))
    ]
    assert found[0].value != pytest.approx(found[1].value)
    assert re.search("preprocessing.image_mean|activation", str(difference("clip_score", found)))
