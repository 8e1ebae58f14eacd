"""ImageReward: what the adapter passes to the package, with a module of the same interface in its place.

The package cannot be imported beside the libraries of these tests. The stand-in has the signatures of
image-reward 1.5: ``load(name, device, download_root, med_config)``, ``score(prompt, image)`` with an image of
Pillow, which returns a number, and ``blip.tokenizer``.
"""

import hashlib
import json
import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image
from protocols import output, ring
from splats import make_gaussians

from cadam3d.core.errors import UserError
from cadam3d.metric import transformer
from cadam3d.metric.base import Measurand
from cadam3d.metric.image_reward import ImageReward

PROTOCOL = ring(size=8, text="a {}")
PICTURES = torch.rand(3, 8, 8, 3, generator=torch.Generator().manual_seed(0))


def render(cameras, background):
    return output(PICTURES)


def measurand(prompt="red cube"):
    return Measurand(gaussians=make_gaussians(2), render=render, prompt=prompt)


def reward(prompt, picture):
    """Return a number that depends on the text and on every pixel."""
    return len(prompt) + float(np.asarray(picture).astype(np.float64).std())


@pytest.fixture
def package(monkeypatch):
    """Put a stand-in for the package where it is imported from, and return its calls of ``load``."""
    calls = []

    class Model:
        def __init__(self):
            self.blip = SimpleNamespace(tokenizer=lambda text: {"input_ids": [0, *text.split(), 1]})

        def score(self, prompt, image):
            assert isinstance(image, Image.Image)
            assert image.mode == "RGB"
            return reward(prompt, image)

    def load(name="ImageReward-v1.0", device="cpu", download_root=None, med_config=None):
        print("load checkpoint from", name)
        calls.append((name, download_root, med_config))
        return Model()

    module = ModuleType("ImageReward")
    module.load = load
    monkeypatch.setitem(sys.modules, "ImageReward", module)
    return calls


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "ImageReward.pt").write_bytes(b"weights")
    (tmp_path / "med_config.json").write_text("{}")
    return tmp_path


def metric(model):
    return ImageReward(protocol=PROTOCOL, model=str(model))


def test_every_view_is_scored_with_the_text_of_the_protocol(package, folder, capsys):
    measured = metric(folder).measure(measurand())
    pictures = (PICTURES * 255).round().byte().numpy()
    expected = [reward("a red cube", picture) for picture in pictures]
    record = measured.details["image_reward"]
    assert record["views"] == pytest.approx(expected, abs=1e-9)
    assert measured.numbers["image_reward"] == pytest.approx(np.mean(expected), abs=1e-9)
    assert record["model"] == "ImageReward-v1.0"
    assert record["weights_sha256"] == hashlib.sha256(b"weights").hexdigest()
    assert json.loads(json.dumps(record)) == record
    assert capsys.readouterr().out == ""


def test_files_in_a_folder_are_read_without_a_download(package, folder):
    metric(folder).scorer(torch.device("cpu"))
    assert package == [(str(folder / "ImageReward.pt"), str(folder), str(folder / "med_config.json"))]


def test_without_a_folder_the_files_come_from_the_hub(package, folder, monkeypatch):
    asked = []

    def download(name, *, allow_patterns, **options):
        asked.append((name, *allow_patterns))
        return str(folder)

    monkeypatch.setattr("huggingface_hub.snapshot_download", download)
    transformer.downloaded.cache_clear()
    metric("THUDM/ImageReward").prepare()
    assert asked == [("THUDM/ImageReward", "ImageReward.pt", "med_config.json")]


def test_a_long_prompt_is_reported(package, folder):
    words = " ".join(["red"] * 40)
    assert metric(folder).measure(measurand()).warnings == ()
    warning = metric(folder).measure(measurand(words)).warnings[0]
    assert warning.startswith("the model reads 35 tokens, and the others of the 43")


def refusal(model):
    """Return the message that is printed before a run begins."""
    with pytest.raises(UserError) as caught:
        metric(model).prepare()
    return str(caught.value)


def test_without_the_package_one_line_says_what_to_install(folder, monkeypatch):
    monkeypatch.setitem(sys.modules, "ImageReward", None)
    text = refusal(folder)
    assert text.startswith("metric.image_reward: the package image-reward cannot be imported")
    assert "Try, in a new environment: pip install '.[image_reward]' openai-clip" in text
