"""ISM compared with its closed form on a Gaussian prior."""

from itertools import pairwise

import pytest
import torch

from cadam3d.core.schedule import Linear
from cadam3d.guidance.trajectory import ddim, strides
from cadam3d.prior.path import DDPM, RectifiedFlow, per_view

SPREAD = 0.5


def drawn_t(views, low, high, seed):
    generator = torch.Generator().manual_seed(seed)
    return low + (high - low) * torch.rand(views, generator=generator).double()


def step_factor(path, start, end, spread):
    """Return the factor by which one exact DDIM step multiplies x - a * mean."""
    a0, b0, a1, b1 = (per_view(share(t)) for t in (start, end) for share in (path.a, path.b))
    return (a1 * a0 * spread**2 + b1 * b0) / (a0**2 * spread**2 + b0**2)


@pytest.mark.parametrize("scale", [0.0, 1.0, 7.5])
def test_gradient_equals_the_closed_form(scale, path, make, run, gaussian, means, rgb):
    """Follow x - a * mean through 0 -> 0.25 -> s -> t by hand, since every step is affine."""
    keys = {"t_min": 0.4, "t_max": 0.5, "delta": 0.1, "inversion_stride": 0.25, "weighting": "gamma"}
    gradient, _ = run(make("ism", scale=scale, **keys), rgb, means, gaussian(path, spread=SPREAD), seed=11)

    clean = rgb.detach().permute(0, 3, 1, 2)
    t = drawn_t(3, 0.4, 0.5, seed=11)
    s = t - 0.1
    # Here off is x - a * mean of the empty prompt.
    now, off = torch.zeros_like(t), clean - means.empty
    for then in (torch.full_like(t, 0.25), s):
        now, off = then, off * step_factor(path, now, then, SPREAD)
    a, b = per_view(path.a(s)), per_view(path.b(s))
    noise_at_s = b * off / (a**2 * SPREAD**2 + b**2)
    off = off * step_factor(path, s, t, SPREAD)
    a, b = per_view(path.a(t)), per_view(path.b(t))
    mean = means.negative + scale * (means.positive - means.negative)
    noise_at_t = b * (off + a * (means.empty - mean)) / (a**2 * SPREAD**2 + b**2)
    torch.testing.assert_close(gradient, b / a * (noise_at_t - noise_at_s), rtol=1e-8, atol=1e-9)


def test_predictions_follow_the_published_method(make, run, prior, means, rgb):
    """Predictions are unprompted at 0, 0.2, 0.4 and s, and prompted with guidance at t."""
    keys = {"t_min": 0.6, "t_max": 0.6, "delta": 0.1, "inversion_stride": 0.2}
    run(make("ism", scale=7.5, **keys), rgb, means, prior)
    assert [float(call.t[0]) for call in prior.calls] == pytest.approx([0.0, 0.2, 0.4, 0.5, 0.6])
    *unprompted, prompted = prior.calls
    assert all(call.condition.positive is means.empty for call in unprompted)
    assert all(call.condition.negative is means.empty for call in unprompted)
    assert prompted.condition is means
    assert prompted.scale == 7.5


def test_an_interval_longer_than_t_starts_at_the_render(make, run, gaussian, means, rgb):
    prior = gaussian(DDPM())
    run(make("ism", t_min=0.02, t_max=0.04, delta=0.05), rgb, means, prior)
    assert [bool((call.t == 0).all()) for call in prior.calls] == [True, False]


def test_the_interval_may_be_a_schedule(make, run, gaussian, means, rgb):
    guidance = make("ism", delta=Linear(start=0.1, end=0.05, steps=10))
    for step, delta in ((0, 0.1), (5, 0.075), (10, 0.05)):
        prior = gaussian(DDPM())
        run(guidance, rgb, means, prior, step=step, seed=1)
        gap = prior.calls[-1].t - prior.calls[-2].t
        torch.testing.assert_close(gap, torch.full_like(gap, delta))


def test_without_initial_noise_the_gradient_is_a_function_of_t(make, run, prior, means, rgb):
    keys = {"t_min": 0.5, "t_max": 0.5}
    first, again = (run(make("ism", **keys), rgb, means, prior, seed=s)[0] for s in (0, 1))
    torch.testing.assert_close(first, again, rtol=1e-6, atol=1e-8)
    keys |= {"initial_noise": 0.002}
    first, again = (run(make("ism", **keys), rgb, means, prior, seed=s)[0] for s in (0, 1))
    assert (first - again).abs().max() > 1e-4


def test_initial_noise_is_on_the_path(path, make, run, gaussian, means, rgb):
    """The inversion starts on a x0 + b n at t = initial_noise, or at t itself if that is smaller."""
    guidance = make("ism", initial_noise=0.2, t_min=0.051, t_max=0.5, delta=0.05, inversion_stride=1.0)
    prior = gaussian(path, spread=SPREAD)
    gradient, _ = run(guidance, rgb, means, prior, seed=4)
    t = drawn_t(3, 0.051, 0.5, seed=4)
    starts = t.clamp_max(0.2)
    assert t.min() < 0.2 < t.max() - 0.05
    torch.testing.assert_close(prior.calls[0].t, starts)

    clean, generator = rgb.detach().permute(0, 3, 1, 2), torch.Generator().manual_seed(4)
    torch.rand(3, generator=generator)
    noise = torch.randn(clean.shape, generator=generator).double()
    s = torch.maximum(t - 0.05, starts)
    at_s = ddim(path.mix(clean, noise, starts), strides(starts, s, 1.0), means.unprompted(), prior)
    before = prior.predict(at_s, s, means.unprompted(), 1.0)
    after = prior.predict(path.mix(before.clean, before.noise, t), t, means, guidance.scale)
    torch.testing.assert_close(gradient, after.noise - before.noise, rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("t", [0.001, 0.002, 0.02, 0.08, 0.1, 0.15, 0.9])
def test_gradient_equals_luciddreamers_for_every_t(t, make, run, gaussian, means, rgb):
    """No prediction is made for an image that is cleaner than row 1, also where t is within delta of it.

    x0 gets noise at row 1 (t = 0.002), with an offset per channel that all views share. From there DDIM in
    strides of 200 rows leads to s = t - delta, or nowhere if that is below row 1, and one more step to t.
    """
    path, delta, lowest = DDPM(), 0.1, 0.002
    keys = {"t_min": t, "t_max": t, "delta": delta, "initial_noise": lowest, "noise_offset": 0.1}
    guidance = make("ism", scale=7.5, weighting="gamma", weight=0.1, **keys)
    gradient, _ = run(guidance, rgb, means, gaussian(path, spread=SPREAD), seed=4)

    clean, generator = rgb.detach().permute(0, 3, 1, 2), torch.Generator().manual_seed(4)
    torch.rand(3, generator=generator)
    noise = torch.randn(3, 3, 4, 5, generator=generator) + 0.1 * torch.randn(1, 3, 1, 1, generator=generator)
    first = min(lowest, t)
    levels = [first, *(k for k in (lowest + 0.2 * i for i in range(1, 5)) if k < t - delta - 1e-9)]
    levels += [t - delta] if t - delta > first else []
    every = [torch.full((3,), level, dtype=torch.float64) for level in (*levels, t)]
    # Here off is x - a * mean of the empty prompt, of which each exact step is a multiple.
    a, b = per_view(path.a(every[0])), per_view(path.b(every[0]))
    off = a * (clean - means.empty) + b * noise.double()
    for now, then in pairwise(every[:-1]):
        off = off * step_factor(path, now, then, SPREAD)
    a, b = per_view(path.a(every[-2])), per_view(path.b(every[-2]))
    noise_at_s = b * off / (a**2 * SPREAD**2 + b**2)
    off = off * step_factor(path, every[-2], every[-1], SPREAD)
    a, b = per_view(path.a(every[-1])), per_view(path.b(every[-1]))
    mean = means.negative + 7.5 * (means.positive - means.negative)
    noise_at_t = b * (off + a * (means.empty - mean)) / (a**2 * SPREAD**2 + b**2)
    torch.testing.assert_close(gradient, 0.1 * b / a * (noise_at_t - noise_at_s), rtol=1e-5, atol=1e-7)


def test_an_infinite_gamma_at_the_end_of_a_flow_gives_zero_gradients(make, run, gaussian, means, rgb):
    guidance = make("ism", weighting="gamma", t_min=1 - 1e-9, t_max=1.0)  # 1 in single precision
    single = type(means)(means.positive.float(), means.negative.float(), means.empty.float())
    gradient, output = run(guidance, rgb.float(), single, gaussian(RectifiedFlow()))
    assert (gradient == 0).all()
    assert output.log["guidance_nonfinite"] == gradient.numel()
