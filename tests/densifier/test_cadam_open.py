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
    edit_of,
    noise,
    observe,
    open_cadam,
    signal,
    snr,
    some_gaussians,
)

from cadam3d.core.errors import UserError
from cadam3d.densifier.cadam import CAdamState


def test_with_the_values_of_the_paper_it_equals_cadam():
    gradients = noise(60, 300)
    gradients[:, :50] += 0.3
    gradients[7, 3, 1] = math.nan
    paper, ours = observe(cadam(), gradients), observe(open_cadam(), gradients)
    assert all(torch.equal(rows, getattr(ours, name)) for name, rows in paper.to_dict().items())
    edit = edit_of(300, keep=[0, 2, 3], parents=[2, 5])
    carried = cadam().carry(paper, edit), open_cadam().carry(ours, edit)
    assert all(torch.equal(rows, getattr(carried[1], name)) for name, rows in carried[0].to_dict().items())
    assert torch.equal(cadam().select(paper, STEP, DRAWS), open_cadam().select(ours, STEP, DRAWS))
    assert torch.equal(cadam().unreliable(paper), open_cadam().unreliable(ours))
    assert cadam().statistics(paper, STEP) == open_cadam().statistics(ours, STEP)
    assert cadam().charts() == open_cadam().charts()


@pytest.mark.parametrize("choice", [{"nonfinite": "skip_row"}, {"invisible": "skip"}])
@pytest.mark.parametrize("n", [1, 6, 1001])  # vector units have a tail
def test_moments_are_those_of_adam_to_the_bit_if_nothing_is_skipped(n, choice):
    densifier, optimizer = open_cadam(**choice), adam().start(some_gaussians(n))
    state = densifier.init_state(n, CPU)
    for step, gradient in enumerate(noise(40, n) * torch.logspace(-9, 3, 40)[:, None, None]):
        state = densifier.observe(state, signal(gradient))
        optimizer.gaussians.means.grad = gradient
        optimizer.step(step)
    saved = optimizer.state_dict()
    assert torch.equal(state.m, saved["exp_avg"]["means"])
    assert torch.equal(state.v, saved["exp_avg_sq"]["means"])


def test_observe_modifies_neither_the_old_state_nor_the_signal():
    before = observe(open_cadam(), noise(3, 5))
    copy = CAdamState(**{name: tensor.clone() for name, tensor in before.to_dict().items()})
    evidence = signal(noise(1, 5, seed=1)[0])
    gradient = evidence.means.clone()
    for choice in ({"invisible": "skip"}, {"grad_norm": "per_step_rms"}, {"nonfinite": "skip_row"}):
        open_cadam(**choice).observe(before, evidence)
        assert all(torch.equal(tensor, getattr(copy, name)) for name, tensor in before.to_dict().items())
        assert torch.equal(evidence.means, gradient)


@pytest.mark.parametrize("parent_state", ["keep", "reset"])
@pytest.mark.parametrize("child_state", ["zero", "inherit", "inherit_half"])
def test_histories_after_an_edit_are_as_chosen(child_state, parent_state):
    densifier = open_cadam(child_state=child_state, parent_state=parent_state)
    before = observe(densifier, noise(steps=5, n=4))
    untouched = {name: rows.clone() for name, rows in before.to_dict().items()}
    after = densifier.carry(before, edit_of(4, keep=[0, 1, 3], parents=[1, 2, 2]))
    for name, old in untouched.items():
        new = after.to_dict()[name]
        assert torch.equal(getattr(before, name), old)
        assert torch.equal(new[[0, 2]], old[[0, 3]])  # survivors without children
        assert torch.equal(new[1], old[1] if parent_state == "keep" else torch.zeros_like(old[1]))
        share = {"zero": 0, "inherit": 1, "inherit_half": {"m": 0.5, "v": 0.25, "age": 1}[name]}[child_state]
        assert torch.equal(new[3:], (old[[1, 2, 2]] * share).to(old.dtype))


def test_inheriting_half_is_the_history_of_a_gaussian_with_half_the_gradients():
    densifier, gradients = open_cadam(child_state="inherit_half"), noise(steps=7, n=4)
    after = densifier.carry(observe(densifier, gradients), edit_of(4, keep=[], parents=[0, 1, 2, 3]))
    halved = observe(densifier, gradients / 2)
    assert all(torch.equal(rows, getattr(halved, name)) for name, rows in after.to_dict().items())


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


def test_the_population_of_the_quantile_can_exclude_young_and_unseen_gaussians():
    state = observe(open_cadam(), noise(30, 100))
    state = CAdamState(m=state.m.clone(), v=state.v.clone(), age=state.age.clone())
    state.age[50:70] = 5  # young
    state.m[70:], state.v[70:] = 0.0, 0.0  # never seen
    sizes = {"all": 100, "mature": 80, "seen": 70}
    drift = open_cadam().strengths(state)[0]
    members = {
        "all": drift,
        "mature": torch.cat([drift[:50], drift[70:]]),
        "seen": drift[:70],
    }
    for choice, size in sizes.items():
        densifier = open_cadam(quantile_over=choice, min_age=20, tau_SNR=0.0)
        assert len(members[choice]) == size
        expected = (drift > torch.quantile(members[choice], 0.9)) & (state.age >= 20)
        assert torch.equal(densifier.select(state, STEP, DRAWS), expected)


@pytest.mark.parametrize("choice", ["mature", "seen"])
def test_an_empty_population_selects_no_gaussian(choice):
    densifier = open_cadam(quantile_over=choice, min_age=1)
    state = densifier.init_state(4, CPU)
    assert not densifier.select(state, STEP, DRAWS).any()
    assert "drift_threshold" not in densifier.statistics(state, STEP)


def test_per_step_rms_removes_a_scale_that_all_gaussians_share():
    densifier, gradients = open_cadam(grad_norm="per_step_rms"), noise(50, 30)
    weights = torch.logspace(-3, 3, 50)[torch.randperm(50, generator=torch.Generator().manual_seed(0))]
    plain, weighted = observe(densifier, gradients), observe(densifier, gradients * weights[:, None, None])
    torch.testing.assert_close(plain.m, weighted.m, rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(plain.v, weighted.v, rtol=1e-4, atol=1e-6)
    assert float(densifier.strengths(plain)[1].square().mean()) == pytest.approx(1.0, rel=1e-3)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
@pytest.mark.parametrize("grad_norm", ["none", "per_step_rms"])
def test_a_gradient_that_is_not_finite_skips_the_step_or_its_row(bad, grad_norm):
    gradient = torch.ones(3, 3)
    gradient[1, 2] = bad
    for choice, ages in (("skip_step", [4, 4, 4]), ("skip_row", [5, 4, 5])):
        densifier = open_cadam(nonfinite=choice, grad_norm=grad_norm)
        before = observe(densifier, noise(4, 3))
        after = densifier.observe(before, signal(gradient))
        assert after.age.tolist() == ages
        assert after.m.isfinite().all()
        assert after.v.isfinite().all()
        assert torch.equal(after.m[1], before.m[1])
        assert torch.equal(after.m[0], before.m[0]) == (choice == "skip_step")


def test_only_an_eps_relative_to_the_median_noise_is_independent_of_the_scale():
    gradients = noise(60, 501)
    for mode, is_free in (("abs", False), ("rel_median", True)):
        densifier = open_cadam(eps=0.5, eps_mode=mode)
        plain, tiny = observe(densifier, gradients), observe(densifier, gradients * 2.0**-20)
        equal = torch.allclose(densifier.scores(plain)["snr"], densifier.scores(tiny)["snr"])
        assert equal == is_free
    drift, strength = open_cadam().strengths(plain)
    expected = drift / (strength + 0.5 * strength.quantile(0.5))
    torch.testing.assert_close(open_cadam(eps=0.5, eps_mode="rel_median").scores(plain)["snr"], expected)


def test_the_median_noise_excludes_gaussians_without_any_gradient_which_stay_unreliable():
    gradients = noise(30, 40)
    gradients[:, 10:] = 0.0
    densifier = open_cadam(eps=1e-3, eps_mode="rel_median")
    state = observe(densifier, gradients)
    snr_alone = densifier.scores(observe(densifier, gradients[:, :10]))["snr"]
    torch.testing.assert_close(densifier.scores(state)["snr"][:10], snr_alone)
    assert densifier.unreliable(state)[10:].all()
    assert densifier.unreliable(observe(densifier, gradients[:, 10:])).all()


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


def test_a_reset_clears_the_moments_of_its_gaussians_on_request():
    before = observe(open_cadam(), noise(9, 6))
    rows = torch.tensor([True, False, True, False, False, False])
    assert open_cadam().after_reset(before, rows) is before
    after = open_cadam(reset_moments=True).after_reset(before, rows)
    for name, old in before.to_dict().items():
        assert not getattr(after, name)[rows].any()
        assert torch.equal(getattr(after, name)[~rows], old[~rows])
        assert old[rows].any()


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("tau_m", -1.0),
        ("invisible", "maybe"),
        ("quantile_over", "some"),
        ("grad_norm", "max"),
        ("nonfinite", "crash"),
        ("eps_mode", "rel"),
        ("grad_source", "all"),
        ("child_state", "half"),
        ("parent_state", "lose"),
        ("tau_reset", -0.1),
    ],
)
def test_an_impossible_value_of_an_open_choice_is_refused_by_name(key, value):
    with pytest.raises(UserError, match=rf"densifier\.{key}"):
        open_cadam(**{key: value})


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"tau_reset": 0.1, "reset": "all"}, "tau_reset"),  # it would have no effect
        ({"tau_SNR": None}, "reset"),  # a selective reset needs a threshold
        ({"alpha": 0.05}, "tau_SNR"),  # two gates on one ratio
        ({"alpha": 1.0, "tau_SNR": None, "tau_reset": 0.1}, "alpha"),
        ({"alpha": 0.05, "tau_SNR": None, "tau_reset": 0.1, "beta2": 0.8}, "beta2"),
    ],
)
def test_a_setting_without_effect_or_with_a_misleading_one_is_refused(changes, key):
    with pytest.raises(UserError, match=rf"densifier\.{key}: expected "):
        open_cadam(**changes)
