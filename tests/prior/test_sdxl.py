"""Laws of SDXL as a prior, compared with the pipeline of diffusers on the same folder."""

from dataclasses import replace

import pytest
import torch
from latents import KEYS, computes_in_sixteen_bits, condition_of, normal

from cadam3d.prior.sdxl import StableDiffusionXL

diffusers = pytest.importorskip("diffusers")


@pytest.fixture(scope="module")
def folder(pipelines):
    return pipelines("stable_diffusion_xl")


@pytest.fixture(scope="module")
def pipe(folder):
    return diffusers.StableDiffusionXLPipeline.from_pretrained(folder, local_files_only=True)


@pytest.fixture(scope="module")
def prior(folder, tmp_path_factory):
    cache = str(tmp_path_factory.mktemp("cache"))
    return StableDiffusionXL(path=str(folder), cache_dir=cache, **KEYS)


@pytest.mark.parametrize("negative", ["ugly", ""])
def test_texts_are_embedded_as_the_pipeline_embeds_them(prior, pipe, negative):
    """The pipeline embeds an empty negative prompt, None, as zeros, since the model's index requires it."""
    texts = prior.embed("a red cube", negative).texts
    positive, other, pooled, other_pooled = pipe.encode_prompt(
        "a red cube, side view", negative_prompt=negative or None
    )
    torch.testing.assert_close(texts.tokens[1:2], positive)
    torch.testing.assert_close(texts.pooled[1:2], pooled)
    torch.testing.assert_close(texts.tokens[-2:-1], other)
    torch.testing.assert_close(texts.pooled[-2:-1], other_pooled)
    assert bool(texts.tokens[-1].any()) is False


def test_a_model_without_the_option_for_zeros_embeds_the_empty_text(prior, pipe):
    found = replace(prior.found, index=prior.found.index | {"force_zeros_for_empty_prompt": False})
    texts = prior.embed_texts(found, [""], torch.device("cpu"))
    tokens, _, pooled, _ = pipe.encode_prompt("", do_classifier_free_guidance=False)
    torch.testing.assert_close(texts.tokens, tokens)
    torch.testing.assert_close(texts.pooled, pooled)
    assert texts.tokens.any()


@torch.no_grad()
def test_a_prediction_equals_that_of_the_pipelines_parts(prior, pipe):
    """The latents are not square, since the network reads height and width."""
    clean, noise, k, scale = normal(2, 4, 8, 12), normal(2, 4, 8, 12, seed=1), 400, 7.5
    noisy = pipe.scheduler.add_noise(clean, noise, torch.tensor([k - 1, k - 1]))
    sizes = pipe._get_add_time_ids((64, 96), (0, 0), (64, 96), torch.float32, 32).repeat(2, 1)

    def network(*prompts):
        tokens, _, pooled, _ = pipe.encode_prompt(list(prompts), do_classifier_free_guidance=False)
        added = {"text_embeds": pooled, "time_ids": sizes}
        return pipe.unet(noisy, k - 1, encoder_hidden_states=tokens, added_cond_kwargs=added).sample

    ugly = network("ugly", "ugly")
    expected = ugly + scale * (network("a red cube, front view", "a red cube, back view") - ugly)
    a = pipe.scheduler.alphas_cumprod[k - 1] ** 0.5

    t = torch.full((2,), k / 1000)
    torch.testing.assert_close(prior.noise_path.mix(clean, noise, t), noisy)
    guess = prior.predict(noisy, t, condition_of(prior), scale)
    torch.testing.assert_close(guess.noise, expected, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(guess.clean, (noisy - (1 - a**2) ** 0.5 * expected) / a, rtol=1e-4, atol=1e-4)


def test_networks_compute_in_16_bits_and_return_float32(prior):
    computes_in_sixteen_bits(prior, condition_of)


@pytest.mark.parametrize(
    ("dtype", "expected"),
    [("float16", torch.float32), ("bfloat16", torch.bfloat16), ("float32", torch.float32)],
)
def test_the_autoencoder_never_computes_in_float16(prior, dtype, expected):
    assert replace(prior, dtype=dtype).vae.dtype == expected


@pytest.mark.parametrize("vae_dtype", ["bfloat16", "float32"])
def test_the_autoencoder_may_have_its_own_precision(prior, vae_dtype):
    other = replace(prior, dtype="float16", vae_dtype=vae_dtype)
    assert (other.vae.dtype, other.torch_dtype) == (getattr(torch, vae_dtype), torch.float16)
    assert other.encode(torch.rand(1, 64, 64, 3)).dtype == torch.float32
