"""Laws of Stable Diffusion 3 as a prior, compared with the pipeline of diffusers on the same folder."""

import shutil
from dataclasses import replace

import pytest
import torch
from latents import (
    KEYS,
    computes_in_sixteen_bits,
    condition_of,
    encodes_like_the_autoencoder,
    memory_is_estimated,
    micro_batch_changes_nothing,
    normal,
)

from cadam3d.core.errors import UserError
from cadam3d.io.jsonl import read_json, write_json
from cadam3d.prior.path import RectifiedFlow
from cadam3d.prior.stable_diffusion_3 import StableDiffusion3

diffusers = pytest.importorskip("diffusers")


@pytest.fixture(scope="module")
def folder(pipelines):
    return pipelines("stable_diffusion_3")


@pytest.fixture(scope="module")
def pipe(folder):
    return diffusers.StableDiffusion3Pipeline.from_pretrained(folder, local_files_only=True)


@pytest.fixture(scope="module")
def prior(folder, tmp_path_factory):
    cache = str(tmp_path_factory.mktemp("cache"))
    return StableDiffusion3(path=str(folder), t5=True, cache_dir=cache, **KEYS | {"noise_levels": "any"})


def zeros_repeated(tokens):
    """Return the tokens of a prior without T5 as the pipeline has them: one zero stands for 256."""
    assert tokens.shape[1] == 77 + 1
    assert not tokens[:, -1].any()
    return torch.cat([tokens, tokens[:, -1:].expand(-1, 255, -1)], dim=1)


def embeds_as_the_pipeline(prior, pipe):
    texts = prior.embed("a red cube", "ugly").texts
    if "text_encoder_3" not in prior.encoders:
        texts = replace(texts, tokens=zeros_repeated(texts.tokens))
    prompt = "a red cube, side view"
    positive, negative, pooled, other_pooled = pipe.encode_prompt(
        prompt, prompt, prompt, negative_prompt="ugly"
    )
    torch.testing.assert_close(texts.tokens[1:2], positive)
    torch.testing.assert_close(texts.pooled[1:2], pooled)
    torch.testing.assert_close(texts.tokens[-2:-1], negative)
    torch.testing.assert_close(texts.pooled[-2:-1], other_pooled)
    _, empty, _, empty_pooled = pipe.encode_prompt(prompt, prompt, prompt)
    torch.testing.assert_close(texts.tokens[-1:], empty)
    torch.testing.assert_close(texts.pooled[-1:], empty_pooled)


def test_texts_are_embedded_as_the_pipeline_embeds_them(prior, pipe):
    embeds_as_the_pipeline(prior, pipe)


def test_texts_are_embedded_as_the_pipeline_embeds_them_without_t5(prior, folder):
    pipe = diffusers.StableDiffusion3Pipeline.from_pretrained(folder, text_encoder_3=None, tokenizer_3=None)
    embeds_as_the_pipeline(replace(prior, t5=False), pipe)


def test_t5_may_be_missing_if_it_is_not_used(prior, folder, tmp_path):
    """Neither T5 nor its tokenizer is searched, so neither is downloaded from the hub."""
    unwanted = ("text_encoder_3", "tokenizer_3", "tokens")
    shutil.copytree(folder, tmp_path / "model", ignore=shutil.ignore_patterns(*unwanted))
    there = replace(prior, path=str(tmp_path / "model"), t5=False)
    assert there.found.has("text_encoder_3")
    expected = replace(prior, t5=False).embed("a red cube", "").texts.tokens
    torch.testing.assert_close(there.embed("a red cube", "").texts.tokens, expected)
    with pytest.raises(UserError, match="text_encoder_3"):
        replace(there, t5=True).embed("a red cube", "")


def test_embeddings_with_and_without_t5_are_cached_separately(prior):
    with_t5, without = (replace(prior, t5=t5).embed("a red cube", "").texts.tokens for t5 in (True, False))
    torch.testing.assert_close(with_t5[:, :77], without[:, :77])
    assert with_t5[:, 77:].any()
    assert not zeros_repeated(without)[:, 77:].any()


@torch.no_grad()
@pytest.mark.parametrize("t5", [True, False])
def test_a_prediction_equals_that_of_the_pipelines_parts(prior, folder, pipe, t5):
    """The scheduler's table of sigmas includes the shift: row i is t = 1 - i / 1000.

    Without T5, the pipeline's transformer reads 256 zeros, and the prior's reads one that counts as often.
    """
    if not t5:
        none = {"text_encoder_3": None, "tokenizer_3": None}
        pipe = diffusers.StableDiffusion3Pipeline.from_pretrained(folder, **none)
        prior = replace(prior, t5=False)
    clean, noise, row, scale = normal(2, 16, 8, 8), normal(2, 16, 8, 8, seed=1), 600, 7.5
    sigma, timestep = pipe.scheduler.sigmas[row], pipe.scheduler.timesteps[row]
    noisy = pipe.scheduler.scale_noise(clean, timestep[None], noise)

    def network(*prompts):
        listed = list(prompts)
        tokens, _, pooled, _ = pipe.encode_prompt(listed, listed, listed, do_classifier_free_guidance=False)
        return pipe.transformer(
            noisy, timestep=timestep.expand(2), encoder_hidden_states=tokens, pooled_projections=pooled
        ).sample

    ugly = network("ugly", "ugly")
    expected = ugly + scale * (network("a red cube, front view", "a red cube, back view") - ugly)

    t = torch.full((2,), 1 - row / 1000)
    torch.testing.assert_close(prior.noise_path.timestep(t), timestep.expand(2))
    torch.testing.assert_close(prior.noise_path.mix(clean, noise, t), noisy)
    guess = prior.predict(noisy, t, condition_of(prior), scale)
    torch.testing.assert_close(guess.velocity, expected, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(guess.clean, noisy - sigma * expected, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(guess.noise, noisy + (1 - sigma) * expected, rtol=1e-4, atol=1e-4)


def test_the_shift_is_the_models_own(prior, folder, tmp_path):
    assert prior.noise_path == RectifiedFlow(shift=3.0)
    shutil.copytree(folder / "scheduler", tmp_path / "scheduler")
    shutil.copy(folder / "model_index.json", tmp_path)
    file = tmp_path / "scheduler" / "scheduler_config.json"
    settings = read_json(file)
    write_json(file, settings | {"shift": 1.5})
    assert replace(prior, path=str(tmp_path)).noise_path == RectifiedFlow(shift=1.5)
    write_json(file, settings | {"use_dynamic_shifting": True})
    with pytest.raises(UserError, match=r"^prior\.path: expected a model with one shift"):
        replace(prior, path=str(tmp_path)).noise_path  # noqa: B018


def test_latents_are_those_of_the_pipelines_autoencoder(prior, pipe):
    assert pipe.vae.config.shift_factor
    encodes_like_the_autoencoder(prior, pipe.vae)


def test_networks_compute_in_16_bits_and_return_float32(prior):
    computes_in_sixteen_bits(prior, condition_of)


@pytest.mark.parametrize(
    ("capability", "network", "autoencoder"),
    [((7, 5), torch.float16, torch.float32), ((8, 0), torch.bfloat16, torch.bfloat16)],
)
def test_a_gpu_without_bfloat16_computes_in_float16(prior, monkeypatch, capability, network, autoencoder):
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: capability)
    there = replace(prior, dtype="auto").to(torch.device("cuda"))
    assert (there.torch_dtype, there._vae_dtype) == (network, autoencoder)


def test_memory_is_estimated(prior):
    memory_is_estimated(prior)


def test_micro_batch_does_not_change_results(prior):
    micro_batch_changes_nothing(prior, size=1, condition=condition_of(prior), channels=16)
