"""The priors that come with the package: found there, with what suits them, on small random models."""

import importlib.util
import re
import shutil
from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf

from cadam3d.build import component
from cadam3d.commands import doctor
from cadam3d.core import checks
from cadam3d.core.errors import UserError
from cadam3d.io import pretrained
from cadam3d.io.jsonl import read_json
from cadam3d.io.reading import read_yaml
from cadam3d.settings.compose import compose, flatten
from cadam3d.settings.line import read_flags
from cadam3d.settings.options import config_dir
from cadam3d.sweep.plan import Composer

KINDS = {"shapes_sd": "stable_diffusion", "shapes_mvdream": "mvdream", "shapes_sd3": "stable_diffusion_3"}
FEW = ("steps=2", "initializer.count=50", "exporter=[ply]", "metric=[size]", "callback=[checkpoint]")


@pytest.fixture
def models(pipelines, tmp_path_factory, monkeypatch) -> Path:
    """Let small random models take the place of those in the package."""
    folder = tmp_path_factory.mktemp("models")
    for name, kind in KINDS.items():
        (folder / name).symlink_to(pipelines("shapes", kind=kind))
    monkeypatch.setattr(pretrained, "MODELS", folder)
    return folder


def built(*line):
    return component(compose(["prompt=a red cube", *line]).prior, key="prior")


def test_the_packaged_models_are_those_that_the_options_name():
    files = {path.stem: path.read_text(encoding="utf-8") for path in (config_dir() / "prior").glob("*.yaml")}
    named = {name: re.findall(rf"{pretrained.PACKAGE}(\w+)", text) for name, text in files.items()}
    assert {name: found for name, found in named.items() if found} == {name: [name] for name in KINDS}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["shapes_sd", "shapes_sd3"])
def test_a_prior_of_the_package_trains_with_nothing_but_its_name(name, models, type_line, tmp_path):
    line = ("train", f"prior={name}", "prompt=a red mushroom", *FEW, f"prior.cache_dir={tmp_path}/c")
    done = type_line(*line, "hydra.run.dir=first")
    assert done.code == 0, done.err
    assert read_json(tmp_path / "first" / "summary.json")["outcome"] == "finished"
    assert read_yaml(tmp_path / "first" / "config.yaml")["prior"]["path"] == f"package:{name}"


@pytest.mark.slow
def test_a_moved_run_continues_with_the_model_of_the_package_there(
    models, type_line, tmp_path, tmp_path_factory, monkeypatch
):
    cache = f"prior.cache_dir={tmp_path}/c"
    line = ("train", "prior=shapes_mvdream", "prompt=a red mushroom", *FEW, "seed=3", cache)
    assert type_line(*line, "hydra.run.dir=first").code == 0
    assert read_yaml(tmp_path / "first" / "config.yaml")["prior"]["path"] == "package:shapes_mvdream"
    (tmp_path / "first").rename(tmp_path / "moved")
    elsewhere = tmp_path_factory.mktemp("site") / "models"
    shutil.copytree(models, elsewhere)
    shutil.rmtree(models)
    monkeypatch.setattr(pretrained, "MODELS", elsewhere)
    done = type_line("train", "resume=moved", "steps=3", cache)
    assert done.code == 0, done.err
    summary = read_json(tmp_path / "moved" / "summary.json")
    assert (summary["steps"], summary["seed"]) == (3, 3)


def test_the_networks_compute_in_float32_on_the_cpu_although_the_files_are_smaller(models):
    prior = built("prior=shapes_sd", "device=cpu")
    file = models / "shapes_sd" / "unet" / "diffusion_pytorch_model.safetensors"
    from safetensors.torch import load_file

    assert {each.dtype for each in load_file(file).values()} == {torch.float16}
    assert {each.dtype for each in (*prior.network.parameters(), *prior.vae.parameters())} == {torch.float32}


def test_unknown_words_are_refused_before_anything_is_written(models, type_line, tmp_path):
    line = ("train", "prior=shapes_sd", *FEW, f"prior.cache_dir={tmp_path}/c")
    message = type_line(*line, "prompt=a gray ball").err
    assert message.startswith("cadam3d: prompt: expected words of prior=shapes_sd, got 'gray', 'ball'.")
    assert message.endswith('Try: prompt="a red sphere"\n')
    message = type_line(*line, "prompt=a red cube", "negative_prompt=ugly, bad").err
    assert message.startswith("cadam3d: negative_prompt: expected words of prior=shapes_sd")
    assert not list(tmp_path.glob("outputs/*/*"))


def test_images_far_larger_than_those_of_the_training_are_refused(models):
    prior = built("prior=shapes_sd", "prior.size=144")
    message = r"^prior\.size: expected at most 2 times the 64 pixels.*, got 144\. Try: prior\.size=64$"
    for ask in (lambda: prior.embed("a red cube", ""), lambda: prior.memory("a red cube", "", 2, 64)):
        with pytest.raises(UserError, match=message):
            ask()


def test_sizes_that_the_networks_cannot_read_are_refused(models):
    with pytest.raises(UserError, match=r"^camera\.size: expected a multiple of 8"):
        built("prior=shapes_sd", "prior.size=null").encode(torch.rand(1, 20, 20, 3))
    with pytest.raises(UserError, match=r"^prior\.size: expected a multiple of 16"):
        built("prior=shapes_sd", "prior.size=100")


def test_a_model_that_is_not_in_the_package_is_named(models):
    lacking = built("prior=stable_diffusion", "prior.path=package:shapes_xl").lacks()
    assert "got 'package:shapes_xl'" in lacking


def test_a_package_without_models_is_reported(tmp_path, monkeypatch):
    pytest.importorskip("diffusers")
    monkeypatch.setattr(pretrained, "MODELS", tmp_path)
    assert "model_index.json" in built("prior=shapes_sd").lacks()


def test_without_the_extra_the_message_says_what_to_install(models, monkeypatch, type_line):
    found = importlib.util.find_spec
    monkeypatch.setattr(checks, "find_spec", lambda each: None if each == "diffusers" else found(each))
    done = type_line("train", "prior=shapes_sd", "prompt=a red cube")
    assert done.message == "prior: needs diffusers. Try: pip install '.[diffusers]'"
    assert doctor.check_prior("shapes_sd").hint == ""


@pytest.mark.parametrize("name", KINDS)
def test_doctor_lists_the_models_of_the_package_as_ready(name, models):
    finding = doctor.check_prior(name)
    assert (str(finding.verdict), finding.found) == ("ok", "ready")


def test_a_sweep_on_these_priors_knows_the_settings_that_its_jobs_write():
    """Otherwise it would take its own finished jobs for those of another sweep."""
    composer = Composer(read_flags([])[0], [])
    for values in (["prompting.below_deg=-5.0"], ["prompting.below_deg=-7.5"]):
        for name in ("shapes_sd", "shapes_sd3"):
            line = ["prompt=a red cube", f"prior={name}", *values]
            written = OmegaConf.to_container(compose(line), resolve=True)
            assert composer.compose(line).values == dict(flatten(written))
