"""Helpers of the tests of pretrained priors, and the checks that every such prior must pass."""

from collections.abc import Callable
from dataclasses import replace

import torch

from cadam3d.core.cameras import turntable
from cadam3d.prior.latent import LatentPrior, TextCondition
from cadam3d.prior.prompting import Discrete

# The keys of every pretrained prior; tests add path and cache_dir.
KEYS = {
    "ids": [],
    "revision": None,
    "variant": None,
    "prompting": Discrete(front_deg=45.0, back_deg=45.0, overhead_deg=60.0),
    "size": 64,
    "noise_levels": "table",
    "dtype": "float32",
    "vae_dtype": "auto",
    "micro_batch": None,
    "compile": False,
    "text_device": "auto",
}


def normal(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def condition_of(prior: LatentPrior, prompt="a red cube", negative="ugly", views=2) -> TextCondition:
    """Return the condition of views around the object; four of them are front, side, back and side."""
    cameras = turntable(views, elevation_deg=15.0, distance=3.0, fov_y_deg=40.0, size=64)
    return prior.embed(prompt, negative).at(cameras, torch.zeros(views, 3))


def encodes_like_the_autoencoder(prior: LatentPrior, vae) -> None:
    """Check that images are resized and that latents are the posterior's mean, shifted and scaled."""
    rgb = torch.rand(2, 48, 48, 3, generator=torch.Generator().manual_seed(1))
    images = torch.nn.functional.interpolate(rgb.permute(0, 3, 1, 2), (64, 64), mode="bilinear")
    mean = vae.encode(2 * images - 1).latent_dist.mean
    expected = (mean - (vae.config.shift_factor or 0)) * vae.config.scaling_factor
    torch.testing.assert_close(prior.encode(rgb), expected, rtol=1e-4, atol=1e-5)


def memory_is_estimated(prior: LatentPrior, views: int = 2) -> None:
    """Check that the estimate, from configurations alone, has exact weights and counts work and texts."""
    unloaded = replace(prior)
    estimate = unloaded.memory("a prompt that is not cached", "", views, None)
    assert not {"vae", "network"} & set(unloaded.__dict__)
    parameters = [*prior.network.parameters(), *prior.vae.parameters()]
    assert estimate.weights == sum(each.numel() * each.element_size() for each in parameters)
    assert estimate.working > 0
    assert estimate.texts > 0


def micro_batch_changes_nothing(
    prior: LatentPrior, size: int, condition: TextCondition, channels: int
) -> None:
    """Check that micro-batches change neither predictions, nor latents, nor the gradient on pixels."""
    few, views = replace(prior, micro_batch=size), len(condition.cameras)
    noisy, t = normal(views, channels, 8, 8), torch.full((views,), 0.4)
    guesses = [each.predict(noisy, t, condition, 7.5).clean for each in (prior, few)]
    are_close(*guesses)
    gradients = []
    for each in (prior, few):
        rgb = torch.rand(views, 64, 64, 3, generator=torch.Generator().manual_seed(2)).requires_grad_()
        latents = each.encode(rgb)
        (latents * normal(*latents.shape)).sum().backward()
        gradients.append(rgb.grad)
    assert (gradients[0].flatten(1).norm(dim=1) > 0).all()
    are_close(*gradients)


def computes_in_sixteen_bits(
    prior: LatentPrior, condition_of: Callable[[LatentPrior], TextCondition]
) -> None:
    """Check that networks in bfloat16 return float32 numbers close to those of networks in float32."""
    half = replace(prior, dtype="bfloat16")
    rgb = torch.rand(len(condition_of(prior).cameras), 64, 64, 3, generator=torch.Generator().manual_seed(3))
    latents = [each.encode(rgb) for each in (prior, half)]
    t = torch.full((len(rgb),), 0.4)
    guesses = [each.predict(latents[0], t, condition_of(each), 1.0).noise for each in (prior, half)]
    for exact, rough in (latents, guesses):
        assert rough.dtype == torch.float32
        assert 0 < (rough - exact).norm() < 0.05 * exact.norm()


def are_close(one: torch.Tensor, other: torch.Tensor) -> None:
    """Compare up to 1e-5 of the largest number, since the order of sums depends on the batch size."""
    torch.testing.assert_close(one, other, rtol=0, atol=1e-5 * float(one.abs().max()))
