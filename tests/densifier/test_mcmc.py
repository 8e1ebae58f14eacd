"""Laws of 3DGS-MCMC: relocation of dead Gaussians, copies that look like their original, and noise."""

import math
from dataclasses import replace
from functools import cache

import pytest
import torch
from scipy.integrate import quad

from cadam3d.build import component
from cadam3d.core.gaussians import FIELDS, Gaussians
from cadam3d.densifier.mcmc import MCMC, draw, share
from cadam3d.densifier.refine import Refine
from cadam3d.settings.compose import compose

CPU = torch.device("cpu")
LATE = 10_000  # a step at which nothing is scheduled


def draws(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def mcmc(**changes) -> MCMC:
    return MCMC(**{"cap": 10**6, "growth": 0.05, "noise_lr": 8000.0, **changes})


@cache
def refine() -> Refine:
    usual = component(compose(["prompt=a red cube"]).refine)
    return replace(usual, max_scale=None, reset_interval=None)


def gaussians(n: int, seed: int = 0, low: float = 0.1) -> Gaussians:
    noise = draws(seed)
    return Gaussians(
        means=torch.randn(n, 3, generator=noise),
        log_scales=torch.randn(n, 3, generator=noise) - 3,
        quats=torch.randn(n, 4, generator=noise),
        opacity_logits=(low + (0.9 - low) * torch.rand(n, generator=noise)).logit(),
        sh=torch.randn(n, 4, 3, generator=noise),
    )


def plan(densifier: MCMC, scene: Gaussians, how: Refine | None = None, seed: int = 0, step: int = LATE):
    state = densifier.init_state(len(scene), CPU)
    return densifier.plan(state, scene, step, how or refine(), draws(seed))


# How coincident copies share the opacity and the size of their original (equation 9).


@pytest.mark.parametrize("opacity", [0.001, 0.1, 0.5, 0.9, 0.999, 0.999999])
@pytest.mark.parametrize("among", [1, 2, 3, 10, 60, 1000])
def test_coincident_copies_look_like_the_original(opacity, among):
    logits = torch.tensor([opacity], dtype=torch.float64).logit()
    new, log_shrink = share(logits, torch.tensor([among]))
    each, width = float(new.sigmoid()), math.exp(float(log_shrink))
    assert 1 - (1 - each) ** among == pytest.approx(opacity, rel=1e-6)

    def together(x: float) -> float:
        return -math.expm1(among * math.log1p(-each * math.exp(-0.5 * (x / width) ** 2)))

    line = 2 * quad(together, 0, 12 * width, points=[width], limit=200)[0]
    assert line == pytest.approx(opacity * math.sqrt(2 * math.pi), rel=1e-5)


def test_fully_opaque_gaussians_share_without_nan():
    new, log_shrink = share(torch.tensor([20.0, 90.0]).double(), torch.tensor([2, 500]))
    assert new.isfinite().all()
    assert log_shrink.isfinite().all()


# Random choices.


def test_draws_are_in_proportion_to_the_weights():
    weights = torch.tensor([0.0, 1.0, 3.0, 0.0, 6.0]).double()
    hits = draw(weights, 100_000, draws()).bincount(minlength=5)
    expected = 100_000 * weights / 10
    assert hits[0] == hits[3] == 0
    assert ((hits - expected).abs() <= 4.5 * expected.sqrt()).all()


# The plan.


def test_dead_gaussians_are_replaced_by_copies_of_live_ones():
    scene = gaussians(40)
    scene.opacity_logits[5:15] = math.log(0.004 / 0.996)
    decided = plan(mcmc(growth=0.0), scene)
    dead = set(range(5, 15))
    assert decided.edit.rows_after == 40
    assert (decided.cloned, decided.split, decided.pruned) == (10, 0, 10)
    assert not dead & set(decided.edit.keep.tolist())
    assert not dead & set(decided.edit.parents.tolist())
    assert set(range(40)) == dead | set(decided.edit.keep.tolist()) | set(decided.edit.parents.tolist())
    chosen = decided.is_selected.nonzero()[:, 0]
    assert set(chosen.tolist()) == set(decided.edit.parents.tolist())
    assert decided.edit.keep.tolist() == sorted(decided.edit.keep.tolist())


def test_copies_have_the_position_of_their_original_and_share_its_opacity_and_size():
    scene = gaussians(30)
    scene.opacity_logits[:20] = -9.0
    edit = plan(mcmc(growth=0.0), scene).edit
    assert edit.parents.bincount().max() > 2, "no parent was drawn twice, so only shares of two are tested"
    for parent in edit.parents.unique():
        mine = edit.parents == parent
        expected_logit, log_shrink = share(scene.opacity_logits[parent][None].double(), mine.sum()[None])
        for field in ("means", "quats", "sh"):
            original = getattr(scene, field)[parent]
            assert torch.equal(
                getattr(edit.children, field)[mine], original.expand(int(mine.sum()), *original.shape)
            )
        torch.testing.assert_close(
            edit.children.opacity_logits[mine].double(), expected_logit.expand(int(mine.sum()))
        )
        torch.testing.assert_close(
            edit.children.log_scales[mine].double(),
            (scene.log_scales[parent].double() + log_shrink).expand(int(mine.sum()), 3),
        )


def test_copied_gaussians_lose_their_moments_and_no_others_do():
    scene = gaussians(30)
    edit = plan(mcmc(), scene).edit
    carried = edit.carry(torch.ones(30))
    assert carried.tolist() == [1.0] * len(edit.keep) + [0.0] * len(edit.parents)
    kept = edit.apply(scene).index(slice(0, len(edit.keep)))
    for field in FIELDS:
        assert torch.equal(getattr(kept, field), getattr(scene, field)[edit.keep])


@pytest.mark.parametrize("growth", [0.05, 0.1])
def test_the_population_grows_by_its_share_up_to_the_cap_and_then_keeps_its_size(growth):
    scene, counts = gaussians(100, low=0.5), [100]
    for call in range(20):
        scene = plan(mcmc(growth=growth, cap=180), scene, seed=call).edit.apply(scene)
        counts.append(len(scene))
        assert counts[-1] == min(180, int((1 + growth) * counts[-2]))
    assert counts[-1] == counts[-2] == 180


def test_no_gaussian_is_born_dead():
    scene = gaussians(60, low=0.006)
    scene.opacity_logits[:50] = -9.0
    scene.opacity_logits[50:] = math.log(0.0051 / 0.9949)
    how = refine()
    after = plan(mcmc(), scene, how).edit.apply(scene)
    assert how.keeps(after, LATE).all()


@pytest.mark.parametrize("n", [0, 5])
def test_without_a_live_gaussian_no_copies_are_made(n):
    scene = gaussians(n)
    scene.opacity_logits -= 20
    decided = plan(mcmc(), scene)
    assert decided.edit.rows_after == 0
    assert (decided.cloned, decided.pruned, decided.selected) == (0, n, 0)


def test_a_plan_depends_on_the_generator_and_changes_nothing():
    scene = gaussians(50, low=0.001)
    before = scene.map(torch.clone)
    first, again, other = (plan(mcmc(), scene, seed=seed).edit for seed in (0, 0, 1))
    assert torch.equal(first.parents, again.parents)
    assert not torch.equal(first.parents, other.parents)
    assert all(torch.equal(getattr(scene, field), getattr(before, field)) for field in FIELDS)


# The noise.


def test_the_noise_has_the_squared_covariance_of_each_gaussian():
    one = gaussians(1)
    one.opacity_logits[:] = math.log(0.005 / 0.995)  # where half of the noise is left
    many = one.index(torch.zeros(200_000, dtype=torch.long))
    moved = mcmc(noise_lr=6.0).perturb(many, 0.5, draws()).double()
    spread = one.rotations[0] * one.scales[0].square() @ one.rotations[0].T
    expected = (0.5 * 6.0 * 0.5) ** 2 * spread.double() @ spread.double()
    error = (moved.T @ moved / len(moved) - expected).abs().max()
    assert error < 0.01 * expected.diagonal().max()


def test_the_noise_scales_with_the_rate_and_comes_from_the_generator():
    scene = gaussians(20, low=0.001)
    once, twice = (mcmc().perturb(scene, lr, draws()) for lr in (0.01, 0.02))
    torch.testing.assert_close(2 * once, twice)
    assert not torch.equal(once, mcmc().perturb(scene, 0.01, draws(1)))
    assert not mcmc(noise_lr=0.0).perturb(scene, 0.01, draws()).any()
