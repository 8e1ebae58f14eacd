"""A model folder may come from a stranger: nothing in it runs, and every damage is one line."""

import json
import os
import pickle
import shutil
import sys
from pathlib import Path

import latents
import pytest
import torch

from cadam3d.core.errors import UserError

pytest.importorskip("diffusers")

from cadam3d.prior.stable_diffusion import StableDiffusion

INDEX, NETWORK, WEIGHTS = "model_index.json", "unet/config.json", "unet/diffusion_pytorch_model.safetensors"
ENCODER, TOKENIZER, NOISE = "text_encoder/config.json", "tokenizer", "scheduler/scheduler_config.json"
DEEP = "[" * 200_000


@pytest.fixture(scope="module")
def model(tmp_path_factory) -> Path:
    import pipelines

    return pipelines.stable_diffusion(tmp_path_factory.mktemp("model"))


def used(folder: Path) -> None:
    """Do with a model what training does before and in its first step."""
    keys = {**latents.KEYS, "path": str(folder), "cache_dir": str(folder.parent / "cache")}
    prior = StableDiffusion(**keys)
    prior.memory("a cube", "", 2, 64)
    condition = latents.condition_of(prior)
    prior.load()
    prior.encode(torch.rand(2, 64, 64, 3))
    prior.predict(latents.normal(2, 4, 8, 8), latents.normal(2).sigmoid(), condition, 7.5)


def replaced(file: str, **changes: object):
    def change(folder: Path) -> None:
        content = json.loads((folder / file).read_text())
        (folder / file).write_text(json.dumps({**content, **changes}))

    return change


def without(file: str, key: str):
    def change(folder: Path) -> None:
        content = json.loads((folder / file).read_text())
        del content[key]
        (folder / file).write_text(json.dumps(content))

    return change


def holding(file: str, content: str | bytes):
    return lambda folder: (folder / file).write_bytes(
        content.encode() if isinstance(content, str) else content
    )


def cut(file: str, share: float = 0.5):
    def change(folder: Path) -> None:
        content = (folder / file).read_bytes()
        (folder / file).write_bytes(content[: int(len(content) * share)])

    return change


class Payload:
    """Writes a file when it is unpickled."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self):
        return (open, (str(self.marker), "w"))


def pickled(weights: str, other: str):
    def change(folder: Path) -> None:
        (folder / weights).unlink()
        (folder / weights).with_name(other).write_bytes(pickle.dumps(Payload(folder / "marker")))

    return change


def removed(name: str):
    def change(folder: Path) -> None:
        shutil.rmtree(folder / name) if (folder / name).is_dir() else (folder / name).unlink()

    return change


def empty_weights(folder: Path) -> None:
    from safetensors.torch import save_file

    save_file({}, folder / "text_encoder/model.safetensors")


def piped(folder: Path) -> None:
    (folder / "tokenizer/tokenizer.json").unlink()
    os.mkfifo(folder / "tokenizer/tokenizer.json")


def endless(folder: Path) -> None:
    (folder / "text_encoder/model.safetensors").unlink()
    pickled = b"\x80\x02})" + b"2\x86" * 60 + b"K\x01s."
    (folder / "text_encoder/pytorch_model.bin").write_bytes(pickled)


DAMAGES = {
    **({"tokenizer: a pipe": piped} if hasattr(os, "mkfifo") else {}),
    "encoder: endless": endless,
    "index: a number": replaced(INDEX, unet=5),
    "index: text": replaced(INDEX, unet="diffusers"),
    "index: a dict": replaced(INDEX, unet={"a": 1}),
    "index: an empty list": replaced(INDEX, unet=[]),
    "index: numbers in a list": replaced(INDEX, unet=[1, 2]),
    "index: lists in a list": replaced(INDEX, text_encoder=[["transformers"], ["CLIPTextModel"]]),
    "index: another class": replaced(INDEX, unet=["diffusers", "AutoencoderKL"]),
    "index: a pipeline": replaced(INDEX, text_encoder=["diffusers", "StableDiffusionPipeline"]),
    "index: a function": replaced(INDEX, unet=["transformers", "pipeline"]),
    "index: a class that asks": replaced(INDEX, tokenizer=["transformers", "AutoTokenizer"]),
    "index: none": replaced(INDEX, text_encoder=None),
    "index: deep": holding(INDEX, DEEP),
    "network: no numbers": replaced(NETWORK, block_out_channels="x"),
    "network: other sizes": replaced(NETWORK, block_out_channels=[24, 48]),
    "network: unknown blocks": replaced(NETWORK, down_block_types=["Evil", "Evil"]),
    "network: nested": replaced(NETWORK, in_channels={"a": []}),
    "network: deep": holding(NETWORK, DEEP),
    "network: a list": holding(NETWORK, "[1]"),
    "network: kernels": replaced(NETWORK, attn_implementation="evil/kernel"),
    "network: quantized": replaced(NETWORK, quantization_config={"quant_method": "bitsandbytes"}),
    "encoder: wrong": replaced(ENCODER, hidden_size="wide"),
    "encoder: no vocabulary": replaced(ENCODER, vocab_size=None),
    "encoder: kernels": replaced(ENCODER, attn_implementation="evil/kernel"),
    "encoder: deep": holding(ENCODER, DEEP),
    "encoder: a pickle": pickled("text_encoder/model.safetensors", "pytorch_model.bin"),
    "network: a pickle": pickled(WEIGHTS, "diffusion_pytorch_model.bin"),
    "encoder: empty weights": empty_weights,
    "encoder: cut": cut("text_encoder/model.safetensors"),
    "autoencoder: no scale": replaced("vae/config.json", scaling_factor="x"),
    "autoencoder: no blocks": replaced("vae/config.json", block_out_channels=[]),
    "weights: empty": holding(WEIGHTS, b""),
    "weights: cut": cut(WEIGHTS),
    "weights: a huge header": holding(WEIGHTS, b"\xff" * 8),
    "weights: text": holding(WEIGHTS, "hello"),
    "weights: gone": removed(WEIGHTS),
    "tokenizer: gone": removed(TOKENIZER),
    "tokenizer: numbers": holding("tokenizer/tokenizer.json", "[1, 2]"),
    "tokenizer: deep": holding("tokenizer/tokenizer_config.json", DEEP),
    "tokenizer: not json": holding("tokenizer/tokenizer.json", "{"),
    "tokenizer: no length": replaced("tokenizer/tokenizer_config.json", model_max_length="x"),
    "tokenizer: long": replaced("tokenizer/tokenizer_config.json", model_max_length=10**30),
    "noise: no steps": without(NOISE, "num_train_timesteps"),
    "noise: steps as text": replaced(NOISE, num_train_timesteps="1000"),
    "noise: endless steps": replaced(NOISE, num_train_timesteps=10**15),
    "noise: a list": replaced(NOISE, beta_start=[1]),
    "noise: kind": replaced(NOISE, prediction_type=["epsilon"]),
    "words: a number": holding("vocabulary.json", "5"),
    "words: other": holding("vocabulary.json", '{"nouns": 5}'),
    "words: deep": holding("vocabulary.json", DEEP),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_a_damaged_model_is_one_line(name, model, tmp_path):
    folder = tmp_path / "model"
    shutil.copytree(model, folder)
    DAMAGES[name](folder)
    with pytest.raises(UserError) as caught:
        used(folder)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 1000
    assert not (folder / "marker").exists()


def test_a_sound_model_is_used(model):
    used(model)


def test_a_tokenizer_with_code_neither_runs_it_nor_asks(model, tmp_path, monkeypatch):
    """Transformers asks on the terminal whether to run the code, and a user may answer yes."""
    folder = tmp_path / "model"
    shutil.copytree(model, folder)
    code = f"open({str(tmp_path / 'marker')!r}, 'w').close()\nclass Evil: pass\n"
    (folder / "tokenizer/evil.py").write_text(code)
    auto = {"auto_map": {"AutoTokenizer": ["evil.Evil", None]}, "tokenizer_class": "Evil"}
    replaced("tokenizer/tokenizer_config.json", **auto)(folder)
    monkeypatch.setattr("builtins.input", lambda *_: "y")
    used(folder)
    replaced(INDEX, tokenizer=["transformers", "AutoTokenizer"])(folder)
    with pytest.raises(UserError, match="expected a CLIPTokenizer"):
        used(folder)
    assert not (tmp_path / "marker").exists()
    assert "evil" not in sys.modules
