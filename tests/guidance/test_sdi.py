"""SDI compared with its closed form on a Gaussian prior."""

from itertools import pairwise

import pytest
import torch

from cadam3d.guidance.distill import Case
from cadam3d.prior.path import DDPM, RectifiedFlow, per_view

SPREAD = 0.5
STILL = {"overshoot": 0.0, "eta": 0.0, "t_min": 0.6, "t_max": 0.6}


def redraw(like, low, high, seed):
    """Return t, tau / overshoot and the added noise, in the order in which SDI draws them."""
    generator = torch.Generator().manual_seed(seed)
    t, tau = (torch.rand(like.shape[0], generator=generator).double() for _ in range(2))
    return low + (high - low) * t, tau, torch.randn(like.shape, generator=generator).double()


def step_factor(path, start, end):
    """Return the factor by which one exact DDIM step multiplies x - a * mean."""
    a0, b0, a1, b1 = (per_view(share(t)) for t in (start, end) for share in (path.a, path.b))
    return (a1 * a0 * SPREAD**2 + b1 * b0) / (a0**2 * SPREAD**2 + b0**2)


def invert(guidance, clean, t, condition, prior, seed=0):
    return guidance.invert(Case(clean, t, condition, prior, 0, torch.Generator().manual_seed(seed)))


@pytest.mark.parametrize("scales", [(1.0, 1.0), (7.5, -7.5), (7.5, 0.0)])
def test_gradient_equals_the_closed_form(scales, path, make, run, gaussian, means, rgb):
    """Follow 0 -> 0.25 -> 0.5 -> t' by hand, since every step is affine, with one prediction at t."""
    scale, inversion_scale = scales
    keys = {"scale": scale, "inversion_scale": inversion_scale, "inversion_stride": 0.25}
    guidance = make("sdi", overshoot=0.1, eta=0.3, t_min=0.5, t_max=0.6, **keys)
    gradient, _ = run(guidance, rgb, means, gaussian(path, spread=SPREAD), seed=11)

    clean = rgb.detach().permute(0, 3, 1, 2)
    t, tau, fresh = redraw(clean, 0.5, 0.6, seed=11)
    beyond = t + 0.1 * tau

    def guided(by):
        return means.negative + by * (means.positive - means.negative)

    now, off = torch.zeros_like(t), clean - guided(inversion_scale)
    for then in (torch.full_like(t, 0.25), torch.full_like(t, 0.5), beyond):
        now, off = then, off * step_factor(path, now, then)
    a, b = per_view(path.a(beyond)), per_view(path.b(beyond))
    noise = (off + a * guided(inversion_scale) - a * clean) / b + 0.3 * b * fresh
    a, b = per_view(path.a(t)), per_view(path.b(t))
    expected = b * (a * (clean - guided(scale)) + b * noise) / (a**2 * SPREAD**2 + b**2) - noise
    torch.testing.assert_close(gradient, expected, rtol=1e-8, atol=1e-8)


def test_with_the_published_weight_g_is_the_difference_to_the_clean_prediction(make, run, prior, means, rgb):
    """G = x0 - x0_hat, as for a mean squared error to the predicted clean image."""
    gradient, output = run(make("sdi", weighting="gamma", **STILL), rgb, means, prior)
    clean = rgb.detach().permute(0, 3, 1, 2)
    t = torch.full((3,), 0.6, dtype=torch.float64)
    noise = invert(make("sdi", **STILL), clean, t, means, prior)
    guess = prior.predict(prior.noise_path.mix(clean, noise, t), t, means, 2.0)
    torch.testing.assert_close(gradient, clean - guess.clean, rtol=1e-8, atol=1e-8)
    assert output.log["guidance_rms"] == pytest.approx(float(output.log["residual_rms"]), rel=1e-8)


def test_predictions_follow_the_published_method(make, run, prior, means, rgb):
    """There are ten steps for t = 1 and fewer for a smaller t, under the prompt and the inversion's scale."""
    keys = {"inversion_stride": 0.1, "overshoot": 0.0, "t_min": 0.35, "t_max": 0.35}
    run(make("sdi", scale=7.5, inversion_scale=-7.5, **keys), rgb, means, prior)
    *inversion, last = prior.calls
    assert [float(call.t[0]) for call in inversion] == pytest.approx([0, 0.1, 0.2, 0.3])
    assert {call.scale for call in inversion} == {-7.5}
    assert all(call.condition is means for call in prior.calls)
    assert (last.scale, float(last.t[0])) == (7.5, pytest.approx(0.35))


def test_the_rows_of_the_released_code(make, run, gaussian, means, rgb):
    """They are 0, 1, 101, ..., as long as they are before t; the last step ends at t' and may be longer."""
    prior, keys = gaussian(DDPM()), {"inversion_grid": "rows", "inversion_stride": 0.1, "overshoot": 0.1}
    t = torch.tensor([0.002, 0.395, 0.98], dtype=torch.float64)
    clean = rgb.detach().permute(0, 3, 1, 2)
    guidance = make("sdi", eta=0.0, **keys)
    noise = invert(guidance, clean, t, means, prior, seed=5)
    beyond = (t + 0.1 * torch.rand(3, generator=torch.Generator().manual_seed(5)).double()).clamp_max(1)
    assert beyond[1] > 0.402  # beyond a row that it must not visit
    for view, rows in enumerate(([0], [0, 1, 101, 201, 301], [0, 1, *range(101, 902, 100)])):
        asked = [float(call.t[view]) for call in prior.calls]
        levels = [(row + 1) / 1000 for row in rows]
        assert asked == pytest.approx([*levels, *[float(beyond[view])] * (len(asked) - len(levels))])
        # Each exact step multiplies x - a * mean.
        mean = means.negative + guidance.inversion_scale * (means.positive - means.negative)
        every = [torch.full((3,), level, dtype=torch.float64) for level in (*levels, float(beyond[view]))]
        off = clean - per_view(prior.noise_path.a(every[0])) * mean
        for now, then in pairwise(every):
            off = off * step_factor(prior.noise_path, now, then)
        a, b = per_view(prior.noise_path.a(every[-1])), per_view(prior.noise_path.b(every[-1]))
        expected = (off + a * mean - a * clean) / b
        torch.testing.assert_close(noise[view], expected[view], rtol=1e-6, atol=1e-6)


def test_the_inversion_overshoots_but_never_leaves_the_path(make, run, gaussian, means, rgb):
    """With a stride of 1 there is one step from the render, and the next prediction is at t again."""
    prior, path = gaussian(RectifiedFlow()), RectifiedFlow()
    clean, t = rgb.detach().permute(0, 3, 1, 2), torch.tensor([0.5, 0.9, 0.99], dtype=torch.float64)
    guidance = make("sdi", overshoot=0.3, eta=0.0, inversion_stride=1.0, inversion_scale=1.0)
    noise = invert(guidance, clean, t, means, prior, seed=5)
    tau = torch.rand(3, generator=torch.Generator().manual_seed(5)).double()
    beyond = (t + 0.3 * tau).clamp_max(1)
    assert (beyond == 1).any()
    assert (beyond < 1).any()
    first = prior.predict(clean, torch.zeros(3).double(), means, 1.0)
    pushed = path.mix(first.clean, first.noise, beyond)
    torch.testing.assert_close(path.mix(clean, noise, beyond), pushed, rtol=1e-9, atol=1e-9)


def test_without_overshoot_and_eta_the_gradient_is_a_function_of_t(make, run, prior, means, rgb):
    first, again = (run(make("sdi", **STILL), rgb, means, prior, seed=seed)[0] for seed in (0, 1))
    assert torch.equal(first, again)


def test_eta_adds_noise_in_proportion_to_b(path, make, gaussian, means, rgb):
    clean, t = rgb.detach().permute(0, 3, 1, 2), torch.tensor([0.2, 0.5, 0.9], dtype=torch.float64)
    still, moved = (
        invert(make("sdi", **STILL | {"eta": eta}), clean, t, means, gaussian(path)) for eta in (0, 0.3)
    )
    generator = torch.Generator().manual_seed(0)
    torch.rand(3, generator=generator)
    fresh = torch.randn(clean.shape, generator=generator).double()
    torch.testing.assert_close(moved - still, 0.3 * per_view(path.b(t)) * fresh, rtol=1e-9, atol=1e-12)


def test_views_that_share_t_share_the_overshoot(make, run, gaussian, means, rgb):
    prior = gaussian(DDPM())
    run(make("sdi", shared_t=True, overshoot=0.2, inversion_stride=0.05), rgb, means, prior)
    assert all(len(call.t.unique()) == 1 for call in prior.calls)
