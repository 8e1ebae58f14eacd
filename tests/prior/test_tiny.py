"""Laws of the tiny prior, which has the interface of a real prior and random weights."""

import pytest
import torch

from cadam3d.core.cameras import turntable
from cadam3d.prior.path import DDPM, RectifiedFlow
from cadam3d.prior.tiny import MAX_TOKENS, PADDING, Tiny, tokenize

KEYS = {"predicts": "noise", "noise_path": DDPM(), "width": 16, "downscale": 2, "seed": 0}


@pytest.fixture(scope="module")
def prior():
    return Tiny(**KEYS)


def condition_of(prior, prompt="a red cube", negative="", views=2):
    cameras = turntable(views, elevation_deg=15.0, distance=3.0, fov_y_deg=40.0, size=32)
    return prior.embed(prompt, negative).at(cameras, torch.zeros(views, 3))


def noisy_of(views=2, size=(12, 12), seed=0):
    return torch.randn(views, 3, *size, generator=torch.Generator().manual_seed(seed))


def levels(views=2, value=0.5):
    return torch.full((views,), value)


def test_weights_depend_on_the_seed_alone():
    torch.manual_seed(1)
    first = Tiny(**KEYS).network.state_dict()
    torch.manual_seed(2)
    again = Tiny(**KEYS).network.state_dict()
    other = Tiny(**KEYS | {"seed": 1}).network.state_dict()
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert not torch.equal(first["enter.weight"], other["enter.weight"])


def test_the_global_random_state_does_not_change():
    before = torch.get_rng_state()
    prior = Tiny(**KEYS)
    prior.predict(noisy_of(), levels(), condition_of(prior), 7.5)
    assert torch.equal(before, torch.get_rng_state())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_prediction_keeps_the_dtype(prior, dtype):
    guess = prior.predict(noisy_of().to(dtype), levels().to(dtype), condition_of(prior), 7.5)
    assert guess.clean.dtype == guess.noise.dtype == guess.velocity.dtype == dtype


@pytest.mark.parametrize("size", [(9, 13), (31, 8)])
@pytest.mark.parametrize("downscale", [1, 3, 8])
def test_any_size_from_8_pixels_works(size, downscale):
    prior = Tiny(**KEYS | {"downscale": downscale})
    latents = prior.encode(torch.rand(1, *size, 3))
    assert latents.shape == (1, 3, -(-size[0] // downscale), -(-size[1] // downscale))
    guess = prior.predict(latents, levels(1), condition_of(prior, views=1), 7.5)
    assert guess.noise.shape == latents.shape
    assert guess.clean.isfinite().all()


@pytest.mark.parametrize("t", [0.0, 1e-4, 1.0])
def test_both_ends_of_the_path_are_finite(prior, t):
    guess = prior.predict(noisy_of(), levels(value=t), condition_of(prior), 7.5)
    assert guess.clean.isfinite().all()
    assert guess.noise.isfinite().all()


def test_encoding_passes_a_gradient_to_every_pixel(prior):
    rgb = torch.rand(1, 9, 11, 3, requires_grad=True)
    prior.encode(rgb).sum().backward()
    assert (rgb.grad > 0).all()


@pytest.mark.parametrize("size", [(8, 8), (9, 13)])
@pytest.mark.parametrize("downscale", [1, 3])
def test_encoding_inverts_decoding(size, downscale):
    prior = Tiny(**KEYS | {"downscale": downscale})
    latents = prior.encode(torch.rand(2, *size, 3, generator=torch.Generator().manual_seed(0)))
    decoded = prior.decode(latents, *size)
    assert decoded.shape == (2, *size, 3)
    torch.testing.assert_close(prior.encode(decoded), latents)


def test_decoded_images_stay_in_range_and_carry_no_gradient(prior):
    decoded = prior.decode(3 * noisy_of().requires_grad_(), 24, 24)
    assert not decoded.requires_grad
    assert (decoded.min(), decoded.max()) == (0, 1)


@pytest.mark.parametrize("scale", [7.5, -7.5])
def test_guidance_has_the_conventional_form(prior, scale):
    condition = condition_of(prior, "a red cube", "ugly")
    negative, positive, guided = (
        prior.predict(noisy_of(), levels(), condition, s).noise for s in (0.0, 1.0, scale)
    )
    torch.testing.assert_close(guided, negative + scale * (positive - negative), rtol=1e-4, atol=1e-4)


def test_unprompted_drops_both_prompts_and_keeps_the_views(prior):
    blank = condition_of(prior, "a red cube", "ugly").unprompted()
    empty = condition_of(prior, "", "")
    torch.testing.assert_close(
        prior.predict(noisy_of(), levels(), blank, 3.0).noise,
        prior.predict(noisy_of(), levels(), empty, 1.0).noise,
    )


def noise_of(prior, t=0.5, view=0, prompt="a red cube"):
    noisy = noisy_of(1).repeat(2, 1, 1, 1)
    return prior.predict(noisy, levels(value=t), condition_of(prior, prompt), 1.0).noise[view]


@pytest.mark.parametrize(
    "other", [{"prompt": "a red cone"}, {"prompt": "cube red a"}, {"view": 1}, {"t": 0.8}], ids=str
)
def test_the_prediction_depends_on_words_and_their_order_on_the_view_and_on_the_level(prior, other):
    assert (noise_of(prior) - noise_of(prior, **other)).abs().max() > 1e-4


def test_views_do_not_influence_each_other(prior):
    together = prior.predict(noisy_of(), levels(), condition_of(prior), 7.5).noise
    alone = prior.predict(noisy_of()[:1], levels(1), condition_of(prior, views=1), 7.5).noise
    torch.testing.assert_close(together[:1], alone, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("path", [DDPM(), RectifiedFlow(shift=3.0)], ids=["ddpm", "flow"])
def test_predicts_decides_what_the_output_is(path):
    """Read the output of the same network as noise and as velocity."""
    as_noise, as_velocity = (
        Tiny(**KEYS | {"noise_path": path, "predicts": p}) for p in ("noise", "velocity")
    )
    condition = condition_of(as_noise)
    noise = as_noise.predict(noisy_of(), levels(), condition, 1.0).noise
    guess = as_velocity.predict(noisy_of(), levels(), condition, 1.0)
    torch.testing.assert_close(guess.velocity, noise)
    torch.testing.assert_close(guess.clean, path.from_velocity(noisy_of(), noise, levels()).clean)


def test_tokens_are_bytes_between_start_and_padding():
    tokens = tokenize("aé").tolist()
    assert tokens[1:4] == list("aé".encode())
    assert set(tokens[4:]) == {PADDING}
    assert len(tokens) == len(tokenize("x" * 1000)) == MAX_TOKENS


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_cuda_agrees_with_the_cpu(prior):
    there = Tiny(**KEYS).to(torch.device("cuda"))
    near = prior.predict(noisy_of(), levels(), condition_of(prior), 2.0).noise
    far = there.predict(noisy_of().cuda(), levels().cuda(), condition_of(there), 2.0).noise
    torch.testing.assert_close(far.cpu(), near, rtol=1e-2, atol=1e-2)
