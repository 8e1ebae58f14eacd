"""Hps: scores of a checkpoint with the names of OpenCLIP equal those of transformers, and plain refusals."""

import hashlib
import json
import shutil

import pytest
import torch
from PIL import Image
from protocols import output, ring
from safetensors.torch import save_file
from splats import make_gaussians

from cadam3d.core.errors import UserError
from cadam3d.metric import transformer
from cadam3d.metric.base import Measurand
from cadam3d.metric.hps import Hps

PROTOCOL = ring(models={"hps": "xswu/HPSv2/HPS_v2_compressed.pt"})
PICTURES = torch.rand(3, 32, 32, 3, generator=torch.Generator().manual_seed(0))


def render(cameras, background):
    return output(PICTURES)


MEASURAND = Measurand(gaussians=make_gaussians(2), render=render, prompt="a red cube")


def open_clip_names(model):
    """Return the weights of a CLIPModel as OpenCLIP names and lays them out, module by module."""

    def norm(name, layer):
        return {f"{name}.weight": layer.weight, f"{name}.bias": layer.bias}

    def transformer(name, encoder):
        found = {}
        for number, layer in enumerate(encoder.layers):
            here, attention = f"{name}.resblocks.{number}", layer.self_attn
            parts = (attention.q_proj, attention.k_proj, attention.v_proj)
            found[f"{here}.attn.in_proj_weight"] = torch.cat([part.weight for part in parts])
            found[f"{here}.attn.in_proj_bias"] = torch.cat([part.bias for part in parts])
            found |= norm(f"{here}.attn.out_proj", attention.out_proj)
            found |= norm(f"{here}.ln_1", layer.layer_norm1) | norm(f"{here}.ln_2", layer.layer_norm2)
            found |= norm(f"{here}.mlp.c_fc", layer.mlp.fc1) | norm(f"{here}.mlp.c_proj", layer.mlp.fc2)
        return found

    text, vision = model.text_model, model.vision_model
    named = {
        "logit_scale": model.logit_scale,
        "positional_embedding": text.embeddings.position_embedding.weight,
        "token_embedding.weight": text.embeddings.token_embedding.weight,
        "text_projection": model.text_projection.weight.T,
        "visual.proj": model.visual_projection.weight.T,
        "visual.class_embedding": vision.embeddings.class_embedding,
        "visual.positional_embedding": vision.embeddings.position_embedding.weight,
        "visual.conv1.weight": vision.embeddings.patch_embedding.weight,
        "attn_mask": torch.full((4, 4), float("-inf")).triu(1),
    }
    named |= norm("ln_final", text.final_layer_norm)
    named |= norm("visual.ln_pre", vision.pre_layrnorm) | norm("visual.ln_post", vision.post_layernorm)
    named |= transformer("transformer", text.encoder) | transformer("visual.transformer", vision.encoder)
    return {name: tensor.detach().clone().contiguous() for name, tensor in named.items()}


@pytest.fixture(scope="module")
def weights(clip_folder):
    from transformers import CLIPModel

    return open_clip_names(CLIPModel.from_pretrained(clip_folder))


@pytest.fixture(scope="module")
def base(clip_folder, tmp_path_factory):
    """Return a folder with everything except weights."""
    folder = tmp_path_factory.mktemp("base")
    shutil.copytree(clip_folder, folder, dirs_exist_ok=True, ignore=shutil.ignore_patterns("*.safetensors"))
    return folder


@pytest.fixture(scope="module")
def expected(clip_folder):
    """Return the cosines of the pictures with the prompt, by plain calls of transformers."""
    from transformers import CLIPModel, CLIPProcessor

    model, processor = CLIPModel.from_pretrained(clip_folder), CLIPProcessor.from_pretrained(clip_folder)
    images = [Image.fromarray(each) for each in (PICTURES * 255).round().byte().numpy()]
    with torch.no_grad():
        output = model(**processor(text=["a red cube"], images=images, return_tensors="pt", padding=True))
    return (output.logits_per_image / model.logit_scale.exp())[:, 0].tolist()


def metric(**changes):
    settings = {"protocol": PROTOCOL, "model": None, "base": "one/base"}
    return Hps(**settings | changes)


def checkpoint(folder, weights):
    file = folder / "HPS_v2_compressed.pt"
    torch.save({"state_dict": weights, "epoch": 1}, file)
    return file


def test_a_checkpoint_scores_as_its_model_does_in_transformers(tmp_path, weights, base, expected):
    file = checkpoint(tmp_path, weights)
    measured = metric(model=str(file), base=str(base)).measure(MEASURAND)
    record = measured.details["hps"]
    assert record["views"] == pytest.approx(expected, abs=1e-5)
    assert measured.numbers["hps"] == pytest.approx(sum(expected) / 3, abs=1e-5)
    assert record["weights_sha256"] == hashlib.sha256(file.read_bytes()).hexdigest()
    assert record["model"] == str(file)
    assert json.loads(json.dumps(record)) == record


def test_half_precision_and_safetensors_are_read_too(tmp_path, weights, base, expected):
    file = tmp_path / "hps.safetensors"
    save_file({name: tensor.half() for name, tensor in weights.items()}, file)
    found = metric(model=str(file), base=str(base)).measure(MEASURAND).details["hps"]["views"]
    assert found == pytest.approx(expected, abs=5e-3)


def test_the_file_may_be_on_the_hub(tmp_path, weights, base, expected, monkeypatch):
    name = checkpoint(tmp_path, weights).name
    asked = []

    def download(repository, *, allow_patterns, **options):
        asked.append((repository, *allow_patterns))
        return str(tmp_path)

    monkeypatch.setattr("huggingface_hub.snapshot_download", download)
    transformer.downloaded.cache_clear()
    record = metric(base=str(base)).measure(MEASURAND).details["hps"]
    assert asked == [("xswu/HPSv2", name)]
    assert (record["model"], record["revision"]) == (f"xswu/HPSv2/{name}", tmp_path.name)
    assert record["views"] == pytest.approx(expected, abs=1e-5)


def refusal(**changes):
    """Return the message that is printed when the model is loaded."""
    with pytest.raises(UserError) as caught:
        metric(**changes).scorer(torch.device("cpu"))
    return str(caught.value)


def test_missing_files_are_reported_before_a_run(base, monkeypatch):
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    transformer.downloaded.cache_clear()
    with pytest.raises(UserError, match="hf download xswu/HPSv2"):
        metric(base=str(base)).prepare()


def test_a_file_with_other_weights_is_refused(tmp_path, weights, base):
    fewer = {name: tensor for name, tensor in weights.items() if name != "visual.proj"}
    assert "visual_projection" in refusal(model=str(checkpoint(tmp_path, fewer)), base=str(base))
    other = weights | {"head.weight": torch.zeros(2)}
    assert "head.weight" in refusal(model=str(checkpoint(tmp_path, other)), base=str(base))


def test_nothing_in_a_checkpoint_is_executed(tmp_path, base):
    class Trap:
        def __reduce__(self):
            return (open, (str(tmp_path / "trapped"), "w"))

    file = tmp_path / "trap.pt"
    torch.save({"state_dict": Trap()}, file)
    assert "is not a file of tensors" in refusal(model=str(file), base=str(base))
    assert not (tmp_path / "trapped").exists()
