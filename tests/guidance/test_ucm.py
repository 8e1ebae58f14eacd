"""UCM compared with its closed form on a Gaussian prior, and the laws of the coupling."""

import pytest
import torch

from cadam3d.guidance.distill import Case
from cadam3d.prior.path import DDPM, RectifiedFlow, per_view

SPREAD = 0.5


def drawn_t(views, low, high, seed):
    generator = torch.Generator().manual_seed(seed)
    return low + (high - low) * torch.rand(views, generator=generator).double(), generator


def step_factor(path, start, end):
    """Return the factor by which one exact DDIM step multiplies x - a * mean."""
    ends = torch.tensor([start, end], dtype=torch.float64)
    (a0, a1), (b0, b1) = path.a(ends), path.b(ends)
    return (a1 * a0 * SPREAD**2 + b1 * b0) / (a0**2 * SPREAD**2 + b0**2)


def case_of(clean, prior, condition, t=0.5):
    levels = torch.full((len(clean),), t, dtype=clean.dtype)
    return Case(clean, levels, condition, prior, 0, torch.Generator().manual_seed(0))


@pytest.mark.parametrize("scale", [0.0, 1.0, 40.0])
def test_gradient_equals_the_closed_form(scale, path, make, run, gaussian, means, rgb):
    """Take four affine steps along the trajectory of the empty prompt, and one prediction under guidance."""
    guidance = make("ucm", scale=scale, inversion_steps=4, t_min=0.2, t_max=0.9)
    gradient, _ = run(guidance, rgb, means, gaussian(path, spread=SPREAD), seed=11)

    clean, end = rgb.detach().permute(0, 3, 1, 2), torch.ones(1, dtype=torch.float64)
    off = clean - means.empty
    for start in (0.0, 0.25, 0.5, 0.75):
        off = off * step_factor(path, start, start + 0.25)
    noise = (off + path.a(end) * (means.empty - clean)) / path.b(end)
    t, _ = drawn_t(3, 0.2, 0.9, seed=11)
    a, b = per_view(path.a(t)), per_view(path.b(t))
    mean = means.negative + scale * (means.positive - means.negative)
    expected = (b * (clean - mean) - a * SPREAD**2 * noise) / (a**2 * SPREAD**2 + b**2)
    torch.testing.assert_close(gradient, expected, rtol=1e-9, atol=1e-9)


def test_on_a_flow_the_noise_is_the_end_of_the_euler_steps(make, run, gaussian, means, rgb):
    """FlowDreamer takes three steps of a third each, the first from sigma = 0."""
    prior = gaussian(RectifiedFlow(shift=3.0))
    guidance = make("ucm", scale=40.0, inversion_grid="sigma", t_min=0.6, t_max=0.6)
    gradient, _ = run(guidance, rgb, means, prior)
    clean = rgb.detach().permute(0, 3, 1, 2)
    noise = clean
    for sigma in (0.0, 1 / 3, 2 / 3):
        t = torch.full((3,), sigma / (3 - 2 * sigma), dtype=torch.float64)
        noise = noise + prior.predict(noise, t, means.unprompted(), 1.0).velocity / 3
    t = torch.full((3,), 0.6, dtype=torch.float64)
    sigma = 1.8 / 2.2
    guess = prior.predict((1 - sigma) * clean + sigma * noise, t, means, 40.0)
    torch.testing.assert_close(gradient, guess.velocity - (noise - clean), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    ("grid", "sigmas"),
    [
        ("sigma", [0, 1 / 3, 2 / 3]),
        ("t", [0, 0.5, 0.75, 0.9]),
        ("rows", [0, *(3 * t / (1 + 2 * t) for t in (0.25, 0.499, 0.748))]),
        ("rows", [0, *(3 * t / (1 + 2 * t) for t in (0.333, 0.665))]),
        ("rows", [0]),
    ],
)
def test_the_published_grids(grid, sigmas, make, run, gaussian, means, rgb):
    """The second grid is even in t, to which Stable Diffusion 3 applies the shift 3.

    The third has the entries 249, 498 and 747 of a list of the levels 0.001, 0.002, ..., 1, or 332 and 664.
    """
    path = RectifiedFlow(shift=3.0)
    prior = gaussian(path)
    run(make("ucm", inversion_grid=grid, inversion_steps=len(sigmas)), rgb, means, prior)
    asked = [call.t for call in prior.calls[:-1]]
    for t, sigma in zip(asked, sigmas, strict=True):
        torch.testing.assert_close(path.b(t), torch.full_like(t, sigma))
    assert (asked[0] == 0).all()


@pytest.mark.parametrize("steps", [1, 5])
def test_predictions_follow_the_published_method(steps, path, make, run, gaussian, means, rgb):
    """Predictions are unprompted along the grid, which is even in b; the last one is prompted and guided."""
    prior = gaussian(path)
    run(make("ucm", scale=40.0, inversion_steps=steps, inversion_grid="sigma"), rgb, means, prior)
    *unprompted, prompted = prior.calls
    assert len(unprompted) == steps
    assert all(call.condition.positive is call.condition.negative is means.empty for call in unprompted)
    levels = torch.stack([*(path.b(call.t) for call in unprompted), path.b(torch.ones_like(prompted.t))])
    torch.testing.assert_close(levels.diff(dim=0), levels[-1:].expand(steps, -1) / steps)
    assert (prompted.condition, prompted.scale) == (means, 40.0)


def test_pair_and_trajectory_end_at_the_same_point(path, make, gaussian, means, rgb):
    """On a DDPM path a part of the render remains at t = 1; it must not be counted twice."""
    clean, prior = rgb.detach().permute(0, 3, 1, 2), gaussian(path)
    noise = make("ucm", inversion_steps=2).couple(case_of(clean, prior, means))
    pushed = clean
    for t in (0.0, 0.5):
        guess = prior.predict(pushed, torch.full((3,), t).double(), means.unprompted(), 1.0)
        pushed = path.mix(guess.clean, guess.noise, torch.full((3,), t + 0.5).double())
    torch.testing.assert_close(path.mix(clean, noise, torch.ones(3).double()), pushed, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("shift", [1.0, 3.0])
def test_the_noise_of_an_image_is_its_standard_score(shift, make, gaussian, means, rgb):
    """Fine steps approach the unique coupling of a Gaussian distribution with pure noise."""
    clean, prior = rgb.detach().permute(0, 3, 1, 2), gaussian(RectifiedFlow(shift=shift), spread=SPREAD)
    errors = []
    for steps in (40, 80):
        guidance = make("ucm", inversion_steps=steps, inversion_grid="sigma")
        noise = guidance.couple(case_of(clean, prior, means))
        errors.append(float((noise - (clean - means.empty) / SPREAD).abs().max()))
    assert errors[1] < 0.2
    assert errors[1] == pytest.approx(errors[0] / 2, rel=0.1)  # a first-order method


def test_the_gradient_is_a_function_of_t(make, run, prior, means, rgb):
    guidance = make("ucm", t_min=0.5, t_max=0.5)
    first, again = (run(guidance, rgb, means, prior, seed=seed)[0] for seed in (0, 1))
    assert torch.equal(first, again)


def test_fresh_noise_enters_in_proportion_to_b(path, make, run, gaussian, means, rgb):
    """eps* <- (1 - b / 2) eps* + b / 2 eps', as in FlowDreamer's variant with Perp-Neg."""
    prior, clean = gaussian(path), rgb.detach().permute(0, 3, 1, 2)
    gradient, _ = run(make("ucm", fresh_noise=0.5, t_min=0.3, t_max=0.8), rgb, means, prior, seed=4)
    t, generator = drawn_t(3, 0.3, 0.8, seed=4)
    fresh = torch.randn(clean.shape, generator=generator).double()
    noise = make("ucm").couple(case_of(clean, prior, means))
    b = per_view(path.b(t))
    noise = noise + b / 2 * (fresh - noise)
    velocity = prior.predict(path.mix(clean, noise, t), t, means, 2.0).velocity
    torch.testing.assert_close(gradient, velocity - path.velocity(clean, noise, t), rtol=1e-7, atol=1e-8)


def test_gradient_is_the_residual_over_b(make, run, prior, means, rgb):
    _, output = run(make("ucm", weighting="sigma"), rgb, means, prior)
    assert output.log["guidance_rms"] == pytest.approx(float(output.log["residual_rms"]), rel=1e-9)


def test_the_coupling_works_in_half_precision(make, gaussian, one_image):
    """Levels are never in half precision, and fresh noise in half precision can be added."""
    prior = gaussian(DDPM())
    render = one_image.positive.to(torch.bfloat16).permute(0, 2, 3, 1).requires_grad_()
    guidance = make("ucm", fresh_noise=0.5)
    guidance(render, one_image, prior, 0, torch.Generator().manual_seed(0)).loss.backward()
    assert all(call.t.dtype == torch.float32 for call in prior.calls)
    assert render.grad.isfinite().all()
