"""Laws of refinement: its steps, cloning, splitting and pruning, and the agreement of all owners of rows."""

import math
from dataclasses import replace

import pytest
import torch
from evidence import cadam

from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.densifier.base import GradientSignal
from cadam3d.densifier.baseline import Baseline
from cadam3d.densifier.none import NoGrowth
from cadam3d.densifier.refine import Refine
from cadam3d.optimizer import AdamSettings

CPU = torch.device("cpu")
STEP = 100  # of a refinement; only schedules depend on it
DRAWS = torch.Generator()  # nothing here draws from it
LATE = 10_000  # a step at which nothing is scheduled


def refine(**changes) -> Refine:
    usual = {
        "steps": 20_000,
        "last_max_scale": None,
        "last_min_alpha": None,
        "min_contribution": None,
        "start": 100,
        "end": 3000,
        "interval": 100,
        "tau_scale": 0.05,
        "split_children": 2,
        "split_shrink": 1.6,
        "min_opacity": 0.005,
        "max_scale": None,
        "prune_from": 0,
        "reset_interval": None,
        "reset_from": 0,
        "reset_until": 3000,
        "reset_value": 0.01,
        "recovery": 96,
        "prune_grace": 0,
        "max_gaussians": None,
    }
    return Refine(**{**usual, **changes})


def gaussians(n: int, seed: int = 0) -> Gaussians:
    """Return Gaussians of which half are smaller than tau_scale, and half larger; all are clearly visible."""
    draw = torch.Generator().manual_seed(seed)
    scales = torch.empty(n, 3).uniform_(0.01, 0.02, generator=draw)
    scales[n // 2 :, 1] *= 10
    return Gaussians(
        means=torch.randn(n, 3, generator=draw),
        log_scales=scales.log(),
        quats=torch.randn(n, 4, generator=draw),
        opacity_logits=torch.rand(n, generator=draw),
        sh=torch.randn(n, 4, 3, generator=draw),
    )


def some(n: int, seed: int = 1) -> torch.Tensor:
    return torch.rand(n, generator=torch.Generator().manual_seed(seed)) < 0.5


def draw(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def with_opacity(scene: Gaussians, opacities: list[float]) -> Gaussians:
    return replace(scene, opacity_logits=torch.tensor(opacities).logit())


# When.


@pytest.mark.parametrize(
    ("start", "end", "expected"),
    [
        (300, 900, range(400, 801, 100)),  # GaussianDreamer: 5 refinements
        (100, 3000, range(200, 2901, 100)),  # LucidDreamer: 28 refinements
        (100, 1500, range(200, 1401, 100)),  # FlowDreamer: 13 refinements
    ],
)
def test_refinements_happen_at_the_steps_of_the_published_recipes(start, end, expected):
    schedule = refine(start=start, end=end)
    assert [step for step in range(1, 4000) if schedule.refines_at(step)] == list(expected)


@pytest.mark.parametrize(
    ("first", "until", "expected"),
    [
        (300, 3000, range(300, 2701, 300)),  # LucidDreamer
        (500, 1500, range(600, 1201, 300)),  # FlowDreamer, whose warm-up ends at 500
    ],
)
def test_resets_happen_at_the_steps_of_the_published_recipes(first, until, expected):
    schedule = refine(reset_interval=300, reset_from=first, reset_until=until)
    assert [step for step in range(1, 4000) if schedule.resets_at(step)] == list(expected)


# Growth.


def test_clones_and_splits_partition_the_selection_by_scale():
    scene, selected = gaussians(40), some(40)
    plan = refine().plan(scene, selected, LATE, draw())
    is_large = scene.scales.amax(dim=-1) > 0.05
    stays = torch.zeros(40, dtype=torch.bool)
    stays[plan.edit.keep] = True
    assert torch.equal(stays, ~(selected & is_large))  # split parents are removed, cloned parents stay
    births = torch.bincount(plan.edit.parents, minlength=40)
    assert torch.equal(births, selected * torch.where(is_large, 2, 1))
    assert (plan.cloned, plan.split) == (int((selected & ~is_large).sum()), int((selected & is_large).sum()))
    assert plan.cloned > 0
    assert plan.split > 0


@pytest.mark.parametrize("children", [2, 3, 5])
def test_the_counts_add_up(children):
    scene = gaussians(60)
    scene.opacity_logits[::7] = -9.0
    plan = refine(split_children=children).plan(scene, some(60), LATE, draw())
    assert plan.selected == plan.cloned + plan.split == int(some(60).sum())
    assert plan.edit.rows_after == 60 + plan.cloned + (children - 1) * plan.split - plan.pruned
    assert plan.pruned > 0
    assert len(plan.edit.apply(scene)) == plan.edit.rows_after


def test_a_plan_without_some_rows_has_neither_these_rows_nor_their_children():
    plan = refine().plan(gaussians(60), some(60), LATE, draw())
    idle = some(60, seed=2)
    left = plan.without(idle)
    assert not idle[left.edit.keep].any()
    assert not idle[left.edit.parents].any()
    kept = [*plan.edit.keep.tolist(), *plan.edit.parents.tolist()]
    assert left.edit.rows_after == sum(not idle[row] for row in kept) < plan.edit.rows_after
    assert left.edit.rows_after == 60 + left.cloned + left.split - left.pruned
    assert plan.without(None) is plan


def test_split_children_are_smaller_by_the_shrink_and_otherwise_like_their_parent():
    scene = gaussians(12)
    scene.log_scales[:] += 3.0
    plan = refine().plan(scene, some(12), LATE, draw())
    children, parents = plan.edit.children, scene.index(plan.edit.parents)
    torch.testing.assert_close(children.scales * 1.6, parents.scales)
    for name in ("quats", "opacity_logits", "sh"):
        assert torch.equal(getattr(children, name), getattr(parents, name))
    assert (children.means != parents.means).any(dim=-1).all()


def test_split_children_are_distributed_like_their_parent():
    n = 4000
    one = gaussians(2).index(torch.tensor([1]))
    scene = one.map(lambda tensor: tensor.repeat(n, *[1] * (tensor.ndim - 1)))
    scene.log_scales[:] = torch.tensor([0.2, 0.6, 1.0]).log()
    plan = refine().plan(scene, torch.ones(n, dtype=torch.bool), LATE, draw())
    offsets = plan.edit.children.means - one.means
    axes = one.rotations[0]
    expected = axes @ torch.diag(torch.tensor([0.04, 0.36, 1.0])) @ axes.T
    torch.testing.assert_close(offsets.T @ offsets / len(offsets), expected, atol=0.04, rtol=0)
    torch.testing.assert_close(offsets.mean(dim=0), torch.zeros(3), atol=0.04, rtol=0)


def test_planning_changes_nothing_and_keeps_no_autograd_graph():
    scene = gaussians(10).map(lambda tensor: tensor.requires_grad_())
    copies = {name: tensor.detach().clone() for name, tensor in scene.tensors().items()}
    plan = refine().plan(scene, torch.ones(10, dtype=torch.bool), LATE, draw())
    assert all(torch.equal(getattr(scene, name), copy) for name, copy in copies.items())
    assert not any(tensor.requires_grad for tensor in plan.edit.children.tensors().values())


# Pruning.


def test_large_gaussians_are_pruned_only_after_prune_from():
    scene = gaussians(4)
    scene.log_scales[3, 0] = 0.0
    schedule, no_rows = refine(max_scale=0.5, prune_from=500), torch.zeros(4, dtype=torch.bool)
    assert schedule.plan(scene, no_rows, 500, draw()).pruned == 0
    assert schedule.plan(scene, no_rows, 501, draw()).edit.keep.tolist() == [0, 1, 2]


def test_the_last_pruning_is_at_the_last_step_only():
    """DreamGaussian prunes scales above 0.4 while it refines, and above 0.1 at the end."""
    scene = gaussians(4)
    scene.log_scales[2, 0], scene.log_scales[3, 0] = math.log(0.2), 0.0
    schedule, no_rows = refine(steps=450, max_scale=0.4, last_max_scale=0.1), torch.zeros(4, dtype=torch.bool)
    assert schedule.plan(scene, no_rows, 400, draw()).edit.keep.tolist() == [0, 1, 2]
    assert schedule.plan(scene, no_rows, 450, draw()).edit.keep.tolist() == [0, 1]
    assert [step for step in range(1, 451) if schedule.prunes_at(step)] == [450]
    assert not refine(steps=450).prunes_at(450)


def test_ghosts_are_pruned_after_the_last_step_of_runs_in_which_gaussians_become_solid():
    assert [step for step in range(1, 451) if refine(steps=450, last_min_alpha=0.3).prunes_at(step)] == [450]
    assert not refine(steps=95, last_min_alpha=0.3).prunes_at(95)


@pytest.mark.parametrize("name", ["means", "log_scales", "opacity_logits"])
def test_rows_with_nan_are_pruned(name):
    scene = gaussians(4)
    getattr(scene, name)[2] = torch.nan
    plan = refine(max_scale=10.0).plan(scene, torch.zeros(4, dtype=torch.bool), LATE, draw())
    assert plan.edit.keep.tolist() == [0, 1, 3]


def test_opacity_does_not_prune_during_the_grace_after_a_reset():
    scene, no_rows = with_opacity(gaussians(2), [0.01, 0.9]), torch.zeros(2, dtype=torch.bool)
    schedule = refine(reset_interval=300, reset_from=300, prune_grace=100, min_opacity=0.05)
    pruned = {
        step: schedule.plan(scene, no_rows, step, draw()).pruned for step in (200, 300, 301, 400, 401, 700)
    }
    assert pruned == {200: 1, 300: 1, 301: 0, 400: 0, 401: 1, 700: 0}


# The cap.


def test_a_plan_exceeds_the_cap_by_its_count_after_the_edit():
    scene, all_rows = gaussians(10), torch.ones(10, dtype=torch.bool)
    plan = refine().plan(scene, all_rows, LATE, draw())
    assert plan.edit.rows_after == 20
    assert refine(max_gaussians=19).exceeds(plan)
    assert not refine(max_gaussians=20).exceeds(plan)
    assert not refine(max_gaussians=None).exceeds(plan)


def test_unwanted_gaussians_are_pruned_when_large_ones_are_but_their_children_are_kept():
    scene = gaussians(6)  # 0..2 are cloned, 3..5 split
    selected = torch.tensor([True, False, False, True, False, False])
    unwanted = torch.tensor([True, True, False, True, True, False])
    schedule = refine(prune_from=500)
    before = schedule.plan(scene, selected, 500, draw(), unwanted)
    assert before.edit.keep.tolist() == [0, 1, 2, 4, 5]
    after = schedule.plan(scene, selected, 501, draw(), unwanted)
    assert after.edit.keep.tolist() == [2, 5]
    assert after.edit.parents.tolist() == before.edit.parents.tolist() == [0, 3, 3]
    assert after.pruned == 3


# The three owners of rows.


@pytest.mark.parametrize(
    "densifier",
    [
        NoGrowth(),
        Baseline(tau_pos=0.1, views="sum_norm", grad_multiplier=1.0, screen_px=None),
        cadam(tau_Q=0.7),
    ],
    ids=["none", "baseline", "cadam"],
)
def test_gaussians_moments_and_densifier_state_stay_in_step_through_many_edits(densifier):
    rates = ("means_lr", "sh_dc_lr", "sh_rest_lr", "opacity_lr", "scale_lr", "quat_lr")
    optimizer = AdamSettings(
        **dict.fromkeys(rates, 0.01), beta1=0.9, beta2=0.999, eps=1e-15, clip_norm=None, clip_unit=1.0
    ).start(gaussians(30))
    state, noise = densifier.init_state(30, CPU), draw(5)
    for step in range(1, 40):
        n = len(optimizer.gaussians)
        optimizer.gaussians.means.grad = torch.randn(n, 3, generator=noise)
        signal = GradientSignal(
            means=optimizer.gaussians.means.grad.clone(),
            means2d=torch.randn(2, n, 2, generator=noise) * 0.02,
            radii=torch.ones(2, n),
            height=8,
            width=8,
        )
        state = densifier.observe(state, signal)
        optimizer.step(step)
        if step % 10 == 0:
            plan = refine().plan(optimizer.gaussians, densifier.select(state, STEP, DRAWS), LATE, noise)
            optimizer.apply(plan.edit)
            state = state.carry(plan.edit)
        counts = {len(rows) for rows in state.to_dict().values()}
        counts |= {len(rows) for rows in optimizer.state_dict()["exp_avg"].values()}
        counts |= {len(tensor) for tensor in optimizer.gaussians.tensors().values()}
        assert counts == {len(optimizer.gaussians)}
    assert (len(optimizer.gaussians) > 30) == (not isinstance(densifier, NoGrowth))


def test_a_reset_below_the_pruning_threshold_is_refused():
    with pytest.raises(UserError, match=r"\.min_opacity: .*Try: Refine\.min_opacity=0\.005$"):
        refine(reset_interval=300, min_opacity=0.05)


def test_a_grace_as_long_as_the_reset_interval_is_refused():
    with pytest.raises(UserError, match=r"\.prune_grace: .* reset_interval=300"):
        refine(reset_interval=300, prune_grace=300)
