"""SDS compared with its closed form on a Gaussian prior."""

import pytest
import torch

from cadam3d.prior.path import DDPM, per_view

LOW, HIGH, SPREAD = 0.2, 0.9, 0.5


def redraw(like, seed, dtype=torch.float64):
    """Return the t and the noise that SDS drew: first t, then noise, both in single precision."""
    generator = torch.Generator().manual_seed(seed)
    t = LOW + (HIGH - LOW) * torch.rand(like.shape[0], generator=generator).to(dtype)
    return t, torch.randn(like.shape, generator=generator).to(dtype)


@pytest.mark.parametrize("scale", [0.0, 1.0, 7.5])
def test_gradient_equals_the_closed_form(scale, path, make, run, gaussian, means, rgb):
    """eps_hat - eps = (a b (x0 - m) - a^2 s^2 eps) / (a^2 s^2 + b^2), m the guided mean."""
    guidance = make("sds", scale=scale, weighting="one_minus_abar", t_min=LOW, t_max=HIGH)
    gradient, output = run(guidance, rgb, means, gaussian(path, spread=SPREAD), seed=11)

    clean = rgb.detach().permute(0, 3, 1, 2)
    t, noise = redraw(clean, seed=11)
    a, b = per_view(path.a(t)), per_view(path.b(t))
    mean = means.negative + scale * (means.positive - means.negative)
    variance = a**2 * SPREAD**2 + b**2
    expected = b**2 * (a * b * (clean - mean) - a**2 * SPREAD**2 * noise) / variance
    torch.testing.assert_close(gradient, expected, rtol=1e-9, atol=1e-10)
    assert output.log["t"] == pytest.approx(float(t.mean()))


def test_gradient_is_the_residual_over_gamma(make, run, prior, means, rgb):
    """Paper eq. 4: G = w / gamma * (x0 - x0_hat), so with w = gamma its norm is that of the residual."""
    _, output = run(make("sds", weighting="gamma"), rgb, means, prior)
    assert output.log["guidance_rms"] == pytest.approx(float(output.log["residual_rms"]), rel=1e-9)


def test_one_guided_prediction_per_step(make, run, gaussian, means, rgb):
    prior = gaussian(DDPM())
    run(make("sds", scale=7.5), rgb, means, prior)
    assert [(call.scale, call.condition) for call in prior.calls] == [(7.5, means)]


def test_single_and_double_precision_see_the_same_noise(make, run, gaussian, means, rgb):
    single = type(means)(means.positive.float(), means.negative.float(), means.empty.float())
    double_gradient, _ = run(make("sds"), rgb, means, gaussian(DDPM()), seed=2)
    single_gradient, _ = run(make("sds"), rgb.float(), single, gaussian(DDPM()), seed=2)
    torch.testing.assert_close(single_gradient.double(), double_gradient, rtol=1e-4, atol=1e-5)
