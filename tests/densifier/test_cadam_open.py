"""Laws of the choices that the paper leaves open; those of the paper itself are in test_cadam.py."""

import math

import pytest
import torch
from evidence import (
    CPU,
    DRAWS,
    STEP,
    adam,
    cadam,
    noise,
    observe,
    open_cadam,
    signal,
    snr,
    some_gaussians,
)

from cadam3d.core.errors import UserError


def test_with_the_values_of_the_paper_it_equals_cadam():
    gradients = noise(60, 300)
    gradients[:, :50] += 0.3
    gradients[7, 3, 1] = math.nan
    paper, ours = observe(cadam(), gradients), observe(open_cadam(), gradients)
    assert all(torch.equal(rows, getattr(ours, name)) for name, rows in paper.to_dict().items())
    assert torch.equal(cadam().select(paper, STEP, DRAWS), open_cadam().select(ours, STEP, DRAWS))
    assert torch.equal(cadam().unreliable(paper), open_cadam().unreliable(ours))
    assert cadam().statistics(paper, STEP) == open_cadam().statistics(ours, STEP)
    assert cadam().charts() == open_cadam().charts()


@pytest.mark.parametrize("n", [1, 6, 1001])  # vector units have a tail
def test_moments_are_those_of_adam_to_the_bit_if_nothing_is_skipped(n):
    densifier, optimizer = open_cadam(invisible="skip"), adam().start(some_gaussians(n))
    state = densifier.init_state(n, CPU)
    for step, gradient in enumerate(noise(40, n) * torch.logspace(-9, 3, 40)[:, None, None]):
        state = densifier.observe(state, signal(gradient))
        optimizer.gaussians.means.grad = gradient
        optimizer.step(step)
    saved = optimizer.state_dict()
    assert torch.equal(state.m, saved["exp_avg"]["means"])
    assert torch.equal(state.v, saved["exp_avg_sq"]["means"])


def test_unseen_gaussians_age_and_lose_snr_under_zero_and_keep_their_state_under_skip():
    first, nothing = torch.ones(1, 2, 3), torch.zeros(2, 3)
    visible = torch.tensor([[True, False], [True, False]])
    for choice, ages in (("zero", [2, 2]), ("skip", [2, 1])):
        densifier = open_cadam(invisible=choice)
        before = observe(densifier, first)
        after = densifier.observe(before, signal(nothing, visible))
        assert after.age.tolist() == ages
        assert torch.equal(after.m[1], before.m[1]) == (choice == "skip")
        assert snr(densifier, after)[1] == pytest.approx(1.0 if choice == "skip" else 0.67, abs=0.01)


def test_per_step_rms_removes_a_scale_that_all_gaussians_share():
    densifier, gradients = open_cadam(grad_norm="per_step_rms"), noise(50, 30)
    weights = torch.logspace(-3, 3, 50)[torch.randperm(50, generator=torch.Generator().manual_seed(0))]
    plain, weighted = observe(densifier, gradients), observe(densifier, gradients * weights[:, None, None])
    torch.testing.assert_close(plain.m, weighted.m, rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(plain.v, weighted.v, rtol=1e-4, atol=1e-6)
    assert float(densifier.strengths(plain)[1].square().mean()) == pytest.approx(1.0, rel=1e-3)


def test_an_absolute_threshold_selects_by_drift_alone():
    state = observe(open_cadam(), noise(30, 200))
    drift = open_cadam().strengths(state)[0]
    tau_m = float(drift.median())
    momentum = open_cadam(tau_Q=None, tau_SNR=None, tau_m=tau_m, reset="all")
    assert torch.equal(momentum.select(state, STEP, DRAWS), drift > tau_m)
    both = open_cadam(tau_Q=0.2, tau_SNR=0.25, tau_m=tau_m)
    expected = open_cadam(tau_Q=0.2, tau_SNR=0.25).select(state, STEP, DRAWS) & (drift > tau_m)
    assert torch.equal(both.select(state, STEP, DRAWS), expected)
    assert 0 < both.select(state, STEP, DRAWS).sum() < momentum.select(state, STEP, DRAWS).sum()


def test_the_reset_can_have_its_own_threshold():
    state = observe(open_cadam(), noise(60, 300))
    ratio = snr(open_cadam(), state)
    assert torch.equal(open_cadam().unreliable(state), ratio < 0.1)
    for choice in ({"tau_SNR": 0.1}, {"tau_SNR": None}, {"tau_SNR": None, "alpha": 0.05}):
        assert torch.equal(open_cadam(tau_reset=0.3, **choice).unreliable(state), ratio < 0.3)


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"tau_reset": 0.1, "reset": "all"}, "tau_reset"),  # it would have no effect
        ({"tau_SNR": None}, "reset"),  # a selective reset needs a threshold
        ({"alpha": 0.05}, "tau_SNR"),  # two gates on one ratio
        ({"alpha": 0.05, "tau_SNR": None, "tau_reset": 0.1, "beta2": 0.8}, "beta2"),
    ],
)
def test_a_setting_without_effect_or_with_a_misleading_one_is_refused(changes, key):
    with pytest.raises(UserError, match=rf"\.{key}: expected "):
        open_cadam(**changes)
