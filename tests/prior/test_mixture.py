"""The closed form of the denoiser, compared with Monte Carlo estimates, with the score and by sampling."""

import math
from itertools import pairwise

import pytest
import torch
from torch import Tensor

from cadam3d.prior.mixture import Mixture
from cadam3d.prior.path import DDPM, NoisePath, RectifiedFlow, per_view

PATHS = [pytest.param(DDPM(), id="ddpm"), pytest.param(RectifiedFlow(), id="flow")]
WEIGHTS = torch.tensor([0.5, 0.3, 0.2], dtype=torch.float64)
MEANS = torch.tensor([[-0.6, 0.5], [0.7, 0.6], [0.1, -0.8]], dtype=torch.float64)  # three modes of two pixels
SIGMA = torch.tensor([0.15, 0.30], dtype=torch.float64)


# A standard deviation for each mode, as where the outlines of objects differ.
SIGMAS = torch.tensor([[0.15, 0.30], [0.40, 0.10], [0.20, 0.25]], dtype=torch.float64)
SPREADS = [pytest.param(SIGMA, id="shared"), pytest.param(SIGMAS, id="per mode")]


def small(views: int, sigma: Tensor = SIGMA) -> Mixture:
    """The same three modes in every view: one channel, one row, two pixels."""
    return Mixture(
        means=MEANS.reshape(1, 3, 1, 1, 2).expand(views, -1, -1, -1, -1),
        log_weights=WEIGHTS.log(),
        variance=sigma.square().reshape(1, -1, 1, 1, 2).expand(views, -1, -1, -1, -1),
    )


def draw(count: int, generator: torch.Generator, sigma: Tensor = SIGMA) -> Tensor:
    """Draw samples of the mixture directly."""
    mode = torch.multinomial(WEIGHTS, count, replacement=True, generator=generator)
    noise = torch.randn(count, 2, generator=generator, dtype=torch.float64)
    return (MEANS[mode] + sigma.expand(3, 2)[mode] * noise).reshape(count, 1, 1, 2)


def total_variance(mixture: Mixture, a: Tensor, b: Tensor) -> Tensor:
    return per_view(a)[:, None] ** 2 * mixture.variance + per_view(b)[:, None] ** 2


def log_density(mixture: Mixture, noisy: Tensor, a: Tensor, b: Tensor) -> Tensor:
    total = total_variance(mixture, a, b)
    norm = (2 * torch.pi * total).log().sum(dim=(1, 2, 3, 4))
    return mixture.log_joint(noisy, per_view(a)[:, None], total).logsumexp(dim=1) - 0.5 * norm


def at(path: NoisePath, t: float, views: int = 1) -> tuple[Tensor, Tensor, Tensor]:
    times = torch.full((views,), t, dtype=torch.float64)
    return times, path.a(times), path.b(times)


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("t", [0.1, 0.7])
@pytest.mark.parametrize("sigma", SPREADS)
def test_posterior_mean_equals_monte_carlo(path: NoisePath, t: float, sigma: Tensor) -> None:
    """Weight samples of the prior by the likelihood of the noisy image, without a formula of the mixture."""
    generator = torch.Generator().manual_seed(0)
    samples = draw(400_000, generator, sigma).reshape(-1, 2)
    _, a, b = at(path, t)
    for _ in range(4):
        start = draw(1, generator, sigma)
        noise = torch.randn(1, 1, 1, 2, generator=generator, dtype=torch.float64)
        noisy = per_view(a) * start + per_view(b) * noise
        weights = (-0.5 * ((noisy.reshape(2) - a * samples) / b).square().sum(1)).softmax(0)
        expected = weights @ samples
        error = (weights.square() @ (samples - expected).square()).sqrt()
        clean, predicted_noise = small(1, sigma).denoise(noisy, a, b)
        assert bool(((clean.reshape(2) - expected).abs() < 5 * error + 1e-6).all())
        from_samples = (noisy.reshape(2) - a * expected) / b
        assert bool(((predicted_noise.reshape(2) - from_samples).abs() < (5 * error + 1e-6) * a / b).all())


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("t", [0.05, 0.5, 1.0])
def test_noise_is_the_score_of_the_noisy_density(path: NoisePath, t: float) -> None:
    """Tweedie: E[eps | noisy] = -b d/dnoisy log p(noisy), by central differences of the log-density."""
    generator = torch.Generator().manual_seed(1)
    _, a, b = at(path, t)
    noisy = torch.randn(1, 1, 1, 2, generator=generator, dtype=torch.float64)
    _, noise = small(1).denoise(noisy, a, b)
    step = 1e-5
    for pixel in range(2):
        shift = torch.zeros_like(noisy)
        shift[..., pixel] = step
        above, below = (log_density(small(1), noisy + sign * shift, a, b) for sign in (1, -1))
        slope = (above - below) / (2 * step)
        torch.testing.assert_close(noise[0, 0, 0, pixel], (-b * slope)[0], rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("sigma", [0.0, 0.2])
@pytest.mark.parametrize("t", [0.0, 1e-7, 1 - 1e-7, 1.0])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_ends_of_the_path_are_finite(path: NoisePath, sigma: float, t: float, dtype: torch.dtype) -> None:
    times = torch.full((2,), t, dtype=dtype)
    mixture = small(2, torch.full((2,), sigma, dtype=torch.float64))
    mixture = Mixture(*(getattr(mixture, name).to(dtype) for name in ("means", "log_weights", "variance")))
    clean, noise = mixture.denoise(torch.ones(2, 1, 1, 2, dtype=dtype), path.a(times), path.b(times))
    assert bool(clean.isfinite().all())
    assert bool(noise.isfinite().all())
    if sigma > 0 and t == 0:
        # The posterior mean of a clean image is the image itself.
        torch.testing.assert_close(clean, torch.ones(2, 1, 1, 2, dtype=dtype))


def test_pure_noise_gives_the_mean_of_the_mixture() -> None:
    _, a, b = at(RectifiedFlow(), 1.0)
    noisy = torch.tensor([[[[3.0, -2.0]]]], dtype=torch.float64)
    clean, noise = small(1).denoise(noisy, a, b)
    torch.testing.assert_close(clean.reshape(2), WEIGHTS @ MEANS)
    torch.testing.assert_close(noise, noisy)


def test_without_spread_and_noise_the_nearest_mode_is_returned() -> None:
    _, a, b = at(DDPM(), 0.0)
    noisy = (MEANS[1] + 0.05).reshape(1, 1, 1, 2)
    clean, noise = small(1, torch.zeros(2, dtype=torch.float64)).denoise(noisy, a, b)
    torch.testing.assert_close(clean.reshape(2), MEANS[1])
    assert float(noise.abs().max()) == 0.0


def test_large_images_do_not_underflow() -> None:
    """The density of an image of 100,000 pixels is below the smallest float; responsibilities stay right."""
    means = torch.stack([torch.zeros(3, 200, 200), torch.full((3, 200, 200), 0.01)])[None]
    mixture = Mixture(means, torch.full((2,), math.log(0.5)), torch.full((1, 1, 3, 200, 200), 0.04))
    noisy = torch.full((1, 3, 200, 200), 0.005)
    clean, _ = mixture.denoise(noisy, torch.ones(1), torch.full((1,), 0.5))
    torch.testing.assert_close(clean, noisy, atol=1e-5, rtol=0)


def check_recovered(samples: Tensor) -> None:
    """Check mode weights, means and spread within five standard errors and the bias of the steps."""
    flat, count = samples.reshape(-1, 2), samples.shape[0]
    mode = ((flat[:, None] - MEANS) / SIGMA).square().sum(-1).argmin(1)
    shares = torch.bincount(mode, minlength=3).double() / count
    torch.testing.assert_close(shares, WEIGHTS, atol=5 * math.sqrt(0.25 / count), rtol=0)
    for index in range(3):
        chosen = flat[mode == index]
        error = SIGMA / math.sqrt(len(chosen))
        assert bool(((chosen.mean(0) - MEANS[index]).abs() < 5 * error + 0.01).all())
        torch.testing.assert_close(chosen.std(0), SIGMA, rtol=5 / math.sqrt(2 * len(chosen)), atol=0)


@pytest.mark.parametrize("path", PATHS)
def test_ode_sampling_recovers_the_distribution(path: NoisePath) -> None:
    """DDIM steps (Euler steps of the velocity on the flow) carry noise to the mixture."""
    count, generator = 3000, torch.Generator().manual_seed(3)
    times = torch.linspace(1, 0, 151, dtype=torch.float64) ** 2  # finer where the image appears
    mixture = small(count)
    _, a, b = at(path, 1.0, count)
    pure = torch.randn(count, 1, 1, 2, generator=generator, dtype=torch.float64)
    x = per_view(a) * draw(count, generator) + per_view(b) * pure  # DDPM keeps some signal at t = 1
    for now, then in pairwise(times):
        _, a, b = at(path, float(now), count)
        clean, noise = mixture.denoise(x, a, b)
        x = path.mix(clean, noise, then.expand(count))
    check_recovered(x)


def test_ancestral_sampling_recovers_the_distribution() -> None:
    """The sampler of DDPM draws from the posterior q(x_s | x_t, clean), with new noise at each step."""
    path, count, generator = DDPM(), 3000, torch.Generator().manual_seed(4)
    times = torch.linspace(1, 0, 301, dtype=torch.float64) ** 2
    mixture = small(count)
    _, a, b = at(path, 1.0, count)
    pure = torch.randn(count, 1, 1, 2, generator=generator, dtype=torch.float64)
    x = per_view(a) * draw(count, generator) + per_view(b) * pure
    for now, then in pairwise(times):
        _, a, b = at(path, float(now), count)
        _, a_next, b_next = at(path, float(then), count)
        clean, noise = mixture.denoise(x, a, b)
        fresh = b_next / b * (b**2 - (a / a_next * b_next) ** 2).clamp_min(0).sqrt()
        kept = (b_next**2 - fresh**2).clamp_min(0).sqrt()
        new = torch.randn(count, 1, 1, 2, generator=generator, dtype=torch.float64)
        x = per_view(a_next) * clean + per_view(kept) * noise + per_view(fresh) * new
    check_recovered(x)
