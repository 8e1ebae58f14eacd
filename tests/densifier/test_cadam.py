"""Laws of CAdam (paper sec. 4.2-4.4), most of them by simulation of drift plus noise."""

import math

import pytest
import torch

from cadam3d.core.checks import UserError
from cadam3d.core.edit import RowEdit
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.schedule import Linear
from cadam3d.densifier.base import GradientSignal
from cadam3d.densifier.cadam import CAdam, CAdamState, quantile
from cadam3d.densifier.refine import Refine
from cadam3d.optimizer import AdamSettings

CPU = torch.device("cpu")
STEP = 100  # of a call; no matter, unless a schedule asks
LOTS = torch.Generator()  # nobody here draws any


def cadam(**changes) -> CAdam:
    paper = {
        "tau_Q": 0.9,
        "tau_m": None,
        "tau_SNR": 0.1,
        "alpha": None,
        "beta1": 0.9,
        "beta2": 0.999,
        "eps": 1e-15,
        "eps_mode": "abs",
        "grad_source": "total",
        "grad_norm": "none",
        "invisible": "zero",
        "nonfinite": "skip_step",
        "min_age": 0,
        "quantile_over": "all",
        "child_state": "zero",
        "parent_state": "keep",
        "reset": "unreliable",
        "tau_reset": None,
        "reset_min_age": 0,
        "reset_moments": False,
    }
    return CAdam(**{**paper, **changes})


def signal(means: torch.Tensor, visible: torch.Tensor | None = None) -> GradientSignal:
    n = len(means)
    visible = torch.ones(1, n, dtype=torch.bool) if visible is None else visible
    return GradientSignal(
        means=means, means2d=torch.zeros(len(visible), n, 2), radii=visible.float(), height=8, width=8
    )


def observe(densifier: CAdam, gradients: torch.Tensor) -> CAdamState:
    """The state after all ``gradients`` ("t n 3"), from birth."""
    state = densifier.init_state(gradients.shape[1], CPU)
    for step in gradients:
        state = densifier.observe(state, signal(step))
    return state


def noise(steps: int, n: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(steps, n, 3, generator=torch.Generator().manual_seed(seed))


def snr(densifier: CAdam, state: CAdamState) -> torch.Tensor:
    drift, strength = densifier.strengths(state)
    return drift / strength


def some_gaussians(n: int) -> Gaussians:
    return Gaussians(
        means=noise(1, n)[0],
        log_scales=torch.full((n, 3), -4.0),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        opacity_logits=torch.linspace(-2.0, 2.0, n),
        sh=torch.zeros(n, 1, 3),
    )


def adam() -> AdamSettings:
    rates = ("means_lr", "sh_dc_lr", "sh_rest_lr", "opacity_lr", "scale_lr", "quat_lr")
    return AdamSettings(**dict.fromkeys(rates, 0.01), beta1=0.9, beta2=0.999, eps=1e-15, clip_norm=None)


def edit_of(n: int, keep: list[int], parents: list[int]) -> RowEdit:
    return RowEdit(
        keep=rows_of(keep),
        children=some_gaussians(n).index(rows_of(parents)),
        parents=rows_of(parents),
    )


def rows_of(rows: list[int]) -> torch.Tensor:
    return torch.tensor(rows, dtype=torch.int64)


# The moments (eq. 8 and 10).


@pytest.mark.parametrize("choice", [{}, {"nonfinite": "skip_row"}, {"invisible": "skip"}])
@pytest.mark.parametrize("n", [1, 6, 1001])  # vector units have a tail
def test_moments_of_a_never_densified_gaussian_are_those_of_adam_to_the_bit(n, choice):
    densifier, optimizer = cadam(**choice), adam().start(some_gaussians(n))
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


def test_snr_is_one_at_age_one_whatever_the_gradient():
    torch.testing.assert_close(snr(cadam(), observe(cadam(), noise(1, 100))), torch.ones(100))


def test_snr_of_pure_noise_settles_at_the_root_of_one_minus_beta1_over_one_plus_beta1():
    ratio = snr(cadam(), observe(cadam(), noise(200, 3000)))
    assert float(ratio.square().mean().sqrt()) == pytest.approx(math.sqrt(0.1 / 1.9), rel=0.02)


def test_observe_leaves_the_old_state_and_the_signal_alone():
    before = observe(cadam(), noise(3, 5))
    copy = CAdamState(**{name: tensor.clone() for name, tensor in before.to_dict().items()})
    evidence = signal(noise(1, 5, seed=1)[0])
    gradient = evidence.means.clone()
    for choice in ({}, {"invisible": "skip"}, {"grad_norm": "per_step_rms"}, {"nonfinite": "skip_row"}):
        cadam(**choice).observe(before, evidence)
        assert all(torch.equal(tensor, getattr(copy, name)) for name, tensor in before.to_dict().items())
        assert torch.equal(evidence.means, gradient)


@pytest.mark.parametrize(
    "choice", [{}, {"invisible": "skip"}, {"grad_norm": "per_step_rms"}, {"nonfinite": "skip_row"}]
)
def test_observe_never_waits_for_the_device(choice):
    meta = torch.device("meta")  # its tensors have no values, so reading one is an error
    densifier = cadam(**choice)
    evidence = GradientSignal(
        means=torch.empty(4, 3, device=meta),
        means2d=torch.empty(2, 4, 2, device=meta),
        radii=torch.empty(2, 4, device=meta),
        height=8,
        width=8,
    )
    state = densifier.observe(densifier.init_state(4, meta), evidence)
    assert state.m.shape == (4, 3)


def test_the_state_takes_28_bytes_per_gaussian():
    state = cadam().init_state(10, CPU)
    assert sum(tensor.nbytes for tensor in state.to_dict().values()) == 280


# Rows.


def test_newborns_start_at_age_zero_without_history_and_their_parents_keep_theirs():
    before = observe(cadam(), noise(9, 4))
    after = before.carry(edit_of(4, keep=[0, 1, 3], parents=[1, 2, 2]))
    assert after.age.tolist() == [9, 9, 9, 0, 0, 0]
    assert not after.m[3:].any()
    assert not after.v[3:].any()
    assert torch.equal(after.m[:3], before.m[[0, 1, 3]])
    assert torch.equal(after.v[:3], before.v[[0, 1, 3]])


@pytest.mark.parametrize("parent_state", ["keep", "reset"])
@pytest.mark.parametrize("child_state", ["zero", "inherit", "inherit_half"])
def test_who_keeps_a_history_through_an_edit_can_be_chosen(child_state, parent_state):
    densifier = cadam(child_state=child_state, parent_state=parent_state)
    before = observe(densifier, noise(steps=5, n=4))
    untouched = {name: rows.clone() for name, rows in before.to_dict().items()}
    after = densifier.carry(before, edit_of(4, keep=[0, 1, 3], parents=[1, 2, 2]))
    for name, old in untouched.items():
        new = after.to_dict()[name]
        assert torch.equal(getattr(before, name), old)
        assert torch.equal(new[[0, 2]], old[[0, 3]])  # survivors that are nobody's parent
        assert torch.equal(new[1], old[1] if parent_state == "keep" else torch.zeros_like(old[1]))
        share = {"zero": 0, "inherit": 1, "inherit_half": {"m": 0.5, "v": 0.25, "age": 1}[name]}[child_state]
        assert torch.equal(new[3:], (old[[1, 2, 2]] * share).to(old.dtype))


def test_inheriting_half_is_the_history_of_a_gaussian_with_half_the_gradients():
    densifier, gradients = cadam(child_state="inherit_half"), noise(steps=7, n=4)
    after = densifier.carry(observe(densifier, gradients), edit_of(4, keep=[], parents=[0, 1, 2, 3]))
    halved = observe(densifier, gradients / 2)
    assert all(torch.equal(rows, getattr(halved, name)) for name, rows in after.to_dict().items())


def test_a_newborn_corrects_its_bias_by_its_own_age():
    gradient = torch.tensor([[2.0, 0.0, 0.0]])
    old = observe(cadam(), gradient.repeat(50, 1, 1))
    both = old.carry(RowEdit(keep=torch.tensor([0]), children=some_gaussians(1), parents=torch.tensor([0])))
    state = cadam().observe(both, signal(gradient.repeat(2, 1)))
    torch.testing.assert_close(cadam().strengths(state)[0], torch.tensor([2.0, 2.0]))


def test_a_newborn_that_saw_nothing_has_no_nan():
    drift, strength = cadam().strengths(cadam().init_state(3, CPU))
    assert drift.tolist() == strength.tolist() == [0.0, 0.0, 0.0]


# Selection (eq. 9 and 11).


@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1e3, 1e6])
def test_selection_and_distrust_do_not_depend_on_the_scale_of_the_gradients(scale):
    gradients = noise(60, 500)
    gradients[:, :100] += 0.3
    plain, scaled = observe(cadam(), gradients), observe(cadam(), gradients * scale)
    assert torch.equal(cadam().select(plain, STEP, LOTS), cadam().select(scaled, STEP, LOTS))
    assert torch.equal(cadam().unreliable(plain), cadam().unreliable(scaled))
    assert cadam().select(plain, STEP, LOTS).any()
    assert cadam().unreliable(plain).any()


@pytest.mark.parametrize("choice", [{}, {"grad_norm": "per_step_rms"}, {"quantile_over": "seen"}])
def test_selection_follows_a_permutation_of_the_gaussians(choice):
    densifier, gradients = cadam(**choice), noise(30, 200)
    order = torch.randperm(200, generator=torch.Generator().manual_seed(1))
    straight = densifier.select(observe(densifier, gradients), STEP, LOTS)
    permuted = densifier.select(observe(densifier, gradients[:, order]), STEP, LOTS)
    assert torch.equal(permuted, straight[order])


def test_drift_is_preferred_to_stronger_noise():
    gradients = noise(200, 1000) * 3
    gradients[:, :50] = gradients[:, :50] / 10 + torch.tensor([2.5, 0.0, 0.0])
    chosen = cadam().select(observe(cadam(), gradients), STEP, LOTS)
    assert chosen[:50].all()
    assert gradients[:, :50].norm(dim=-1).mean() < gradients[:, 50:].norm(dim=-1).mean()


def test_a_quantile_that_rises_lets_many_grow_early_and_few_late():
    densifier = cadam(tau_Q=Linear(start=0.5, end=0.98, begin=100, steps=150), tau_SNR=0.0)
    state = observe(densifier, noise(30, 1001))
    selected = [int(densifier.select(state, step, LOTS).sum()) for step in (1, 100, 175, 250, 10_000)]
    assert selected == [500, 500, 260, 20, 20]
    at_each = [densifier.statistics(state, step)["drift_threshold"] for step in (100, 250)]
    assert at_each[0] < at_each[1]


@pytest.mark.parametrize("tau_Q", [0.0, 0.5, 0.9, 0.99])
@pytest.mark.parametrize("n", [1, 2, 10, 101, 1000])
def test_the_quantile_alone_selects_its_share(n, tau_Q):
    densifier = cadam(tau_Q=tau_Q, tau_SNR=0.0)
    selected = int(densifier.select(observe(densifier, noise(5, n)), STEP, LOTS).sum())
    assert selected == math.ceil((1 - tau_Q) * (n - 1) - 1e-9)


def test_equal_drifts_select_nobody():
    same = torch.ones(10, 20, 3)
    assert not cadam().select(observe(cadam(), same), STEP, LOTS).any()


def test_the_gate_vetoes_strong_but_unsteady_drift():
    gradients = noise(400, 1000)
    lenient, strict = cadam(tau_SNR=0.0), cadam(tau_SNR=10.0)
    assert lenient.select(observe(lenient, gradients), STEP, LOTS).sum() == 100
    assert not strict.select(observe(strict, gradients), STEP, LOTS).any()


def test_growth_is_bounded_by_the_quantile_at_every_call():
    refine = Refine(
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
            plan = refine.plan(gaussians, densifier.select(state, STEP, LOTS), step, draw)
            gaussians, state = plan.edit.apply(gaussians), state.carry(plan.edit)
            assert n < len(gaussians) <= math.ceil(n * (1 + 0.1))
    assert len(gaussians) > 1000


def test_growth_ends_softly_when_drift_fades_under_noise_of_changing_strength():
    steps, n = 600, 1000
    strength = torch.logspace(0, -1, steps)[:, None, None]  # the noise of a settling scene: ten times weaker
    gradients = noise(steps, n) * strength
    drifting = gradients.clone()
    drifting[:, :, 0] += strength[:, :, 0]
    drifting[steps // 2 :] = gradients[steps // 2 :]

    early, late = observe(cadam(), drifting[: steps // 2]), observe(cadam(), drifting)
    passing = [float((snr(cadam(), state) > 0.1).float().mean()) for state in (early, late)]
    assert passing[0] > 0.99
    assert passing[1] < 0.2
    assert cadam().select(early, STEP, LOTS).sum() == 100
    assert cadam().select(late, STEP, LOTS).sum() < 100
    assert cadam(tau_SNR=0.0).select(late, STEP, LOTS).sum() == 100  # the quantile alone never ends


# The choices that the paper leaves open.


def test_unseen_gaussians_age_and_lose_snr_under_zero_and_stand_still_under_skip():
    first, nothing = torch.ones(1, 2, 3), torch.zeros(2, 3)
    visible = torch.tensor([[True, False], [True, False]])
    for choice, ages in (("zero", [2, 2]), ("skip", [2, 1])):
        densifier = cadam(invisible=choice)
        before = observe(densifier, first)
        after = densifier.observe(before, signal(nothing, visible))
        assert after.age.tolist() == ages
        assert torch.equal(after.m[1], before.m[1]) == (choice == "skip")
        assert snr(densifier, after)[1] == pytest.approx(1.0 if choice == "skip" else 0.67, abs=0.01)


def test_being_seen_by_one_view_of_the_batch_is_being_seen():
    densifier = cadam(invisible="skip")
    visible = torch.tensor([[True, False, False], [False, True, False]])
    state = densifier.observe(densifier.init_state(3, CPU), signal(torch.ones(3, 3), visible))
    assert state.age.tolist() == [1, 1, 0]


def test_the_young_may_not_grow_before_min_age():
    gradients = noise(19, 50)
    assert not cadam(min_age=20).select(observe(cadam(), gradients), STEP, LOTS).any()
    assert cadam(min_age=19).select(observe(cadam(), gradients), STEP, LOTS).any()


def test_the_population_of_the_quantile_can_leave_out_the_young_and_the_unseen():
    state = observe(cadam(), noise(30, 100))
    state = CAdamState(m=state.m.clone(), v=state.v.clone(), age=state.age.clone())
    state.age[50:70] = 5  # young
    state.m[70:], state.v[70:] = 0.0, 0.0  # never seen
    sizes = {"all": 100, "mature": 80, "seen": 70}
    drift = cadam().strengths(state)[0]
    members = {
        "all": drift,
        "mature": torch.cat([drift[:50], drift[70:]]),
        "seen": drift[:70],
    }
    for choice, size in sizes.items():
        densifier = cadam(quantile_over=choice, min_age=20, tau_SNR=0.0)
        assert len(members[choice]) == size
        expected = (drift > torch.quantile(members[choice], 0.9)) & (state.age >= 20)
        assert torch.equal(densifier.select(state, STEP, LOTS), expected)


@pytest.mark.parametrize("choice", ["mature", "seen"])
def test_an_empty_population_selects_nobody(choice):
    densifier = cadam(quantile_over=choice, min_age=1)
    state = densifier.init_state(4, CPU)
    assert not densifier.select(state, STEP, LOTS).any()
    assert "drift_threshold" not in densifier.statistics(state, STEP)


def test_per_step_rms_removes_a_scale_that_all_gaussians_share():
    densifier, gradients = cadam(grad_norm="per_step_rms"), noise(50, 30)
    weights = torch.logspace(-3, 3, 50)[torch.randperm(50, generator=torch.Generator().manual_seed(0))]
    plain, weighted = observe(densifier, gradients), observe(densifier, gradients * weights[:, None, None])
    torch.testing.assert_close(plain.m, weighted.m, rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(plain.v, weighted.v, rtol=1e-4, atol=1e-6)
    assert float(densifier.strengths(plain)[1].square().mean()) == pytest.approx(1.0, rel=1e-3)


def test_per_step_rms_of_no_gradient_at_all_is_zero():
    state = observe(cadam(grad_norm="per_step_rms"), torch.zeros(2, 3, 3))
    assert not state.m.any()
    assert not state.v.any()


@pytest.mark.parametrize("bad", [math.nan, math.inf])
@pytest.mark.parametrize("grad_norm", ["none", "per_step_rms"])
def test_a_gradient_that_is_not_finite_skips_the_step_or_its_row(bad, grad_norm):
    gradient = torch.ones(3, 3)
    gradient[1, 2] = bad
    for choice, ages in (("skip_step", [4, 4, 4]), ("skip_row", [5, 4, 5])):
        densifier = cadam(nonfinite=choice, grad_norm=grad_norm)
        before = observe(densifier, noise(4, 3))
        after = densifier.observe(before, signal(gradient))
        assert after.age.tolist() == ages
        assert after.m.isfinite().all()
        assert after.v.isfinite().all()
        assert torch.equal(after.m[1], before.m[1])
        assert torch.equal(after.m[0], before.m[0]) == (choice == "skip_step")


@pytest.mark.parametrize("grad_norm", ["none", "per_step_rms"])
def test_under_skip_row_the_others_do_not_notice_a_bad_row(grad_norm):
    densifier = cadam(nonfinite="skip_row", grad_norm=grad_norm)
    bad, zero = noise(1, 3)[0], noise(1, 3)[0]
    bad[1, 2], zero[1] = math.nan, 0.0
    with_bad, with_zero = (observe(densifier, gradient[None]) for gradient in (bad, zero))
    assert torch.equal(with_bad.m[[0, 2]], with_zero.m[[0, 2]])
    assert torch.equal(with_bad.v[[0, 2]], with_zero.v[[0, 2]])


def test_eps_relative_to_the_median_noise_is_free_of_the_scale_and_an_absolute_one_is_not():
    gradients = noise(60, 501)
    for mode, is_free in (("abs", False), ("rel_median", True)):
        densifier = cadam(eps=0.5, eps_mode=mode)
        plain, tiny = observe(densifier, gradients), observe(densifier, gradients * 2.0**-20)
        equal = torch.allclose(densifier.scores(plain)["snr"], densifier.scores(tiny)["snr"])
        assert equal == is_free
    drift, strength = cadam().strengths(plain)
    expected = drift / (strength + 0.5 * strength.quantile(0.5))
    torch.testing.assert_close(cadam(eps=0.5, eps_mode="rel_median").scores(plain)["snr"], expected)


def test_the_median_noise_leaves_out_who_never_had_a_gradient_who_stay_unreliable():
    gradients = noise(30, 40)
    gradients[:, 10:] = 0.0
    densifier = cadam(eps=1e-3, eps_mode="rel_median")
    state = observe(densifier, gradients)
    snr_alone = densifier.scores(observe(densifier, gradients[:, :10]))["snr"]
    torch.testing.assert_close(densifier.scores(state)["snr"][:10], snr_alone)
    assert densifier.unreliable(state)[10:].all()
    assert densifier.unreliable(observe(densifier, gradients[:, 10:])).all()


def test_an_absolute_threshold_selects_by_drift_alone():
    state = observe(cadam(), noise(30, 200))
    drift = cadam().strengths(state)[0]
    tau_m = float(drift.median())
    momentum = cadam(tau_Q=None, tau_SNR=None, tau_m=tau_m, reset="everybody")
    assert torch.equal(momentum.select(state, STEP, LOTS), drift > tau_m)
    both = cadam(tau_Q=0.2, tau_SNR=0.25, tau_m=tau_m)
    expected = cadam(tau_Q=0.2, tau_SNR=0.25).select(state, STEP, LOTS) & (drift > tau_m)
    assert torch.equal(both.select(state, STEP, LOTS), expected)
    assert 0 < both.select(state, STEP, LOTS).sum() < momentum.select(state, STEP, LOTS).sum()


def test_without_gates_everybody_with_a_gradient_is_selected():
    gradients = noise(30, 20)
    gradients[:, 12:] = 0.0
    densifier = cadam(tau_Q=None, tau_SNR=None, reset="nobody")
    assert densifier.select(observe(densifier, gradients), STEP, LOTS).tolist() == [True] * 12 + [False] * 8


def test_without_the_quantile_the_gate_alone_selects():
    gradients = noise(60, 300)
    densifier = cadam(tau_Q=None, tau_SNR=0.2)
    state = observe(densifier, gradients)
    assert torch.equal(densifier.select(state, STEP, LOTS), snr(densifier, state) > 0.2)
    assert "drift_threshold" not in densifier.statistics(state, STEP)


# The selective opacity reset (eq. 13), and the others.


@pytest.mark.parametrize(("reset", "share"), [("everybody", 1.0), ("nobody", 0.0)])
def test_a_reset_of_everybody_or_nobody_asks_nobody(reset, share):
    densifier = cadam(reset=reset)
    assert float(densifier.unreliable(observe(densifier, noise(30, 40))).float().mean()) == share


def test_distrust_has_a_threshold_of_its_own_if_asked():
    state = observe(cadam(), noise(60, 300))
    ratio = snr(cadam(), state)
    assert torch.equal(cadam().unreliable(state), ratio < 0.1)
    for choice in ({"tau_SNR": 0.1}, {"tau_SNR": None}, {"tau_SNR": None, "alpha": 0.05}):
        assert torch.equal(cadam(tau_reset=0.3, **choice).unreliable(state), ratio < 0.3)


def test_a_reset_clears_the_moments_of_its_gaussians_if_asked():
    before = observe(cadam(), noise(9, 6))
    rows = torch.tensor([True, False, True, False, False, False])
    assert cadam().after_reset(before, rows) is before
    after = cadam(reset_moments=True).after_reset(before, rows)
    for name, old in before.to_dict().items():
        assert not getattr(after, name)[rows].any()
        assert torch.equal(getattr(after, name)[~rows], old[~rows])
        assert old[rows].any()


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


def test_nobody_is_both_selected_and_unreliable():
    densifier, state = cadam(tau_SNR=0.2), observe(cadam(), noise(100, 500))
    assert not (densifier.select(state, STEP, LOTS) & densifier.unreliable(state)).any()


def test_a_gaussian_that_never_had_a_gradient_is_unreliable():
    state = observe(cadam(), torch.zeros(5, 2, 3))
    assert cadam().unreliable(state).all()
    assert not cadam(tau_SNR=0.0).unreliable(state).any()


def test_the_young_are_not_called_unreliable():
    state = observe(cadam(), torch.zeros(5, 2, 3))
    assert not cadam(reset_min_age=6).unreliable(state).any()
    assert cadam(reset_min_age=5).unreliable(state).all()


# The quantile, the statistics, the checks.


def test_scores_are_what_the_gates_compare():
    state = observe(cadam(), noise(40, 100))
    scores = cadam().scores(state)
    drift, strength = cadam().strengths(state)
    assert torch.equal(scores["drift"], drift)
    assert torch.equal(scores["noise"], strength)
    torch.testing.assert_close(scores["snr"], drift / strength)
    assert set(scores) == {"drift", "noise", "snr"}


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 0.999, 1.0])
@pytest.mark.parametrize("n", [1, 2, 3, 10, 1001])
def test_quantile_is_that_of_torch(n, share):
    values = torch.randn(n, generator=torch.Generator().manual_seed(n), dtype=torch.float64)
    torch.testing.assert_close(quantile(values, share), torch.quantile(values, share), rtol=1e-12, atol=0)


def test_quantile_has_no_limit_on_the_count():
    n = 2**24 + 3  # torch.quantile refuses this many, and float32 cannot count them
    descending = torch.arange(n - 1, -1, -1, dtype=torch.int32).sub_(n // 2).float()
    assert float(quantile(descending, 0.25)) == (n - 1) / 4 - n // 2  # half way between two


def test_a_rank_that_is_whole_is_whole_for_a_decimal_share():
    assert 0.29 * 100 != 29
    for percent in range(101):
        assert float(quantile(torch.arange(101.0) ** 2, percent / 100)) == percent**2


def test_statistics_say_what_the_densifier_saw():
    state = observe(cadam(), noise(50, 100))
    numbers = cadam().statistics(state, STEP)
    ratio, (drift, _) = snr(cadam(), state), cadam().strengths(state)
    assert numbers["age_median"] == 50
    assert numbers["snr_p50"] == pytest.approx(float(torch.quantile(ratio, 0.5)), rel=1e-5)
    assert numbers["snr_p10"] < numbers["snr_p50"] < numbers["snr_p90"]
    assert numbers["share_above_tau_SNR"] == pytest.approx(float((ratio > 0.1).float().mean()))
    assert numbers["drift_threshold"] == pytest.approx(float(torch.quantile(drift, 0.9)), rel=1e-5)
    assert numbers["drift_median"] == pytest.approx(float(torch.quantile(drift, 0.5)), rel=1e-5)


def test_an_empty_scene_is_no_problem():
    state = observe(cadam(), torch.zeros(2, 0, 3))
    assert cadam().select(state, STEP, LOTS).shape == (0,)
    assert cadam().unreliable(state).shape == (0,)
    assert cadam().statistics(state, STEP) == {}


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("tau_Q", 1.0),
        ("tau_Q", -0.1),
        ("tau_Q", Linear(start=0.5, end=1.0, steps=10)),
        ("tau_m", -1.0),
        ("tau_SNR", -1.0),
        ("tau_SNR", math.nan),
        ("beta1", 1.0),
        ("beta2", 1.0),
        ("eps", 0.0),
        ("invisible", "maybe"),
        ("min_age", -1),
        ("quantile_over", "some"),
        ("reset_min_age", -1),
        ("grad_norm", "max"),
        ("nonfinite", "crash"),
        ("eps_mode", "rel"),
        ("grad_source", "all"),
        ("child_state", "half"),
        ("parent_state", "lose"),
        ("reset", "some"),
        ("tau_reset", -0.1),
    ],
)
def test_an_impossible_value_is_refused_by_name(key, value):
    with pytest.raises(UserError, match=rf"densifier\.{key}"):
        cadam(**{key: value})


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"tau_reset": 0.1, "reset": "everybody"}, "tau_reset"),  # nobody would look at it
        ({"tau_SNR": None}, "tau_reset"),  # whom would a reset distrust?
        ({"alpha": 0.05}, "tau_SNR"),  # two gates on one ratio
        ({"alpha": 1.0, "tau_SNR": None, "tau_reset": 0.1}, "alpha"),
        ({"alpha": 0.05, "tau_SNR": None, "tau_reset": 0.1, "beta2": 0.8}, "beta2"),
    ],
)
def test_a_key_that_would_do_nothing_or_mislead_is_refused(changes, key):
    with pytest.raises(UserError, match=rf"densifier\.{key}: expected .* Try: densifier\."):
        cadam(**changes)
