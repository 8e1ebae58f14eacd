"""GCS compared with the published loss, differentiated by autograd, and the laws of its parts."""

import pytest
import torch

from cadam3d.core.cameras import turntable
from cadam3d.core.errors import UserError
from cadam3d.core.schedule import Linear
from cadam3d.guidance.distill import Case
from cadam3d.prior.path import DDPM, RectifiedFlow, per_view
from cadam3d.prior.tiny import Tiny

ALONE = {"cc": (1.0, 0.0, 0.0), "gc": (0.0, 1.0, 0.0), "cp": (0.0, 0.0, 1.0)}
ALL = (1.0, 0.5, 0.5)


def weights_of(w_cc, w_gc, w_cp):
    return {"w_cc": w_cc, "w_gc": w_gc, "w_cp": w_cp}


def redraw(like, low, high, delta, seed):
    """Return t, s, e and the noise, in the order in which GCS draws them."""
    generator = torch.Generator().manual_seed(seed)
    t, share = (torch.rand(like.shape[0], generator=generator).double() for _ in range(2))
    t = low + (high - low) * t
    lowest, highest = t - 2 * delta, t - delta - 0.01
    noise = torch.randn(like.shape, generator=generator).double()
    return t, t - delta, lowest + (highest - lowest) * share, noise


def published_loss(rgb, path, prior, condition, draws, weights):
    """Return the published loss, with constants detached and gradients by autograd; B = 1, lambda = 1."""
    t, s, e, noise = draws
    w_cc, w_gc, w_cp = weights
    empty = condition.unprompted()

    def eps(x, at, prompt, scale):
        return prior.predict(x.detach(), at, prompt, scale).noise

    def phi(x, p, q, guess):  # DPM-Solver++ of order 1
        a_p, b_p, a_q, b_q = (per_view(f(at)) for at in (p, q) for f in (path.a, path.b))
        return a_q / a_p * x + (b_q - a_q * b_p / a_p) * guess

    def original(x, at, guess):
        return (x - per_view(path.b(at)) * guess) / per_view(path.a(at))

    x_0 = rgb.permute(0, 3, 1, 2)
    x_e = per_view(path.a(e)) * x_0 + per_view(path.b(e)) * noise
    eps_e = eps(x_e, e, empty, 1.0)
    x_s = phi(x_e, e, s, eps_e)
    x_t = phi(x_s, s, t, eps(x_s, s, empty, 1.0))
    eps_t = eps(x_t, t, condition, 2.0)
    y_s, y_e = phi(x_t, t, s, eps_t), phi(x_t, t, e, eps_t)
    bent = phi(y_s, s, e, eps(y_s, s, empty, 1.0)).detach()
    cc = (phi(x_t, t, e, eps(x_t, t, empty, 1.0)) - bent).square().sum()
    now = original(x_e, e, eps_e)
    wanted = original(y_e, e, eps(y_e, e, condition, 2.0)).detach()
    gc = (now - wanted).square().sum()
    # The decoder of this prior is the identity.
    moved = (x_0 + wanted - now).detach()
    cp = (x_0 - moved).square().sum()
    return w_cc * cc + w_gc * gc + w_cp * cp


@pytest.mark.parametrize("weights", [*ALONE.values(), ALL], ids=[*ALONE, "all"])
def test_gradient_is_that_of_the_published_loss(weights, path, make, run, gaussian, means, rgb):
    """Check with autograd that the slopes through chains of DDIM steps telescope."""
    prior, window = gaussian(path), {"t_min": 0.4, "t_max": 0.9, "delta": 0.1}
    gradient, _ = run(make("gcs", **window, **weights_of(*weights)), rgb, means, prior, seed=11)
    draws = redraw(rgb.permute(0, 3, 1, 2), 0.4, 0.9, 0.1, seed=11)
    loss = published_loss(rgb, path, prior, means, draws, weights)
    (expected,) = torch.autograd.grad(loss, rgb)
    torch.testing.assert_close(gradient, expected.permute(0, 3, 1, 2), rtol=1e-8, atol=1e-8)


def test_the_terms_add_up_and_are_logged_with_their_weights(make, run, prior, means, rgb):
    total, output = run(make("gcs"), rgb, means, prior, seed=3)
    parts, logs = {}, {}
    for name, alone in ALONE.items():
        weights = [w * own for w, own in zip(ALL, alone, strict=True)]
        parts[name], out = run(make("gcs", **weights_of(*weights)), rgb, means, prior, seed=3)
        logs[name] = out.log
    torch.testing.assert_close(sum(parts.values()), total, rtol=1e-9, atol=1e-10)
    for name, part in parts.items():
        size = float(part.square().mean().sqrt())
        assert output.log[f"{name}_rms"] == pytest.approx(size, rel=1e-9)
        assert logs[name][f"{name}_rms"] == pytest.approx(size, rel=1e-9)
        assert [logs[name][f"{other}_rms"] for other in ALONE if other != name] == [0, 0]
    both = parts["cc"] + parts["gc"]
    assert output.log["guidance_rms"] == pytest.approx(float(both.square().mean().sqrt()), rel=1e-9)
    halves = 0.5 * (both.square().sum() + parts["cp"].square().sum())
    assert output.loss.item() == pytest.approx(float(halves), rel=1e-9)


def test_the_noise_averages_out_to_a_pull_towards_the_image(make, run, gaussian, one_among_many, rgb):
    """If the prompt determines the image m and the empty prompt allows any, GC is x0 + gamma n - m."""
    guidance = make("gcs", t_min=0.5, t_max=0.5, **weights_of(*ALONE["gc"]))
    prior, count = gaussian(DDPM(), spread=0.0), 40
    offset = rgb.detach().permute(0, 3, 1, 2) - one_among_many.positive
    draws = torch.stack([run(guidance, rgb, one_among_many, prior, seed=seed)[0] for seed in range(count)])
    z = (draws.mean(dim=0) - 2 * offset) / (draws.std(dim=0) / count**0.5)
    assert z.abs().max() < 4.5


def test_descent_reaches_the_image(path, make, run, gaussian, one_among_many, rgb):
    """The remaining distance shrinks with the noise, which GC cannot distinguish from the render."""
    prior, render = gaussian(path, spread=0.02), rgb.detach()
    target = one_among_many.positive.permute(0, 2, 3, 1)
    before = (render - target).square().mean().sqrt()
    for step in range(20):
        t = 0.05 + 0.9 * 0.7**step
        guidance = make("gcs", t_min=t, t_max=t, delta=0.03)
        gradient, _ = run(guidance, render, one_among_many, prior, step=step, seed=step)
        render = render - 0.2 * gradient.permute(0, 2, 3, 1)
    assert (render - target).square().mean().sqrt() < 0.1 * before


# --- levels and noise


def test_the_levels_keep_their_distances(make, rgb):
    clean, levels = rgb.detach().permute(0, 3, 1, 2), []
    for seed in range(200):
        generator = torch.Generator().manual_seed(seed)
        levels.append(make("gcs", delta=0.05).draw_levels(clean, 0, generator))
    e, s, t = (torch.cat([getattr(level, name) for level in levels]) for name in "est")
    torch.testing.assert_close(t - s, torch.full_like(t, 0.05))
    assert (s >= e).all()
    assert e.min() >= 0.001
    assert t.min() >= 0.051
    inside = t > 0.1
    assert ((t - e)[inside] <= 0.1 + 1e-9).all()
    assert ((s - e)[inside] >= 0.01 - 1e-9).all()
    assert (t - e)[inside].min() < 0.061
    assert (t - e)[inside].max() > 0.099


def test_the_smallest_t_leaves_room_below(make, run, gaussian, means, rgb):
    prior = gaussian(DDPM())
    _, output = run(make("gcs", t_min=0.0, t_max=0.0, delta=0.08), rgb, means, prior)
    assert output.log["t"] == pytest.approx(0.081)
    assert sorted({round(float(t), 6) for call in prior.calls for t in call.t}) == [0.001, 0.081]


def test_the_window_may_slide_and_the_interval_shrink(make, run, gaussian, means, rgb):
    """The published t goes from [0.5, 0.98) to [0.02, 0.5), and delta from 0.1 to 0.08."""
    guidance = make(
        "gcs",
        t_min=Linear(start=0.5, end=0.02, steps=10),
        t_max=Linear(start=0.98, end=0.5, steps=10),
        delta=Linear(start=0.1, end=0.08, steps=10),
    )
    for step, low, high, delta in ((0, 0.5, 0.98, 0.1), (5, 0.26, 0.74, 0.09), (10, 0.081, 0.5, 0.08)):
        for seed in range(5):
            prior = gaussian(DDPM())
            run(guidance, rgb, means, prior, step=step, seed=seed)
            s, t = prior.calls[1].t, prior.calls[2].t
            assert ((low <= t) & (t < high)).all()
            torch.testing.assert_close(t - s, torch.full_like(t, delta))


def test_fixed_noise_is_the_same_at_every_step_and_after_a_restart(make, run, gaussian, means, rgb):
    """A checkpoint keeps the state of the generator, which includes its seed."""
    clean, generator = rgb.detach().permute(0, 3, 1, 2), torch.Generator().manual_seed(7)

    def noise_of(guidance, source):
        t = torch.full((3,), 0.5, dtype=torch.float64)
        return guidance.draw_noise(Case(clean, t, means, gaussian(DDPM()), 0, source))

    fixed, fresh = make("gcs", fixed_noise=True), make("gcs", fixed_noise=False)
    first = noise_of(fixed, generator)
    fixed(rgb, means, gaussian(DDPM()), 0, generator)  # a step, with its draws
    assert torch.equal(noise_of(fixed, generator), first)
    restarted = torch.Generator()
    restarted.set_state(generator.get_state())
    assert torch.equal(noise_of(fixed, restarted), first)
    assert not torch.equal(noise_of(fixed, torch.Generator().manual_seed(8)), first)
    assert not torch.equal(noise_of(fresh, generator), noise_of(fresh, generator))
    assert float(first.std()) == pytest.approx(1, abs=0.2)


def test_the_noise_has_an_offset_per_channel_that_all_views_share(make, gaussian, means, rgb):
    """As in the released code, the offset is part of the noise that is kept for the whole run."""
    clean = rgb.detach().permute(0, 3, 1, 2)

    def noise_of(guidance):
        t, generator = torch.full((3,), 0.5, dtype=torch.float64), torch.Generator().manual_seed(7)
        return guidance.draw_noise(Case(clean, t, means, gaussian(DDPM()), 0, generator))

    for fixed, seed in ((True, 8), (False, 7)):
        generator = torch.Generator().manual_seed(seed)
        plain = torch.randn(3, 3, 4, 5, generator=generator).double()
        offset = torch.randn(1, 3, 1, 1, generator=generator).double()
        moved = noise_of(make("gcs", fixed_noise=fixed, noise_offset=0.1))
        torch.testing.assert_close(moved, plain + 0.1 * offset)
        assert torch.equal(noise_of(make("gcs", fixed_noise=fixed)), plain)


def test_with_fixed_noise_only_the_levels_are_drawn(make, means, gaussian, rgb):
    generator, levels_only = (torch.Generator().manual_seed(3) for _ in range(2))
    make("gcs", fixed_noise=True)(rgb, means, gaussian(DDPM()), 0, generator)
    torch.rand(3, generator=levels_only)
    torch.rand(3, generator=levels_only)
    assert torch.equal(generator.get_state(), levels_only.get_state())


# --- cost


def test_predictions_follow_the_published_method(make, run, gaussian, means, rgb):
    prior = gaussian(DDPM())
    run(make("gcs", t_min=0.5, t_max=0.5, delta=0.05), rgb, means, prior)
    asked = [(round(float(call.t[0]), 6), call.condition is means, call.scale) for call in prior.calls]
    e = asked[0][0]
    assert 0.4 <= e < 0.44
    assert asked == [
        (e, False, 1.0),
        (0.45, False, 1.0),
        (0.5, True, 2.0),
        (0.5, False, 1.0),
        (0.45, False, 1.0),
        (e, True, 2.0),
    ]
    assert all(
        c.condition.positive is c.condition.negative is means.empty for c in prior.calls if c.scale == 1
    )


@pytest.mark.parametrize("cost", [("cc", 5, 0), ("gc", 4, 0), ("cp", 4, 2)], ids=ALONE)
def test_a_term_of_weight_zero_makes_no_predictions(cost, make, run, gaussian, means, rgb, monkeypatch):
    decoded, decode = [], gaussian.decode
    monkeypatch.setattr(gaussian, "decode", lambda *given: decoded.append(given) or decode(*given))
    prior, (term, calls, decodings) = gaussian(DDPM()), cost
    run(make("gcs", **weights_of(*ALONE[term])), rgb, means, prior)
    assert (len(prior.calls), len(decoded)) == (calls, decodings)


# --- pixels


def test_the_pixel_term_does_not_pass_through_the_encoder(make):
    """Each latent of this prior is the mean of four pixels and decodes to four equal ones; D is the views."""
    prior = Tiny(predicts="noise", noise_path=DDPM(), width=16, downscale=2, seed=0)
    cameras = turntable(2, elevation_deg=15.0, distance=3.0, fov_y_deg=40.0, size=16)
    condition = prior.embed("a red cube", "").at(cameras, torch.zeros(2, 3))
    render = torch.rand(2, 16, 16, 3, generator=torch.Generator().manual_seed(0)).requires_grad_()
    guidance = make("gcs", weight=0.1, reduction="sum_per_view", **weights_of(*ALONE["cp"]))
    output = guidance(render, condition, prior, 0, torch.Generator().manual_seed(0))
    output.loss.backward()
    assert output.log["cp_rms"] == pytest.approx(2 * float(render.grad.square().mean().sqrt()), rel=1e-5)
    assert output.log["guidance_rms"] == 0
    blocks = render.grad.reshape(2, 8, 2, 8, 2, 3)
    assert torch.equal(blocks[:, :, :1, :, :1].expand_as(blocks), blocks)
    # Decoded images are in [0, 1], so the largest gradient is 2 weight (1 - 0) / views.
    assert float(render.grad.abs().max()) <= 0.1 + 1e-6


def test_a_mean_is_over_latents_or_over_pixels(make):
    prior = Tiny(predicts="noise", noise_path=RectifiedFlow(), width=16, downscale=2, seed=0)
    cameras = turntable(2, elevation_deg=15.0, distance=3.0, fov_y_deg=40.0, size=16)
    condition = prior.embed("a red cube", "").at(cameras, torch.zeros(2, 3))
    for term, count in (("gc", 2 * 8 * 8 * 3), ("cp", 2 * 16 * 16 * 3)):
        gradients = []
        for reduction in ("sum", "mean"):
            render = torch.rand(2, 16, 16, 3, generator=torch.Generator().manual_seed(0)).requires_grad_()
            guidance = make("gcs", reduction=reduction, **weights_of(*ALONE[term]))
            guidance(render, condition, prior, 0, torch.Generator().manual_seed(0)).loss.backward()
            gradients.append(render.grad)
        torch.testing.assert_close(count * gradients[1], gradients[0], rtol=1e-5, atol=1e-6)


# --- numbers


def test_numbers_that_are_not_finite_become_zero_and_are_counted(make, run, prior, means, rgb):
    healthy, before = run(make("gcs"), rgb, means, prior)
    means.positive[0, 0, 0, 0], means.positive[1, 2, 3, 4] = torch.nan, torch.inf
    sick, after = run(make("gcs"), rgb, means, prior)
    is_sick = ~means.positive.isfinite()
    assert (sick[is_sick] == 0).all()
    torch.testing.assert_close(sick[~is_sick], healthy[~is_sick])
    assert before.log["guidance_nonfinite"] == 0
    assert after.log["guidance_nonfinite"] == 4  # two latents, two pixels
    assert all(torch.as_tensor(value).isfinite() for value in after.log.values())


def test_all_weights_zero_are_refused(make):
    with pytest.raises(UserError, match=r"\.w_gc: expected a number > 0"):
        make("gcs", **weights_of(0.0, 0.0, 0.0))
