"""CSD compared with its closed form on a Gaussian prior, and with SDS."""

from dataclasses import replace

import torch

from cadam3d.core.schedule import Linear
from cadam3d.prior.path import DDPM, per_view

SPREAD = 0.5


def drawn_t(views, low, high, seed):
    generator = torch.Generator().manual_seed(seed)
    return low + (high - low) * torch.rand(views, generator=generator).double()


def test_for_two_prompts_of_equal_spread_the_gradient_is_constant(path, make, run, gaussian, means, rgb):
    """The difference is eps_y - eps_n = a b (n - y) / (a^2 s^2 + b^2) for every render and every noise."""
    prior, guidance = gaussian(path, spread=SPREAD), make("csd", t_min=0.2, t_max=0.9)
    t = drawn_t(3, 0.2, 0.9, seed=11)
    a, b = per_view(path.a(t)), per_view(path.b(t))
    expected = a * b * (means.negative - means.positive) / (a**2 * SPREAD**2 + b**2)
    for render in (rgb, rgb + 1):
        gradient, _ = run(guidance, render, means, prior, seed=11)
        torch.testing.assert_close(gradient, expected, rtol=1e-9, atol=1e-9)


def test_with_a_wider_negative_prompt_the_equilibrium_is_beyond_the_image(path, make, run, gaussian, means):
    """At y + (y - n) (s_y^2 + gamma^2) / (s_n^2 - s_y^2) the mean gradient is zero."""
    t, wide = drawn_t(3, 0.2, 0.9, seed=11), 0.8
    a, b = per_view(path.a(t)), per_view(path.b(t))
    ratio = (SPREAD**2 + (b / a) ** 2) / (wide**2 - SPREAD**2)
    place = means.positive + (means.positive - means.negative) * ratio
    condition = replace(means, negative_spread=wide)
    guidance, render = make("csd", t_min=0.2, t_max=0.9), place.permute(0, 2, 3, 1)
    gradient, _ = run(guidance, render, condition, gaussian(path, spread=SPREAD), seed=11)
    generator = torch.Generator().manual_seed(11)
    torch.rand(3, generator=generator)
    noise = torch.randn(place.shape, generator=generator).double()
    narrow, broad = (1 / (a**2 * s**2 + b**2) for s in (SPREAD, wide))
    torch.testing.assert_close(gradient, b**2 * noise * (narrow - broad), rtol=1e-8, atol=1e-8)


def test_csd_is_the_part_of_sds_that_grows_with_the_guidance_scale(make, run, prior, means, rgb):
    one, four = (run(make("sds", scale=scale), rgb, means, prior, seed=3)[0] for scale in (1.0, 4.0))
    gradient, _ = run(make("csd"), rgb, means, prior, seed=3)
    torch.testing.assert_close(3 * gradient, four - one, rtol=1e-9, atol=1e-10)


def test_descent_reaches_the_image_if_the_negative_prompt_allows_any_image(
    path, make, run, gaussian, one_image, rgb
):
    """With equal spreads the gradient never vanishes; with a wide negative prompt it does at one image."""
    condition = replace(one_image, negative_spread=1e4)
    prior, render = gaussian(path, spread=0.02), rgb.detach()
    target = one_image.positive.permute(0, 2, 3, 1)
    before = (render - target).square().mean().sqrt()
    for step in range(40):
        # The pull ends at x0 + gamma eps, so the render wanders less with less noise.
        t = 0.9 * 0.88**step
        guidance = make("csd", weighting="gamma", t_min=t, t_max=t)
        gradient, _ = run(guidance, render, condition, prior, step=step, seed=step)
        render = render - 0.2 * gradient.permute(0, 2, 3, 1)
    assert (render - target).square().mean().sqrt() < 0.02 * before


def test_each_prompt_costs_one_prediction_of_a_single_branch(make, run, prior, means, rgb):
    run(make("csd"), rgb, means, prior)
    assert [(call.scale, call.condition) for call in prior.calls] == [(1.0, means), (0.0, means)]
    assert torch.equal(prior.calls[0].t, prior.calls[1].t)


def test_the_reference_mixes_the_negative_and_the_empty_prompt(make, run, prior, means, rgb):
    """The reference (1 - r) eps_n + r eps_0 moves from the negative prompt to the empty one."""
    negative, empty, mixed = (run(make("csd", empty_share=r), rgb, means, prior)[0] for r in (0.0, 1.0, 0.25))
    torch.testing.assert_close(mixed, 0.75 * negative + 0.25 * empty, rtol=1e-9, atol=1e-10)
    same = replace(means, negative=means.empty)
    torch.testing.assert_close(empty, run(make("csd"), rgb, same, prior)[0], rtol=1e-9, atol=1e-10)


def test_the_share_may_be_a_schedule_and_makes_no_unused_predictions(make, run, gaussian, means, rgb):
    guidance = make("csd", empty_share=Linear(start=1.0, end=0.0, steps=10))
    for step, asked in ((0, [means.empty]), (5, [means.empty, means]), (10, [means])):
        prior = gaussian(DDPM())
        run(guidance, rgb, means, prior, step=step)
        prompted, *against = [call.condition for call in prior.calls]
        assert prompted is means
        assert [c if c is means else c.positive for c in against] == asked
