"""VFDS compared with its closed form on a Gaussian prior, and with SDS."""

import pytest
import torch

from cadam3d.prior.path import DDPM, RectifiedFlow, per_view

SPREAD = 0.5


@pytest.mark.parametrize("scale", [0.0, 1.0, 40.0])
def test_gradient_equals_the_closed_form(scale, path, make, run, gaussian, means, rgb):
    """v_hat - v = (b (x0 - m) - a s^2 eps) / (a^2 s^2 + b^2), m the guided mean; on either kind of path."""
    prior = gaussian(path, spread=SPREAD)
    gradient, _ = run(make("vfds", scale=scale, t_min=0.2, t_max=0.9), rgb, means, prior, seed=11)

    clean = rgb.detach().permute(0, 3, 1, 2)
    generator = torch.Generator().manual_seed(11)
    t = 0.2 + 0.7 * torch.rand(clean.shape[0], generator=generator).double()
    noise = torch.randn(clean.shape, generator=generator).double()
    a, b = per_view(path.a(t)), per_view(path.b(t))
    mean = means.negative + scale * (means.positive - means.negative)
    expected = (b * (clean - mean) - a * SPREAD**2 * noise) / (a**2 * SPREAD**2 + b**2)
    torch.testing.assert_close(gradient, expected, rtol=1e-9, atol=1e-9)


def test_gradient_is_the_residual_over_b(make, run, prior, means, rgb):
    _, output = run(make("vfds", weighting="sigma"), rgb, means, prior)
    assert output.log["guidance_rms"] == pytest.approx(float(output.log["residual_rms"]), rel=1e-9)


def test_vfds_times_a_equals_sds(path, make, run, prior, means, rgb):
    velocity, _ = run(make("vfds"), rgb, means, prior, seed=4)
    noise, _ = run(make("sds"), rgb, means, prior, seed=4)
    torch.testing.assert_close(velocity * per_view(path.a(prior.calls[-1].t)), noise, rtol=1e-8, atol=1e-9)


def test_paths_agree_at_equal_b_and_an_equal_clean_prediction(make, run, gaussian, one_image, rgb):
    """Without spread the predicted clean image is the image itself, on any path."""
    gradients = []
    for path, t in (
        (DDPM(), 0.4),
        (RectifiedFlow(), float(DDPM().b(torch.tensor([0.4], dtype=torch.float64)))),
    ):
        guidance = make("vfds", t_min=t, t_max=t)
        gradients.append(run(guidance, rgb, one_image, gaussian(path, spread=0.0))[0])
    torch.testing.assert_close(gradients[0], gradients[1], rtol=1e-7, atol=1e-9)
