"""Laws of the noise paths."""

import math

import numpy as np
import pytest
import torch

from cadam3d.prior.path import DDPM, RectifiedFlow, Rows, per_view

PATHS = {
    "ddpm": DDPM(),
    "ddpm-10": DDPM(train_steps=10, beta_start=0.01, beta_end=0.3),
    "flow": RectifiedFlow(),
    "flow-3": RectifiedFlow(shift=3.0),
    "flow-0.1": RectifiedFlow(shift=0.1),
}
every_path = pytest.mark.parametrize("path", PATHS.values(), ids=PATHS.keys())
every_dtype = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])


def pairs(count, dtype=torch.float64, seed=0):
    generator = torch.Generator().manual_seed(seed)
    clean, noise = torch.randn(2, count, 3, 4, 5, generator=generator, dtype=torch.float64).to(dtype)
    return clean, noise


def inner_levels(count, seed=0):
    """Levels away from the ends, where all forms are determined."""
    uniform = torch.rand(count, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return 0.01 + 0.98 * uniform


def stable_diffusion_abar():
    """The published table, computed independently."""
    betas = np.square(np.linspace(math.sqrt(0.00085), math.sqrt(0.012), 1000))
    return np.cumprod(1 - betas)


@every_path
@every_dtype
def test_the_ends_are_clean_and_noise(path, dtype):
    ends = torch.tensor([0, 1], dtype=dtype)
    a, b = path.a(ends), path.b(ends)
    assert a.dtype == b.dtype == dtype
    assert a[0] == 1
    assert b[0] == 0
    assert b[1] > a[1] >= 0


@every_path
def test_a_falls_and_b_rises(path):
    t = torch.linspace(0, 1, 4321, dtype=torch.float64)
    assert (path.a(t).diff() < 0).all()
    assert (path.b(t).diff() > 0).all()
    assert (path.gamma(t)[:-1].diff() > 0).all()


@every_path
@every_dtype
def test_t_at_inverts_the_share_of_noise(path, dtype):
    t = torch.cat([torch.tensor([1e-4]), inner_levels(50)]).to(dtype)
    found = path.t_at(path.b(t))
    assert found.dtype == dtype
    torch.testing.assert_close(found, t, rtol=0, atol=1e-9 if dtype == torch.float64 else 1e-4)


@every_path
def test_the_ends_are_found_exactly(path):
    ends = torch.tensor([0, 1], dtype=torch.float64)
    assert torch.equal(path.t_at(path.b(ends)), ends)
    assert path.t_at(torch.tensor([-0.1, 1.1])).tolist() == [0, 1]


@pytest.mark.parametrize("name", ["ddpm", "ddpm-10"])
def test_ddpm_preserves_variance(name):
    t = inner_levels(500)
    torch.testing.assert_close(PATHS[name].a(t) ** 2 + PATHS[name].b(t) ** 2, torch.ones_like(t))


@pytest.mark.parametrize("name", ["flow", "flow-3", "flow-0.1"])
def test_flow_is_a_straight_line(name):
    t = torch.linspace(0, 1, 500, dtype=torch.float64)
    torch.testing.assert_close(PATHS[name].a(t) + PATHS[name].b(t), torch.ones_like(t))


@pytest.mark.parametrize("shift", [0.5, 1.0, 3.0])
def test_shift_follows_its_formula(shift):
    t = torch.linspace(0, 1, 101, dtype=torch.float64)
    torch.testing.assert_close(RectifiedFlow(shift=shift).b(t), shift * t / (1 + (shift - 1) * t))


def test_ddpm_has_the_published_table_on_its_grid():
    t = torch.arange(1, 1001, dtype=torch.float64) / 1000
    torch.testing.assert_close(DDPM().a(t) ** 2, torch.from_numpy(stable_diffusion_abar()))


def test_between_grid_points_the_log_of_abar_is_linear():
    table = np.log(np.concatenate([[1.0], stable_diffusion_abar()]))
    t = inner_levels(200)
    expected = np.interp(1000 * t.numpy(), np.arange(1001), table)
    torch.testing.assert_close(2 * DDPM().a(t).log(), torch.from_numpy(expected))


def test_single_precision_keeps_its_digits_near_the_clean_end():
    t = torch.tensor([1e-5, 1e-4, 1e-3, 1e-2], dtype=torch.float64)
    for path in PATHS.values():
        torch.testing.assert_close(path.b(t.float()).double(), path.b(t), rtol=1e-4, atol=0)


def test_ddpm_timestep_is_the_row_of_the_table():
    t = torch.tensor([0.001, 0.5, 1.0, 0.0, 0.0004], dtype=torch.float64)
    expected = torch.tensor([0, 499, 999, 0, 0], dtype=torch.float64)
    torch.testing.assert_close(DDPM().timestep(t), expected)


def test_flow_timestep_is_a_thousand_sigma():
    t = torch.tensor([0.0, 0.5, 1.0])
    torch.testing.assert_close(PATHS["flow-3"].timestep(t), torch.tensor([0.0, 750.0, 1000.0]))


def complete_every_form(path, clean, noise, t):
    noisy = path.mix(clean, noise, t)
    return {
        "clean": path.from_clean(noisy, clean, t),
        "noise": path.from_noise(noisy, noise, t),
        "velocity": path.from_velocity(noisy, path.velocity(clean, noise, t), t),
    }


@every_path
def test_the_three_forms_of_the_true_pair_all_return_that_pair(path):
    t = inner_levels(50)
    clean, noise = pairs(50)
    for guess in complete_every_form(path, clean, noise, t).values():
        torch.testing.assert_close(guess.clean, clean, rtol=0, atol=1e-10)
        torch.testing.assert_close(guess.noise, noise, rtol=0, atol=1e-10)
        torch.testing.assert_close(guess.velocity, path.velocity(clean, noise, t), rtol=0, atol=1e-10)


@every_path
def test_three_forms_of_a_wrong_prediction_agree(path):
    """A network's output may differ from the true pair; its three forms must still agree."""
    t = inner_levels(50)
    noisy, wrong = pairs(50, seed=1)
    first = path.from_clean(noisy, wrong, t)
    for other in (path.from_noise(noisy, first.noise, t), path.from_velocity(noisy, first.velocity, t)):
        for form in ("clean", "noise", "velocity"):
            torch.testing.assert_close(getattr(other, form), getattr(first, form), rtol=0, atol=1e-9)


@every_path
def test_a_prediction_mixes_back_to_the_noisy_image(path):
    t = inner_levels(50)
    noisy, wrong = pairs(50, seed=2)
    for complete in (path.from_clean, path.from_noise, path.from_velocity):
        guess = complete(noisy, wrong, t)
        torch.testing.assert_close(path.mix(guess.clean, guess.noise, t), noisy, rtol=0, atol=1e-9)


@every_path
@every_dtype
def test_every_form_is_finite_at_both_ends(path, dtype):
    ends = torch.tensor([0, 1], dtype=dtype)
    clean, noise = pairs(2, dtype)
    for guess in complete_every_form(path, clean, noise, ends).values():
        for values in (guess.clean, guess.noise, guess.velocity):
            assert values.dtype == dtype
            assert values.isfinite().all()


@every_path
def test_velocity_is_exact_at_both_ends(path):
    ends = torch.tensor([0.0, 1.0], dtype=torch.float64)
    clean, noise = pairs(2)
    guess = complete_every_form(path, clean, noise, ends)["velocity"]
    torch.testing.assert_close(guess.clean, clean, rtol=0, atol=1e-12)
    torch.testing.assert_close(guess.noise, noise, rtol=0, atol=1e-12)


@every_path
def test_noise_of_a_clean_image_is_zero(path):
    clean, _ = pairs(1)
    guess = path.from_clean(clean, clean, torch.zeros(1, dtype=torch.float64))
    assert (guess.noise == 0).all()


@every_path
def test_ends_pass_finite_gradients(path):
    ends = torch.tensor([0.0, 1.0], dtype=torch.float64)
    noisy, wrong = (values.requires_grad_() for values in pairs(2))
    guesses = (path.from_clean(noisy, wrong, ends), path.from_noise(noisy, wrong, ends))
    sum((guess.clean + guess.noise + guess.velocity).sum() for guess in guesses).backward()
    assert noisy.grad.isfinite().all()
    assert wrong.grad.isfinite().all()


def test_velocity_of_ddpm_is_the_derivative_along_the_circle():
    """With a = cos(phi), b = sin(phi), v-prediction is d noisy / d phi (Salimans and Ho 2022, appendix D)."""
    clean, noise = pairs(7)
    t = torch.linspace(0.1, 0.9, 7, dtype=torch.float64)
    phi = torch.atan2(DDPM().b(t), DDPM().a(t))
    along = -per_view(phi.sin()) * clean + per_view(phi.cos()) * noise
    torch.testing.assert_close(DDPM().velocity(clean, noise, t), along)


def test_velocity_of_a_flow_is_the_derivative_by_sigma():
    path = RectifiedFlow()
    clean, noise = pairs(7)
    t = torch.linspace(0.1, 0.9, 7, dtype=torch.float64)
    slope = (path.mix(clean, noise, t + 1e-6) - path.mix(clean, noise, t - 1e-6)) / 2e-6
    torch.testing.assert_close(path.velocity(clean, noise, t), slope, rtol=0, atol=1e-8)


@every_path
def test_a_path_at_rows_equals_the_path_at_the_nearest_row_of_its_table(path):
    rows, t = Rows(path=path, rows=1000), inner_levels(50)
    nearest = (1000 * t).round() / 1000
    clean, noise = pairs(50)
    noisy = path.mix(clean, noise, nearest)
    torch.testing.assert_close(rows.mix(clean, noise, t), noisy)
    torch.testing.assert_close(rows.timestep(t), path.timestep(nearest))
    for name in ("from_noise", "from_clean", "from_velocity"):
        found, wanted = (getattr(each, name)(noisy, noise, at) for each, at in ((rows, t), (path, nearest)))
        torch.testing.assert_close(found.clean, wanted.clean)
        torch.testing.assert_close(found.velocity, wanted.velocity)
    torch.testing.assert_close(rows.b(rows.t_at(path.b(nearest))), path.b(nearest))


def test_timesteps_at_rows_are_whole_numbers():
    t = torch.rand(1000, generator=torch.Generator().manual_seed(0))
    steps = Rows(path=DDPM(), rows=1000).timestep(t)
    assert torch.equal(steps, steps.round())
    assert (DDPM().timestep(t) - steps).abs().max() <= 0.501
