"""The SNR of pure noise, when tau_SNR = 0.1 rejects it, and the share of it that passes a calibrated gate.

Everything is simulated through ``CAdam.observe``: 4,000 Gaussians whose gradients are zero-mean noise. The
tables of docs/method.md are these numbers.
"""

import math

import numpy as np
import pytest
import torch
from composed import composed

from cadam3d.build import component
from cadam3d.densifier.base import GradientSignal
from cadam3d.densifier.cadam import CAdam, CAdamState
from cadam3d.densifier.noise_floor import snr_threshold, squared_weights, white_noise_snr
from cadam3d.prior.path import DDPM
from cadam3d.settings.compose import compose

CPU = torch.device("cpu")
STEP = 100  # of a refinement; only schedules depend on it
DRAWS = torch.Generator()  # nothing here draws from it
N = 4000
ALPHA = 0.05
ERROR = 0.015  # above four standard errors of a share near ALPHA of N
AGES = (5, 10, 20, 50, 100, 300, 1000)


def cadam(**changes) -> CAdam:
    lines = (f"densifier.{key}={value}" for key, value in changes.items())
    return component(composed("prompt=noise", "densifier=cadam_open", *lines).densifier)


def isotropic(draw: torch.Generator) -> torch.Tensor:
    return torch.randn(N, 3, generator=draw)


def heavy(draw: torch.Generator) -> torch.Tensor:
    """Return noise of Student's t with 3 degrees of freedom, which has no fourth moment."""
    return isotropic(draw) / isotropic(draw).square().mean(dim=-1, keepdim=True).sqrt()


def simulate(densifier: CAdam, scales, *, noise=isotropic, visibility=1.0, looks) -> dict[int, CAdamState]:
    """Return the states at the steps ``looks``, under noise times the ``scales`` of the steps."""
    draw, state, states = torch.Generator().manual_seed(0), densifier.init_state(N, CPU), {}
    for step, scale in enumerate(scales, start=1):
        seen = torch.rand(N, generator=draw) < visibility
        gradient = torch.where(seen[:, None], noise(draw) * scale, 0.0)
        signal = GradientSignal(
            means=gradient, means2d=torch.zeros(1, N, 2), radii=seen[None].float(), height=8, width=8
        )
        state = densifier.observe(state, signal)
        if step in looks:
            states[step] = state
    return states


def passes(densifier: CAdam, state: CAdamState, tau: float = 0.1) -> float:
    """Return the share above an SNR of ``tau``, in percent."""
    return 100 * float((densifier.scores(state)["snr"] > tau).float().mean())


def alarms(densifier: CAdam, state: CAdamState, alpha: float = ALPHA) -> float:
    """Return the share of noise that passes the calibrated gate."""
    threshold = snr_threshold(alpha, densifier.beta1, densifier.beta2, state.age)
    return float((densifier.scores(state)["snr"] > threshold).float().mean())


def falling(steps: int) -> list[float]:
    return torch.logspace(0, -1, steps).tolist()


def rising(steps: int) -> list[float]:
    return torch.logspace(0, 1, steps).tolist()


def gamma_of_ism(steps: int) -> list[float]:
    """Return ISM's published weight of each step: t is uniform up to a bound that falls from 0.98 to 0.5."""
    draw = torch.Generator().manual_seed(1)
    bound = 0.98 - 0.48 * (torch.arange(steps) / 1500).clamp_max(1)
    t = 0.02 + (bound - 0.02) * torch.rand(steps, generator=draw)
    return DDPM().gamma(t).tolist()


# The noise floor, and when the published gate rejects noise.


@pytest.mark.parametrize("beta1", [0.0, 0.9, 0.98])
def test_white_noise_has_a_root_mean_square_snr_of_the_square_root_of_its_weights(beta1):
    densifier = cadam(beta1=beta1)
    for age, state in simulate(densifier, [1.0] * 300, looks=(1, 5, 20, 300)).items():
        rms = float(densifier.scores(state)["snr"].square().mean().sqrt())
        expected = math.sqrt(squared_weights(beta1, np.array([float(age)]))[0])
        assert rms == pytest.approx(expected, rel=0.04)
    assert math.sqrt(0.1 / 1.9) == pytest.approx(0.229, abs=5e-4)


@pytest.mark.parametrize(
    ("case", "beta2", "scales", "percent"),
    [
        ("stationary", 0.999, [1.0] * 600, 90),
        ("a scale that falls tenfold, long memory", 0.999, falling(600), 2),
        ("a scale that falls tenfold, short memory", 0.99, falling(600), 63),
        ("a scale that rises tenfold", 0.999, rising(600), 98),
    ],
)
def test_the_published_gate_passes_noise_unless_its_scale_falls(case, beta2, scales, percent):
    densifier = cadam(beta2=beta2)
    state = simulate(densifier, scales, looks=(600,))[600]
    assert passes(densifier, state) == pytest.approx(percent, abs=3), case


@pytest.mark.parametrize(("visibility", "zero", "skip"), [(0.3, 84, 90), (0.02, 29, 96)])
def test_the_published_gate_rejects_rarely_seen_gaussians_unless_unseen_steps_are_skipped(
    visibility, zero, skip
):
    for choice, percent in (("zero", zero), ("skip", skip)):
        densifier = cadam(invisible=choice)
        state = simulate(densifier, [1.0] * 600, visibility=visibility, looks=(600,))[600]
        assert passes(densifier, state) == pytest.approx(percent, abs=3)


@pytest.mark.parametrize(("name", "noise", "signal"), [("cadam", 10, 10), ("cadam_selective", 16, 30)])
def test_shares_selected_without_and_with_a_drift(name, noise, signal):
    """The published gates select a tenth in both cases, the selective ones less if there is only noise."""
    densifier = component(compose(["prompt=noise", f"densifier={name}"]).densifier)
    for offset, percent in ((0.0, noise), (1.0, signal)):
        shifted = simulate(
            densifier, [1.0] * 300, noise=lambda draw, d=offset: isotropic(draw) + d, looks=(300,)
        )
        assert 100 * float(densifier.select(shifted[300], STEP, DRAWS).float().mean()) == pytest.approx(
            percent, abs=3
        )


# The calibrated gate.


@pytest.mark.parametrize(("beta1", "beta2"), [(0.9, 0.81), (0.9, 0.999), (0.98, 0.99)])
def test_the_share_of_isotropic_noise_that_passes_is_alpha_at_every_age(beta1, beta2):
    densifier = cadam(beta1=beta1, beta2=beta2)
    states = simulate(densifier, [1.0] * AGES[-1], looks=AGES)
    for alpha in (0.01, 0.05, 0.2):
        rates = [alarms(densifier, state, alpha) for state in states.values()]
        chance = 4 * math.sqrt(alpha * (1 - alpha) / N)
        assert rates == pytest.approx([alpha] * len(AGES), abs=chance + 0.1 * alpha)
        mean = sum(rates) / len(rates)
        assert mean == pytest.approx(alpha, abs=chance / math.sqrt(len(rates)) + 0.06 * alpha)


@pytest.mark.parametrize("noise", [isotropic, heavy])
@pytest.mark.parametrize("visibility", [0.02, 0.3, 1.0])
def test_with_beta2_of_beta1_squared_noise_never_passes_more_often_than_alpha(noise, visibility):
    densifier = cadam(beta2=0.81)
    states = simulate(densifier, [1.0] * 300, noise=noise, visibility=visibility, looks=AGES)
    assert max(alarms(densifier, state) for state in states.values()) < ALPHA + ERROR


@pytest.mark.parametrize(
    "scales", [falling(600), rising(600), gamma_of_ism(600)], ids=["falls", "rises", "ism"]
)
def test_with_beta2_of_beta1_squared_no_change_of_scale_lets_more_noise_pass(scales):
    looks = range(100, 601, 50)
    short, long = cadam(beta2=0.81), cadam(beta2=0.999)
    rates = [alarms(short, state) for state in simulate(short, scales, looks=looks).values()]
    assert 0.01 < min(rates) <= max(rates) < ALPHA + ERROR
    rates = [alarms(long, state) for state in simulate(long, scales, looks=looks).values()]
    # With a long memory the rate is not constant.
    assert max(rates) > 2 * ALPHA or min(rates) < 0.01


def test_drift_as_strong_as_the_noise_passes_the_calibrated_gate():
    def drifting(draw: torch.Generator) -> torch.Tensor:
        return isotropic(draw) + torch.tensor([1.0, 1.0, 1.0])

    densifier = cadam(beta2=0.81)
    state = simulate(densifier, [1.0] * 60, noise=drifting, looks=(60,))[60]
    assert alarms(densifier, state) > 0.97


def test_select_uses_the_threshold_of_each_age():
    densifier = component(
        compose(["prompt=noise", "densifier=cadam_calibrated", "densifier.min_age=0"]).densifier
    )
    state = simulate(densifier, [1.0] * 60, looks=(60,))[60]
    state = CAdamState(m=state.m, v=state.v, age=state.age.clone())
    state.age[::2] = 30
    drift, noise = densifier.strengths(state)
    threshold = snr_threshold(ALPHA, 0.9, 0.81, state.age)
    assert len(threshold.unique()) == 2
    expected = (drift > threshold * noise) & (drift > drift.quantile(0.9))
    assert torch.equal(densifier.select(state, STEP, DRAWS), expected)
    assert densifier.statistics(state, STEP)["share_above_tau_SNR"] == pytest.approx(
        float((drift > threshold * noise).float().mean())
    )


# The function.


def test_no_gaussian_passes_after_a_single_gradient():
    assert snr_threshold(0.5, 0.9, 0.999, torch.tensor([0, 1, 2])).isinf().tolist() == [True, True, False]
    assert snr_threshold(0.5, 0.9, 0.999, torch.arange(0)).shape == (0,)


def test_the_level_of_white_noise_agrees_with_a_simulation():
    rng = np.random.default_rng(0)
    m, v = np.zeros((4000, 3)), np.zeros((4000, 3))
    # After 3000 steps the start at zero no longer affects the second moment.
    for _ in range(3000):
        gradient = rng.standard_normal((4000, 3))
        m, v = 0.9 * m + 0.1 * gradient, 0.999 * v + 0.001 * gradient**2
    snr = np.linalg.norm(m, axis=1) / np.sqrt(v.sum(axis=1) / (1 - 0.999**3000))
    assert np.sqrt((snr**2).mean()) == pytest.approx(white_noise_snr(0.9, 0.999), rel=0.02)
