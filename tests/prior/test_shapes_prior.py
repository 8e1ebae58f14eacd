"""ShapesPrior as guidance uses it: scales, the unconditional branch, the prediction error and the truth."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from cadam3d.core.cameras import Cameras, fitting_distance, turntable
from cadam3d.core.errors import UserError
from cadam3d.prior.exact import (
    CENSUS_ELEVATION_DEG,
    CENSUS_FOV_DEG,
    CENSUS_VIEWS,
    ExactCondition,
    error_field,
)
from cadam3d.prior.path import DDPM, NoisePath, Prediction, RectifiedFlow
from cadam3d.prior.shapes import ShapesPrior, known_objects, known_primitives

PATHS = [pytest.param(DDPM(), id="ddpm"), pytest.param(RectifiedFlow(), id="flow")]
SIZE = 20


def prior(**changes: object) -> ShapesPrior:
    exact = ShapesPrior(
        noise_path=DDPM(),
        spread=0.1,
        edge_spread=0.1,
        model_error=0.0,
        samples_per_pixel=2,
        census_size=12,
        seed=0,
        tracer="auto",
    )
    return replace(exact, **changes)


def views(count: int = 2, size: int = SIZE) -> Cameras:
    return turntable(count, elevation_deg=20.0, distance=fitting_distance(40.0), fov_y_deg=40.0, size=size)


def condition_of(model: ShapesPrior, prompt: str = "a torus", negative: str = "") -> ExactCondition:
    return model.embed(prompt, negative).at(views(), torch.tensor([[1.0, 1.0, 1.0], [0.2, 0.5, 0.8]]))


def noisy_image(seed: int = 0, count: int = 2) -> Tensor:
    return torch.randn(count, 3, SIZE, SIZE, generator=torch.Generator().manual_seed(seed))


def forms(prediction: Prediction) -> dict[str, Tensor]:
    return vars(prediction)


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("error", [0.0, 0.3])
def test_three_forms_agree(path: NoisePath, error: float) -> None:
    model = prior(noise_path=path, model_error=error)
    condition, t = condition_of(model), torch.tensor([0.3, 0.8])
    noisy = noisy_image()
    guess = model.predict(noisy, t, condition, 7.5)
    for other in (
        path.from_clean(noisy, guess.clean, t),
        path.from_noise(noisy, guess.noise, t),
        path.from_velocity(noisy, guess.velocity, t),
    ):
        for name, value in forms(other).items():
            torch.testing.assert_close(value, forms(guess)[name], rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("spread", [0.0, 0.1])
def test_both_ends_are_finite_and_explain_the_noisy_image(path: NoisePath, spread: float) -> None:
    model = prior(noise_path=path, spread=spread, edge_spread=0.0, model_error=0.1)
    condition = condition_of(model)
    for t in (torch.tensor([0.0, 1.0]), torch.tensor([1e-6, 1 - 1e-6])):
        guess = model.predict(noisy_image(), t, condition, 7.5)
        assert all(bool(value.isfinite().all()) for value in forms(guess).values())
        if spread > 0:
            torch.testing.assert_close(
                path.mix(guess.clean, guess.noise, t), noisy_image(), rtol=1e-4, atol=1e-3
            )


def test_a_noisy_mode_is_denoised_to_itself_and_its_noise() -> None:
    model = prior(spread=0.01, edge_spread=0.0)
    condition, t = condition_of(model), torch.tensor([0.25, 0.25])
    noise = noisy_image()
    for mode in (0, 5):
        image = condition.positive.means[:, mode]
        guess = model.predict(model.noise_path.mix(image, noise, t), t, condition, 1.0)
        assert float((guess.clean - image).abs().max()) < 2e-3
        assert float((guess.noise - noise).abs().max()) < 5e-3


@pytest.mark.parametrize("scale", [7.5, -7.5])
@pytest.mark.parametrize("path", PATHS)
def test_guidance_is_linear_in_its_scale(path: NoisePath, scale: float) -> None:
    model = prior(noise_path=path, model_error=0.1)
    condition, t = condition_of(model), torch.tensor([0.4, 0.7])
    zero, one, far = (forms(model.predict(noisy_image(), t, condition, s)) for s in (0.0, 1.0, scale))
    for name, value in far.items():
        torch.testing.assert_close(value, zero[name] + scale * (one[name] - zero[name]), rtol=1e-4, atol=1e-4)


def test_scales_zero_and_one_are_single_branches() -> None:
    model = prior()
    condition, t = condition_of(model), torch.tensor([0.4, 0.7])
    a, b = model.noise_path.a(t), model.noise_path.b(t)
    one = model.predict(noisy_image(), t, condition, 1.0)
    zero = model.predict(noisy_image(), t, condition, 0.0)
    assert torch.equal(one.clean, condition.positive.denoise(noisy_image(), a, b)[0])
    assert torch.equal(zero.clean, condition.empty.denoise(noisy_image(), a, b)[0])


def test_unprompted_depends_on_neither_prompt() -> None:
    model, t = prior(), torch.tensor([0.4, 0.7])
    first = condition_of(model, "a lighthouse", "a red cube").unprompted()
    second = condition_of(model, "a torus").unprompted()
    assert torch.equal(
        model.predict(noisy_image(), t, first, 7.5).noise, model.predict(noisy_image(), t, second, 7.5).noise
    )


def test_a_negative_prompt_describes_another_scene() -> None:
    model, t = prior(), torch.tensor([0.4, 0.7])
    condition = condition_of(model, "a torus", "a lighthouse")
    alone = condition_of(model, "a lighthouse")
    torch.testing.assert_close(
        model.predict(noisy_image(), t, condition, 0.0).clean,
        model.predict(noisy_image(), t, alone, 1.0).clean,
    )


def test_no_gradient_flows_through_a_prediction_but_it_does_through_encode() -> None:
    model = prior()
    rgb = torch.rand(2, SIZE, SIZE, 3, requires_grad=True)
    encoded = model.encode(rgb)
    assert encoded.requires_grad
    torch.testing.assert_close(encoded[:, 1], 2 * rgb[..., 1] - 1)
    assert not model.predict(encoded, torch.tensor([0.4, 0.7]), condition_of(model), 7.5).noise.requires_grad


def test_decoding_undoes_encoding_and_stays_in_range() -> None:
    model, rgb = prior(), torch.rand(2, SIZE, SIZE, 3, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(model.decode(model.encode(rgb), SIZE, SIZE), rgb)
    decoded = model.decode(3 * noisy_image().requires_grad_(), SIZE, SIZE)
    assert not decoded.requires_grad
    assert (decoded.min(), decoded.max()) == (0, 1)


def test_spread_is_wider_at_silhouettes() -> None:
    model = prior(spread=0.1, edge_spread=0.2)
    variance = condition_of(model).positive.variance
    torch.testing.assert_close(variance.min().sqrt(), torch.tensor(0.1))
    torch.testing.assert_close(variance.max().sqrt(), torch.tensor(0.3))
    corner = variance[:, :, 0, 0].sqrt()
    torch.testing.assert_close(corner, torch.full_like(corner, 0.1))


def test_empty_prompt_has_the_moments_of_the_world() -> None:
    """Compare with images that are composited one by one, without the algebra of the census."""
    model = prior(spread=1e-4, edge_spread=0.0, samples_per_pixel=1)
    cameras = turntable(
        CENSUS_VIEWS,
        elevation_deg=CENSUS_ELEVATION_DEG,
        distance=fitting_distance(CENSUS_FOV_DEG),
        fov_y_deg=CENSUS_FOV_DEG,
        size=model.census_size,
    )
    background = torch.tensor([0.3, 0.6, 0.9]).expand(CENSUS_VIEWS, 3)
    means, squares = [], []
    for name in (*known_primitives(), *known_objects()):
        images = 2 * model.truth(name).images(cameras, background).double() - 1
        means.append(images.mean(dim=(0, 1)))
        squares.append(images.square().mean(dim=(0, 1)))
    mean = torch.stack(means).mean(0)
    variance = torch.stack(squares).mean(0) - mean**2
    empty = model.embed("a cube", "").at(cameras, background).empty
    torch.testing.assert_close(empty.means[0, 0].permute(1, 2, 0).double(), mean, atol=1e-5, rtol=0)
    torch.testing.assert_close(empty.variance[0, 0].permute(1, 2, 0).double(), variance, atol=1e-5, rtol=0)


def test_truth_equals_the_means_of_the_modes() -> None:
    model = prior()
    cameras, background = views(3), torch.rand(3, 3, generator=torch.Generator().manual_seed(0))
    images = model.truth("a spotted torus").images(cameras, background)
    assert images.shape == (8, 3, SIZE, SIZE, 3)
    assert 0 <= float(images.min()) <= float(images.max()) <= 1 + 1e-6
    modes = model.embed("a spotted torus", "").at(cameras, background).positive.means
    for mode in range(8):
        torch.testing.assert_close(model.encode(images[mode]), modes[:, mode])


# --- the prediction error


def fields(count: int = 200, size: int = 32) -> Tensor:
    noise = torch.randn(count, 3, size, size, generator=torch.Generator().manual_seed(5))
    return error_field(noise, seed=3)


def test_error_has_unit_rms_and_no_mean() -> None:
    error = fields()
    torch.testing.assert_close(error.square().mean().sqrt(), torch.tensor(1.0), rtol=0.02, atol=0)
    assert float(error.mean(0).abs().mean()) < 0.1


def test_error_is_smooth() -> None:
    """A field on 32 pixels has almost no energy above the frequency of its 8 cells."""
    spectrum = torch.fft.fft2(fields()).abs().square().mean(dim=(0, 1))
    frequency = torch.fft.fftfreq(32, 1 / 32).abs()
    is_high = torch.maximum(frequency[:, None], frequency[None]) > 8
    assert float(spectrum[is_high].sum() / spectrum.sum()) < 0.02


def test_error_changes_with_the_noise_and_the_seed_only() -> None:
    noise = torch.randn(2, 3, 32, 32, generator=torch.Generator().manual_seed(6))
    one = error_field(noise, seed=3)
    assert torch.equal(one, error_field(noise, seed=3))
    for other in (error_field(noise, seed=4), error_field(noise.roll(1, 0), seed=3)):
        correlation = torch.corrcoef(torch.stack([one.flatten(), other.flatten()]))[0, 1]
        assert abs(float(correlation)) < 0.3


def test_error_is_continuous() -> None:
    noise = torch.randn(2, 3, 32, 32, generator=torch.Generator().manual_seed(7), dtype=torch.float64)
    step = torch.randn(2, 3, 32, 32, generator=torch.Generator().manual_seed(8), dtype=torch.float64)
    moved = [
        float((error_field(noise + h * step, 0) - error_field(noise, 0)).abs().max()) for h in (1e-4, 1e-5)
    ]
    assert moved[0] < 3e-3
    assert moved[0] / moved[1] == pytest.approx(10, rel=0.05)


@pytest.mark.parametrize("path", PATHS)
def test_configured_error_is_measured_in_the_prediction(path: NoisePath) -> None:
    t = torch.tensor([0.3, 1.0])
    exact, wrong = prior(noise_path=path), prior(noise_path=path, model_error=0.4)
    condition, total = condition_of(exact), torch.zeros(2)
    for seed in range(20):
        noisy = noisy_image(seed)
        difference = (
            wrong.predict(noisy, t, condition, 1.0).clean - exact.predict(noisy, t, condition, 1.0).clean
        )
        total += difference.square().mean(dim=(1, 2, 3)) / 20
    a, b = path.a(t), path.b(t)
    torch.testing.assert_close(total.sqrt(), 0.4 * b / (a * a + b * b).sqrt(), rtol=0.1, atol=0)


def test_clean_images_have_no_error_and_branches_have_different_errors() -> None:
    exact, wrong = prior(), prior(model_error=0.4)
    condition, t = condition_of(exact), torch.zeros(2)
    noisy = noisy_image()
    torch.testing.assert_close(
        wrong.predict(noisy, t, condition, 1.0).clean, exact.predict(noisy, t, condition, 1.0).clean
    )
    late = torch.full((2,), 0.9)
    positive, negative = (
        wrong.predict(noisy, late, condition, scale).clean
        - exact.predict(noisy, late, condition, scale).clean
        for scale in (1.0, 0.0)
    )
    correlation = torch.corrcoef(torch.stack([positive.flatten(), negative.flatten()]))[0, 1]
    assert abs(float(correlation)) < 0.3


# --- user errors


def test_unknown_words_and_an_empty_prompt_are_refused() -> None:
    with pytest.raises(UserError, match="prompt: expected an object"):
        prior().embed("   ", "")
    with pytest.raises(UserError, match="'dragon'"):
        prior().embed("a dragon", "")
    with pytest.raises(UserError, match="'blurry'"):
        prior().embed("a torus", "blurry")
