"""Laws of CAdam (paper sec. 4.2 to 4.4), most of them by simulation of drift plus noise."""

import math

import pytest
import torch
from evidence import (
    CPU,
    DRAWS,
    STEP,
    adam,
    cadam,
    edit_of,
    noise,
    observe,
    signal,
    signal_without_values,
    snr,
    some_gaussians,
)

from cadam3d.core.edit import RowEdit
from cadam3d.core.errors import UserError
from cadam3d.core.reductions import quantile
from cadam3d.core.schedule import Linear
from cadam3d.densifier.refine import Refine

# The moments (eq. 8 and 10).


@pytest.mark.parametrize("n", [1, 6, 1001])  # vector units have a tail
def test_moments_of_a_never_densified_gaussian_are_those_of_adam_to_the_bit(n):
    densifier, optimizer = cadam(), adam().start(some_gaussians(n))
    state = densifier.init_state(n, CPU)
    for step, gradient in enumerate(noise(40, n) * torch.logspace(-9, 3, 40)[:, None, None]):
        state = densifier.observe(state, signal(gradient))
        optimizer.gaussians.means.grad = gradient
        optimizer.step(step)
    saved = optimizer.state_dict()
    assert torch.equal(state.m, saved["exp_avg"]["means"])
    assert torch.equal(state.v, saved["exp_avg_sq"]["means"])


@pytest.mark.parametrize("age", [1, 2, 7, 400])
def test_a_constant_gradient_is_recovered_without_bias_at_every_age(age):
    gradient = torch.tensor([[0.3, -0.4, 1.2]])
    drift, strength = cadam().strengths(observe(cadam(), gradient.repeat(age, 1, 1)))
    torch.testing.assert_close(drift, gradient.norm(dim=-1), rtol=1e-5, atol=0)
    torch.testing.assert_close(strength, gradient.norm(dim=-1), rtol=1e-5, atol=0)


def test_snr_of_pure_noise_settles_at_the_root_of_one_minus_beta1_over_one_plus_beta1():
    ratio = snr(cadam(), observe(cadam(), noise(200, 3000)))
    assert float(ratio.square().mean().sqrt()) == pytest.approx(math.sqrt(0.1 / 1.9), rel=0.02)


def test_observe_never_waits_for_the_device():
    evidence = signal_without_values()
    densifier = cadam()
    state = densifier.observe(densifier.init_state(4, evidence.means.device), evidence)
    assert state.m.shape == (4, 3)


# Rows.


def test_newborns_start_at_age_zero_without_history_and_their_parents_keep_theirs():
    before = observe(cadam(), noise(9, 4))
    after = before.carry(edit_of(4, keep=[0, 1, 3], parents=[1, 2, 2]))
    assert after.age.tolist() == [9, 9, 9, 0, 0, 0]
    assert not after.m[3:].any()
    assert not after.v[3:].any()
    assert torch.equal(after.m[:3], before.m[[0, 1, 3]])
    assert torch.equal(after.v[:3], before.v[[0, 1, 3]])


def test_a_newborn_corrects_its_bias_by_its_own_age():
    gradient = torch.tensor([[2.0, 0.0, 0.0]])
    old = observe(cadam(), gradient.repeat(50, 1, 1))
    both = old.carry(RowEdit(keep=torch.tensor([0]), children=some_gaussians(1), parents=torch.tensor([0])))
    state = cadam().observe(both, signal(gradient.repeat(2, 1)))
    torch.testing.assert_close(cadam().strengths(state)[0], torch.tensor([2.0, 2.0]))


# Selection (eq. 9 and 11).


@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1e3, 1e6])
def test_selection_and_unreliability_do_not_depend_on_the_scale_of_the_gradients(scale):
    gradients = noise(60, 500)
    gradients[:, :100] += 0.3
    plain, scaled = observe(cadam(), gradients), observe(cadam(), gradients * scale)
    assert torch.equal(cadam().select(plain, STEP, DRAWS), cadam().select(scaled, STEP, DRAWS))
    assert torch.equal(cadam().unreliable(plain), cadam().unreliable(scaled))
    assert cadam().select(plain, STEP, DRAWS).any()
    assert cadam().unreliable(plain).any()


def test_selection_follows_a_permutation_of_the_gaussians():
    densifier, gradients = cadam(), noise(30, 200)
    order = torch.randperm(200, generator=torch.Generator().manual_seed(1))
    straight = densifier.select(observe(densifier, gradients), STEP, DRAWS)
    permuted = densifier.select(observe(densifier, gradients[:, order]), STEP, DRAWS)
    assert torch.equal(permuted, straight[order])


def test_drift_is_preferred_to_stronger_noise():
    gradients = noise(200, 1000) * 3
    gradients[:, :50] = gradients[:, :50] / 10 + torch.tensor([2.5, 0.0, 0.0])
    chosen = cadam().select(observe(cadam(), gradients), STEP, DRAWS)
    assert chosen[:50].all()
    assert gradients[:, :50].norm(dim=-1).mean() < gradients[:, 50:].norm(dim=-1).mean()


def test_with_a_rising_quantile_many_gaussians_grow_early_and_few_late():
    densifier = cadam(tau_Q=Linear(start=0.5, end=0.98, begin=100, steps=150), tau_SNR=0.0)
    state = observe(densifier, noise(30, 1001))
    selected = [int(densifier.select(state, step, DRAWS).sum()) for step in (1, 100, 175, 250, 10_000)]
    assert selected == [500, 500, 260, 20, 20]
    at_each = [densifier.statistics(state, step)["drift_threshold"] for step in (100, 250)]
    assert at_each[0] < at_each[1]


@pytest.mark.parametrize("tau_Q", [0.0, 0.5, 0.9, 0.99])
@pytest.mark.parametrize("n", [1, 2, 10, 101, 1000])
def test_the_quantile_alone_selects_its_share(n, tau_Q):
    densifier = cadam(tau_Q=tau_Q, tau_SNR=0.0)
    selected = int(densifier.select(observe(densifier, noise(5, n)), STEP, DRAWS).sum())
    assert selected == math.ceil((1 - tau_Q) * (n - 1) - 1e-9)


def test_equal_drifts_select_no_gaussian():
    same = torch.ones(10, 20, 3)
    assert not cadam().select(observe(cadam(), same), STEP, DRAWS).any()


def test_the_snr_gate_rejects_strong_but_unsteady_drift():
    gradients = noise(400, 1000)
    lenient, strict = cadam(tau_SNR=0.0), cadam(tau_SNR=10.0)
    assert lenient.select(observe(lenient, gradients), STEP, DRAWS).sum() == 100
    assert not strict.select(observe(strict, gradients), STEP, DRAWS).any()


def test_growth_is_bounded_by_the_quantile_at_every_call():
    refine = Refine(
        steps=100,
        last_max_scale=None,
        last_min_alpha=None,
        min_contribution=None,
        start=0,
        end=100,
        interval=5,
        tau_scale=0.01,
        split_children=2,
        split_shrink=1.6,
        min_opacity=0.0,
        max_scale=None,
        prune_from=0,
        reset_interval=None,
        reset_from=0,
        reset_until=0,
        reset_value=0.01,
        recovery=96,
        prune_grace=0,
        max_gaussians=None,
    )
    densifier, gaussians = cadam(tau_SNR=0.0), some_gaussians(400)
    gaussians.log_scales[::2] = -6.0
    state, draw = densifier.init_state(400, CPU), torch.Generator().manual_seed(0)
    for step in range(1, 60):
        state = densifier.observe(state, signal(torch.randn(len(gaussians), 3, generator=draw)))
        if refine.refines_at(step):
            n = len(gaussians)
            plan = refine.plan(gaussians, densifier.select(state, STEP, DRAWS), step, draw)
            gaussians, state = plan.edit.apply(gaussians), state.carry(plan.edit)
            assert n < len(gaussians) <= math.ceil(n * (1 + 0.1))
    assert len(gaussians) > 1000


def test_growth_ends_softly_when_drift_fades_under_noise_of_changing_strength():
    steps, n = 600, 1000
    # The noise of a settling scene becomes ten times weaker.
    strength = torch.logspace(0, -1, steps)[:, None, None]
    gradients = noise(steps, n) * strength
    drifting = gradients.clone()
    drifting[:, :, 0] += strength[:, :, 0]
    drifting[steps // 2 :] = gradients[steps // 2 :]

    early, late = observe(cadam(), drifting[: steps // 2]), observe(cadam(), drifting)
    passing = [float((snr(cadam(), state) > 0.1).float().mean()) for state in (early, late)]
    assert passing[0] > 0.99
    assert passing[1] < 0.2
    assert cadam().select(early, STEP, DRAWS).sum() == 100
    assert cadam().select(late, STEP, DRAWS).sum() < 100
    # Under the quantile alone, growth never ends.
    assert cadam(tau_SNR=0.0).select(late, STEP, DRAWS).sum() == 100


def test_young_gaussians_do_not_grow_before_min_age():
    gradients = noise(19, 50)
    assert not cadam(min_age=20).select(observe(cadam(), gradients), STEP, DRAWS).any()
    assert cadam(min_age=19).select(observe(cadam(), gradients), STEP, DRAWS).any()


def test_without_gates_every_gaussian_with_a_gradient_is_selected():
    gradients = noise(30, 20)
    gradients[:, 12:] = 0.0
    densifier = cadam(tau_Q=None, tau_SNR=None, reset="none")
    assert densifier.select(observe(densifier, gradients), STEP, DRAWS).tolist() == [True] * 12 + [False] * 8


# The selective opacity reset (eq. 13), and the others.


@pytest.mark.parametrize(("reset", "share"), [("all", 1.0), ("none", 0.0)])
def test_a_reset_of_all_or_none_does_not_depend_on_the_moments(reset, share):
    densifier = cadam(reset=reset)
    assert float(densifier.unreliable(observe(densifier, noise(30, 40))).float().mean()) == share


def test_the_selective_reset_lowers_only_noisy_gaussians_and_never_raises_one():
    gradients = noise(300, 60)
    gradients[:, :20] += 2.0
    state, optimizer = observe(cadam(), gradients), adam().start(some_gaussians(60))
    optimizer.gaussians.opacity_logits.data[40:] = -6.0  # fainter than 0.01 already
    before = optimizer.gaussians.opacities.detach().clone()
    densifier = cadam(tau_SNR=0.3)
    ratio = snr(densifier, state)
    optimizer.reset_opacity(densifier.unreliable(state), 0.01)
    after = optimizer.gaussians.opacities.detach()
    lowered = after < before
    assert torch.equal(lowered, (ratio < 0.3) & (before > 0.01))
    assert lowered.any()
    assert not lowered[:20].any()
    assert (after <= before).all()


def test_no_gaussian_is_both_selected_and_unreliable():
    densifier, state = cadam(tau_SNR=0.2), observe(cadam(), noise(100, 500))
    assert not (densifier.select(state, STEP, DRAWS) & densifier.unreliable(state)).any()


def test_young_gaussians_are_not_called_unreliable():
    state = observe(cadam(), torch.zeros(5, 2, 3))
    assert not cadam(reset_min_age=6).unreliable(state).any()
    assert cadam(reset_min_age=5).unreliable(state).all()


# The quantile, the statistics, the checks.


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 0.999, 1.0])
@pytest.mark.parametrize("n", [1, 2, 3, 10, 1001])
def test_quantile_agrees_with_torch(n, share):
    values = torch.randn(n, generator=torch.Generator().manual_seed(n), dtype=torch.float64)
    torch.testing.assert_close(quantile(values, share), torch.quantile(values, share), rtol=1e-12, atol=0)


def test_quantile_has_no_limit_on_the_count():
    # torch.quantile refuses this many values, and float32 cannot represent their number.
    n = 2**24 + 3
    descending = torch.arange(n - 1, -1, -1, dtype=torch.int32).sub_(n // 2).float()
    assert float(quantile(descending, 0.25)) == (n - 1) / 4 - n // 2  # halfway between two values


def test_statistics_are_computed_from_drift_and_noise():
    state = observe(cadam(), noise(50, 100))
    numbers = cadam().statistics(state, STEP)
    ratio, (drift, _) = snr(cadam(), state), cadam().strengths(state)
    assert numbers["age_median"] == 50
    assert numbers["snr_p50"] == pytest.approx(float(torch.quantile(ratio, 0.5)), rel=1e-5)
    assert numbers["snr_p10"] < numbers["snr_p50"] < numbers["snr_p90"]
    assert numbers["share_above_tau_SNR"] == pytest.approx(float((ratio > 0.1).float().mean()))
    assert numbers["drift_threshold"] == pytest.approx(float(torch.quantile(drift, 0.9)), rel=1e-5)
    assert numbers["drift_median"] == pytest.approx(float(torch.quantile(drift, 0.5)), rel=1e-5)


def test_the_selective_reset_needs_a_threshold():
    assert cadam(tau_SNR=None, reset="all").tau_SNR is None
    with pytest.raises(UserError, match=r"densifier\.reset: .* Try: densifier\.reset=all"):
        cadam(tau_SNR=None)
