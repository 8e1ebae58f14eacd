"""Models are found in a folder or on the hub, and every possible failure is a helpful message of one line."""

import json
import shutil

import pytest
import torch

from cadam3d.core import checks
from cadam3d.core.errors import UserError
from cadam3d.io import pretrained
from cadam3d.io.pretrained import ModelSource

huggingface_hub = pytest.importorskip("huggingface_hub")
pytest.importorskip("diffusers")

KINDS = ("StableDiffusionPipeline",)
OTHERS = {"StableDiffusion3Pipeline": "prior=stable_diffusion_3"}


def source(**changes):
    keys = {"key": "prior", "path": None, "ids": ["one/model"], "revision": None, "variant": None}
    return ModelSource(**keys | changes)


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    import pipelines

    return pipelines.stable_diffusion(tmp_path_factory.mktemp("model"))


@pytest.fixture
def hub(monkeypatch):
    """Replace the hub by a dict with the answer for every id, which also records the requests."""
    answers, asked = {}, []

    def download(name, file, *, revision, local_files_only):
        asked.append((name, revision, local_files_only))
        answer = answers[name]
        if isinstance(answer, Exception):
            raise answer
        return str(answer)

    monkeypatch.setattr(huggingface_hub, "hf_hub_download", download)
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", False)
    answers["asked"] = asked
    return answers


def refusal(kind):
    import httpx2 as client  # what the hub's errors carry

    return kind("no", response=client.Response(404, request=client.Request("GET", "hub")))


@pytest.fixture(scope="module")
def mixed(model, tmp_path_factory):
    """Only the UNet and the text encoder of this model have files of the variant fp16."""
    import diffusers

    folder = tmp_path_factory.mktemp("mixed") / "model"
    pipeline = diffusers.StableDiffusionPipeline.from_pretrained(model)
    pipeline.save_pretrained(folder, variant="fp16")
    plain, vae = "diffusion_pytorch_model.safetensors", folder / "vae"
    (vae / "diffusion_pytorch_model.fp16.safetensors").rename(vae / plain)
    return folder


@pytest.mark.parametrize("name", ["unet", "vae", "text_encoder"])
def test_a_part_without_files_of_the_variant_has_its_plain_ones(name, model, mixed, monkeypatch):
    wanted = source(path=str(model)).find(KINDS, OTHERS).part(name, torch.float32)
    found = source(path=str(mixed), variant="fp16").find(KINDS, OTHERS)
    for key, tensor in found.part(name, torch.float32).state_dict().items():
        assert torch.equal(tensor, wanted.state_dict()[key])

    def fetch(where, file, revision, can_ask):
        return (mixed / file if (mixed / file).is_file() else None), "", can_ask

    monkeypatch.setattr(pretrained, "fetch_file", fetch)
    remote = ModelSource("prior", None, ["one/model"], None, "fp16")
    assert pretrained.Pretrained(remote, "one/model", None, mixed, {}).variant(name) == found.variant(name)


def test_a_variant_that_no_part_has_is_refused(mixed):
    found = source(path=str(mixed), variant="fp61").find(KINDS, OTHERS)
    with pytest.raises(UserError, match=r"prior\.variant: expected a variant of .*, got 'fp61'"):
        found.part("unet", torch.float32)


def test_a_folder_takes_precedence_over_ids_and_needs_no_hub(model, hub):
    found = source(path=str(model)).find(KINDS, OTHERS)
    assert found.where == str(model)
    assert hub["asked"] == []
    assert found.has("unet")
    assert not found.has("safety_checker")
    assert not found.has("text_encoder_3")


@pytest.mark.parametrize("lost", ["tokenizer", "tokenizer/*"])
def test_a_tokenizer_without_files_is_refused(model, tmp_path, lost):
    """Transformers would make one that knows no word, and every prompt would look the same."""
    folder = tmp_path / "model"
    shutil.copytree(model, folder)
    if lost == "tokenizer":
        shutil.rmtree(folder / lost)
    else:
        for file in folder.glob(lost):
            file.unlink()
    found = source(path=str(folder)).find(KINDS, OTHERS)
    with pytest.raises(UserError, match=r"^prior: tokenizer of .* knows 2 of the 519 pieces"):
        found.part("tokenizer")


def test_parts_are_frozen_and_have_the_requested_dtype(model):
    found = source(path=str(model)).find(KINDS, OTHERS)
    for name in ("unet", "vae", "text_encoder"):
        network = found.part(name, torch.bfloat16)
        assert not network.training
        assert all(p.dtype == torch.bfloat16 and not p.requires_grad for p in network.parameters())


def test_a_skeleton_is_the_network_without_weights(model):
    found = source(path=str(model)).find(KINDS, OTHERS)
    for name in ("unet", "vae", "text_encoder"):
        skeleton, network = found.skeleton(name, torch.float16), found.part(name, torch.float16)
        assert {p.device.type for p in skeleton.parameters()} == {"meta"}
        shapes = [(n, p.shape, p.dtype) for n, p in skeleton.named_parameters()]
        assert shapes == [(n, p.shape, p.dtype) for n, p in network.named_parameters()]
    assert torch.get_default_dtype() == torch.float32


def test_the_identity_changes_with_the_files(model, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(model, copy)
    before = source(path=str(copy)).find(KINDS, OTHERS).identity
    assert before == source(path=str(copy)).find(KINDS, OTHERS).identity
    (copy / "text_encoder" / "config.json").touch()
    assert before != source(path=str(copy)).find(KINDS, OTHERS).identity


def test_a_wrong_folder_is_reported_in_one_line(tmp_path):
    (tmp_path / "file").write_text("x")
    for path in ("/nowhere", tmp_path, tmp_path / "file"):
        with pytest.raises(UserError, match=r"model_index\.json") as caught:
            source(path=str(path)).find(KINDS, OTHERS)
        assert "\n" not in str(caught.value)
        assert "Try: prior.path=DIR" in str(caught.value)


def test_a_model_of_another_kind_names_the_prior_to_use(model, tmp_path):
    with pytest.raises(UserError, match=r"expected a StableDiffusion3Pipeline, .* Try: prior\.path=DIR"):
        source(path=str(model)).find(("StableDiffusion3Pipeline",), OTHERS)
    index = {"_class_name": "StableDiffusion3Pipeline"}
    (tmp_path / "model_index.json").write_text(json.dumps(index))
    with pytest.raises(UserError, match="Try: prior=stable_diffusion_3"):
        source(path=str(tmp_path)).find(KINDS, OTHERS)


def test_a_list_of_folders_serves_priors_of_different_kinds(model, tmp_path):
    other = tmp_path / "other"
    other.mkdir()
    (other / "model_index.json").write_text(json.dumps({"_class_name": "StableDiffusion3Pipeline"}))
    both = source(path=[str(other), str(model)])
    assert both.find(KINDS, OTHERS).where == str(model)
    assert both.find(KINDS, OTHERS).identity == source(path=str(model)).find(KINDS, OTHERS).identity
    assert both.find(("StableDiffusion3Pipeline",), {}).where == str(other)
    with pytest.raises(UserError, match=r"expected a SDXL, got .* Try: prior\.path=DIR"):
        both.find(("SDXL",), {})
    with pytest.raises(UserError, match=r"got .*typo"):
        source(path=[str(model), str(tmp_path / "typo")]).find(KINDS, OTHERS)


@pytest.mark.parametrize("text", ["", "no json", "[1]"])
def test_a_damaged_index_is_reported_in_one_line(tmp_path, text):
    (tmp_path / "model_index.json").write_text(text)
    with pytest.raises(UserError, match=r"model_index\.json"):
        source(path=str(tmp_path)).find(KINDS, OTHERS)


def test_a_damaged_part_is_reported_in_one_line(model, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(model, copy)
    found = source(path=str(copy)).find(KINDS, OTHERS)
    (copy / "unet" / "diffusion_pytorch_model.safetensors").write_bytes(b"cut")
    with pytest.raises(UserError, match=r"unet of .* cannot be loaded"):
        found.part("unet", torch.float32)
    shutil.rmtree(copy / "vae")
    for ask in (found.part, found.config):
        with pytest.raises(UserError, match="vae"):
            ask("vae")


@pytest.mark.parametrize("entry", [("os", "system"), ("shap_e", "Nothing"), ("shap_e.os", "system")])
def test_foreign_code_is_not_run(model, tmp_path, entry):
    index = json.loads((model / "model_index.json").read_text()) | {"unet": list(entry)}
    (tmp_path / "model_index.json").write_text(json.dumps(index))
    with pytest.raises(UserError, match=r"\.".join(entry)):
        source(path=str(tmp_path)).find(KINDS, OTHERS).part("unet", torch.float32)


def test_a_part_that_only_one_pipeline_of_diffusers_has_is_found(tmp_path):
    import pipelines
    from diffusers.pipelines.shap_e import ShapERenderer

    found = source(path=str(pipelines.shap_e(tmp_path))).find(("ShapEPipeline",), {})
    assert isinstance(found.part("shap_e_renderer", torch.float32), ShapERenderer)


def test_ids_are_tried_in_order_and_the_first_available_one_is_used(model, hub):
    hub["a/gone"] = refusal(huggingface_hub.errors.RepositoryNotFoundError)
    hub["b/gated"] = refusal(huggingface_hub.errors.GatedRepoError)
    hub["c/there"] = model / "model_index.json"
    hub["d/unasked"] = model / "model_index.json"
    found = source(ids=["a/gone", "b/gated", "c/there", "d/unasked"], revision="v1").find(KINDS, OTHERS)
    assert (found.where, found.revision) == ("c/there", "v1")
    assert hub["asked"] == [(name, "v1", False) for name in ("a/gone", "b/gated", "c/there")]


def test_if_no_id_is_available_each_has_its_reason_and_there_is_a_hint(hub):
    hub["a/gone"] = refusal(huggingface_hub.errors.RepositoryNotFoundError)
    hub["b/gated"] = refusal(huggingface_hub.errors.GatedRepoError)
    with pytest.raises(UserError, match=r"a/gone: no.*; b/gated: no.*hf download a/gone --local-dir"):
        source(ids=["a/gone", "b/gated"], revision="v1").find(KINDS, OTHERS)


def test_an_unreachable_hub_is_asked_once(hub):
    """Every request takes half a minute of retries. Models on this disk are still found."""
    for name in ("a/one", "b/two"):
        hub[name] = huggingface_hub.errors.LocalEntryNotFoundError("no")
    with pytest.raises(UserError, match=r"a/one: not on this disk, and the hub cannot be reached"):
        source(ids=["a/one", "b/two"]).find(KINDS, OTHERS)
    assert [local for _, _, local in hub["asked"]] == [False, True]


def test_offline_mode_is_respected_and_reported(hub, monkeypatch):
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", True)
    hub["a/one"] = huggingface_hub.errors.LocalEntryNotFoundError("no")
    with pytest.raises(UserError, match="HF_HUB_OFFLINE is set"):
        source(ids=["a/one"]).find(KINDS, OTHERS)
    assert hub["asked"] == [("a/one", None, True)]


def test_a_missing_extra_is_reported_with_the_command_that_installs_it(monkeypatch):
    monkeypatch.setattr(checks, "find_spec", lambda name: None if name == "diffusers" else object())
    with pytest.raises(UserError, match=r"prior: needs diffusers. Try: pip install '\.\[diffusers\]'"):
        source().find(KINDS, OTHERS)
