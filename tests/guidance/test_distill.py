"""Laws that hold for every objective, on every path."""

from dataclasses import replace

import pytest
import torch

from cadam3d.core.cameras import turntable
from cadam3d.core.errors import UserError
from cadam3d.core.schedule import Linear, Steps
from cadam3d.guidance.distill import rms, surrogate
from cadam3d.prior.path import DDPM, RectifiedFlow, per_view
from cadam3d.prior.tiny import Tiny

FORMULAS = {
    "sigma": lambda a, b: b,
    "one_minus_abar": lambda a, b: b * b,
    "sqrt_abar_one_minus_abar": lambda a, b: a * b * b,
    "gamma": lambda a, b: b / a,
}


def test_a_perfect_prediction_has_zero_gradient(objective, path, make, run, gaussian, one_image):
    """The render is the only image of the prompt."""
    render = one_image.positive.permute(0, 2, 3, 1)
    for seed in range(5):
        gradient, output = run(make(objective), render, one_image, gaussian(path, spread=0.0), seed=seed)
        torch.testing.assert_close(gradient, torch.zeros_like(gradient), rtol=0, atol=1e-10)
        assert output.loss < 1e-18


def test_descent_points_at_the_image(guided, path, make, run, gaussian, one_among_many, rgb):
    """If the prompt determines the image, every element of -G points from the render to it."""
    gradient, _ = run(make(guided, scale=1.0), rgb, one_among_many, gaussian(path, spread=0.0))
    offset = rgb.detach().permute(0, 3, 1, 2) - one_among_many.positive
    assert (gradient * offset > 0).all()


def test_descent_reaches_the_image(guided, path, make, run, gaussian, one_among_many, rgb):
    """Descend along the x0-residual from a random render, on a prior with little spread."""
    weighting = {"vfds": "sigma", "ucm": "sigma"}.get(guided, "gamma")
    guidance = make(guided, scale=1.0, weighting=weighting, t_min=0.3, t_max=0.7)
    prior, render = gaussian(path, spread=0.02), rgb.detach()
    target = one_among_many.positive.permute(0, 2, 3, 1)
    before = (render - target).square().mean().sqrt()
    for step in range(30):
        gradient, _ = run(guidance, render, one_among_many, prior, step=step, seed=step)
        render = render - 0.2 * gradient.permute(0, 2, 3, 1)
    assert (render - target).square().mean().sqrt() < 0.02 * before


def test_the_gradient_is_that_of_the_surrogate_with_a_frozen_target(
    distillation, make, run, gaussian, means, rgb
):
    """Compare with finite differences of ||x0 - target||^2 / (2 D) for the fixed target x0 - G."""
    divisor = rgb.numel()
    gradient, output = run(make(distillation, reduction="mean"), rgb, means, gaussian(DDPM()))
    clean = rgb.detach().permute(0, 3, 1, 2)
    target = clean - gradient * divisor

    def frozen(x):
        return (x - target).square().sum() / (2 * divisor)

    torch.testing.assert_close(output.loss.detach(), frozen(clean))
    generator = torch.Generator().manual_seed(1)
    for _ in range(5):
        direction = torch.randn(clean.shape, generator=generator, dtype=clean.dtype)
        slope = (frozen(clean + 1e-3 * direction) - frozen(clean - 1e-3 * direction)) / 2e-3
        torch.testing.assert_close((gradient * direction).sum(), slope, rtol=1e-8, atol=1e-12)


def test_a_small_gradient_is_not_lost_in_single_precision():
    clean = torch.full((1, 1, 2, 2), 1000.0, requires_grad=True)
    gradient = torch.full_like(clean, 1e-9)
    surrogate(clean, gradient, 1).backward()
    assert torch.equal(clean.grad, gradient)


def test_the_sum_does_not_overflow_in_half_precision():
    """The largest number in half precision is 65,504."""
    clean = torch.ones(1, 1, 2, 2, dtype=torch.float16, requires_grad=True)
    loss = surrogate(clean, torch.full_like(clean, 300), 1)
    loss.backward()
    assert loss == 180_000
    assert (clean.grad == 300).all()


@pytest.mark.parametrize("form", ["noise", "velocity"])
def test_the_form_that_the_prior_predicts_does_not_matter(form, objective, make, run, prior, means, rgb):
    expected, _ = run(make(objective), rgb, means, prior)
    got, _ = run(make(objective), rgb, means, replace(prior, form=form))
    torch.testing.assert_close(got, expected, rtol=1e-7, atol=1e-9)


def test_reductions_differ_by_the_counts(objective, make, run, prior, means, rgb):
    two = type(means)(means.positive[:2], means.negative[:2], means.empty[:2])  # views: fewer than channels
    total, out = run(make(objective, reduction="sum"), rgb[:2], two, prior)
    for reduction, count in (("sum_per_view", 2), ("mean", rgb[:2].numel())):
        gradient, output = run(make(objective, reduction=reduction), rgb[:2], two, prior)
        torch.testing.assert_close(gradient * count, total, rtol=1e-12, atol=0)
        torch.testing.assert_close(output.loss * count, out.loss, rtol=1e-12, atol=0)
        assert output.log == out.log


def test_the_loss_is_half_the_squared_norm_of_the_gradient(distillation, make, run, prior, means, rgb):
    gradient, output = run(make(distillation), rgb, means, prior)
    assert output.loss.item() == pytest.approx(0.5 * float(gradient.square().sum()), rel=1e-12)
    assert output.log["guidance_rms"] == pytest.approx(float(gradient.square().mean().sqrt()), rel=1e-12)


def test_weight_multiplies_the_gradient(objective, make, run, prior, means, rgb):
    one, _ = run(make(objective), rgb, means, prior)
    tenth, _ = run(make(objective, weight=0.1), rgb, means, prior)
    torch.testing.assert_close(tenth, 0.1 * one, rtol=1e-12, atol=0)


@pytest.mark.parametrize("weighting", FORMULAS)
def test_weightings_follow_their_formula(weighting, distillation, make, run, prior, means, rgb):
    unit, _ = run(make(distillation), rgb, means, prior)
    weighted, _ = run(make(distillation, weighting=weighting), rgb, means, prior)
    t = prior.calls[-1].t
    expected = per_view(FORMULAS[weighting](prior.noise_path.a(t), prior.noise_path.b(t)))
    torch.testing.assert_close(weighted, expected * unit, rtol=1e-9, atol=0)


def test_the_same_seed_gives_the_same_loss_and_another_seed_another(objective, make, run, prior, means, rgb):
    first, again, other = (run(make(objective), rgb, means, prior, seed=s)[1].loss for s in (3, 3, 4))
    assert first == again
    assert first != other


def test_global_randomness_is_neither_used_nor_changed(objective, make, run, prior, means, rgb):
    guidance = make(objective)
    torch.manual_seed(1)
    before = torch.get_rng_state()
    first, _ = run(guidance, rgb, means, prior)
    assert torch.equal(before, torch.get_rng_state())
    torch.manual_seed(2)
    again, _ = run(guidance, rgb, means, prior)
    assert torch.equal(first, again)


def test_no_gradient_enters_the_prior(objective, make, prior, means, rgb):
    for image in (means.positive, means.negative, means.empty):
        image.requires_grad_()
    make(objective)(rgb, means, prior, 0, torch.Generator().manual_seed(0)).loss.backward()
    assert not any(call.gradient for call in prior.calls)
    assert means.positive.grad is means.negative.grad is means.empty.grad is None
    assert rgb.grad.abs().max() > 0


def test_clip_clamps_every_element(distillation, make, run, prior, means, rgb):
    free, _ = run(make(distillation), rgb, means, prior)
    bound = float(free.abs().median())
    clipped, output = run(make(distillation, clip=bound), rgb, means, prior)
    torch.testing.assert_close(clipped, free.clamp(-bound, bound))
    assert output.log["guidance_rms"] < bound


def test_clip_may_be_a_schedule(make, run, gaussian, means, rgb):
    guidance = make("sds", clip=Linear(start=0.01, end=0.02, steps=10))
    for step, bound in ((0, 0.01), (5, 0.015), (99, 0.02)):
        gradient, _ = run(guidance, rgb, means, gaussian(DDPM()), step=step)
        assert float(gradient.abs().max()) == pytest.approx(bound)


def test_t_stays_in_its_window_and_fills_it(distillation, make, run, prior, means, rgb):
    guidance = make(distillation, t_min=0.3, t_max=0.4)
    drawn = []
    for seed in range(25):
        _, output = run(guidance, rgb, means, prior, seed=seed)
        drawn.append(prior.calls[-1].t)
        assert output.log["t"] == pytest.approx(float(drawn[-1].mean()))
    t = torch.cat(drawn)
    assert 0.3 <= t.min() < 0.31
    assert 0.39 < t.max() <= 0.4


def test_the_window_follows_its_schedules(make, run, gaussian, means, rgb):
    guidance = make(
        "sds",
        t_min=Steps(values=[0.8, 0.1], milestones=[5]),
        t_max=Linear(start=0.9, end=0.2, steps=5),
    )
    for step, low, high in ((0, 0.8, 0.9), (5, 0.1, 0.2)):
        prior = gaussian(DDPM())
        run(guidance, rgb, means, prior, step=step)
        assert ((prior.calls[-1].t >= low) & (prior.calls[-1].t <= high)).all()


def test_in_a_window_of_zero_width_t_follows_the_schedule(distillation, make, run, prior, means, rgb):
    """DreamGaussian anneals t = 1 - step / 500, for every view and seed."""
    anneal = Linear(start=0.9, end=0.2, steps=7)
    guidance = make(distillation, t_min=anneal, t_max=anneal)
    for step, t in ((0, 0.9), (3, 0.6), (9, 0.2)):
        _, output = run(guidance, rgb, means, prior, step=step, seed=step)
        assert prior.calls[-1].t.tolist() == pytest.approx([t] * 3)
        assert output.log["t"] == pytest.approx(t)


@pytest.mark.parametrize("is_shared", [True, False])
def test_views_share_t_if_requested(is_shared, objective, make, run, prior, means, rgb):
    run(make(objective, shared_t=is_shared), rgb, means, prior)
    assert len(prior.calls[-1].t.unique()) == (1 if is_shared else 3)


def test_noise_levels_stay_precise_when_latents_are_half(make, gaussian, one_image):
    @torch.no_grad()
    def halved(image):
        return image.to(torch.bfloat16)

    prior = gaussian(DDPM())
    render = halved(one_image.positive).permute(0, 2, 3, 1).requires_grad_()
    make("sds")(render, one_image, prior, 0, torch.Generator().manual_seed(0)).loss.backward()
    assert prior.calls[-1].t.dtype == torch.float32
    assert render.grad.isfinite().all()


@pytest.mark.parametrize("guided", ["sds", "ism", "vfds", "ucm"])  # sdi inverts under both prompts
def test_scale_one_ignores_the_negative_prompt(guided, make, run, prior, means, rgb):
    other = type(means)(means.positive, means.negative + 1, means.empty)
    first, _ = run(make(guided, scale=1.0), rgb, means, prior)
    again, _ = run(make(guided, scale=1.0), rgb, other, prior)
    torch.testing.assert_close(first, again, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("guided", ["sds", "ism", "vfds", "ucm"])  # sdi inverts under both prompts
def test_scale_zero_is_the_negative_prompt_alone(guided, make, run, prior, means, rgb):
    swapped = type(means)(means.negative, means.positive, means.empty)
    first, _ = run(make(guided, scale=0.0), rgb, means, prior)
    again, _ = run(make(guided, scale=1.0), rgb, swapped, prior)
    torch.testing.assert_close(first, again, rtol=1e-12, atol=1e-14)


def test_a_published_scale_of_100_relative_to_the_prompt_is_101_here(guided, make, run, prior, means, rgb):
    """GaussianDreamer writes eps_y + 100 (eps_y - eps_n); G is affine in the prediction, so in the scale."""
    negative, positive, guided = (run(make(guided, scale=s), rgb, means, prior)[0] for s in (0.0, 1.0, 101.0))
    torch.testing.assert_close(guided, positive + 100 * (positive - negative), rtol=1e-9, atol=1e-9)


def test_numbers_that_are_not_finite_become_zero_and_are_counted(distillation, make, run, prior, means, rgb):
    healthy, before = run(make(distillation), rgb, means, prior)
    means.positive[0, 0, 0, 0], means.positive[1, 2, 3, 4] = torch.nan, torch.inf
    sick, after = run(make(distillation), rgb, means, prior)
    is_sick = ~means.positive.isfinite()
    assert (sick[is_sick] == 0).all()
    torch.testing.assert_close(sick[~is_sick], healthy[~is_sick])
    assert before.log["guidance_nonfinite"] == 0
    assert after.log["guidance_nonfinite"] == 2
    assert all(torch.as_tensor(value).isfinite() for value in after.log.values())


def test_the_residual_is_measured_against_the_last_prediction(make, run, gaussian, one_image, rgb):
    _, output = run(make("sds", scale=1.0), rgb, one_image, gaussian(DDPM(), spread=0.0))
    offset = rgb.detach().permute(0, 3, 1, 2) - one_image.positive
    assert output.log["residual_rms"] == pytest.approx(float(offset.square().mean().sqrt()))


def judge_by_network(guidance, predicts, noise_path, device="cpu"):
    """Return the gradient on a render of odd size, and the output."""
    prior = Tiny(predicts=predicts, noise_path=noise_path, width=16, downscale=2, seed=0)
    prior = prior.to(torch.device(device))
    cameras = turntable(2, elevation_deg=15.0, distance=3.0, fov_y_deg=40.0, size=17)
    condition = prior.embed("a red cube", "blurry").at(cameras.to(torch.device(device)), torch.zeros(2, 3))
    render = torch.rand(2, 17, 17, 3, generator=torch.Generator().manual_seed(0)).to(device).requires_grad_()
    output = guidance(render, condition, prior, 0, torch.Generator().manual_seed(0))
    output.loss.backward()
    return render.grad, output


@pytest.mark.parametrize(
    ("predicts", "noise_path"), [("noise", DDPM()), ("velocity", RectifiedFlow(shift=3.0))]
)
def test_every_objective_runs_on_a_network(predicts, noise_path, objective, make):
    gradient, output = judge_by_network(make(objective), predicts, noise_path)
    assert output.log["guidance_nonfinite"] == 0
    assert (gradient != 0).any(dim=-1).all()


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_cuda_agrees_with_the_cpu(objective, make):
    """The random numbers are the same on both devices; the network's results differ slightly."""
    near, far = (judge_by_network(make(objective), "noise", DDPM(), device)[0] for device in ("cpu", "cuda"))
    assert (far.cpu() - near).norm() < 0.05 * near.norm()


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("t_max", 0.01),
        ("t_max", Linear(start=0.98, end=0.0, steps=10)),
    ],
)
def test_wrong_values_are_refused_by_key(key, value, objective, make):
    with pytest.raises(UserError, match=f"guidance.{key}: "):
        make(objective, **{key: value})


def test_a_window_that_closes_during_training_is_refused_at_that_step(make, run, gaussian, means, rgb):
    guidance = make("sds", t_min=Steps(values=[0.02, 0.99, 0.02], milestones=[5, 6]))
    run(guidance, rgb, means, gaussian(DDPM()), step=4)
    with pytest.raises(UserError, match=r"t_min 0\.99 and t_max 0\.98"):
        run(guidance, rgb, means, gaussian(DDPM()), step=5)


def test_every_number_of_a_chart_is_logged(objective, make, run, gaussian, means, rgb):
    guidance = make(objective)
    _, output = run(guidance, rgb, means, gaussian(DDPM()))
    keys = [curve.key for chart in guidance.charts() for curve in chart.curves]
    assert "residual_rms" in keys
    assert len(keys) == len(set(keys))
    assert set(keys) <= set(output.log)


def test_the_root_mean_square_is_over_finite_elements():
    assert rms(torch.tensor([3.0, torch.nan, 4.0, torch.inf])) == pytest.approx(12.5**0.5)
    assert rms(torch.tensor([torch.nan, -torch.inf])) == 0
