"""Laws of random growth, the control of the experiments."""

import math

import pytest
import torch

from cadam3d.build import component
from cadam3d.core.reductions import quantile
from cadam3d.densifier.random import RandomGrowth
from cadam3d.settings.compose import compose

CPU = torch.device("cpu")
STEP = 100  # of a refinement; only schedules depend on it


def draws(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def select(densifier: RandomGrowth, n: int, *, seed: int = 0, step: int = STEP) -> torch.Tensor:
    return densifier.select(densifier.init_state(n, CPU), step, draws(seed))


@pytest.mark.parametrize("share", [0.0, 0.02, 0.1, 0.3, 0.5, 0.999])
def test_as_many_are_selected_as_pass_a_quantile_gate(share):
    for n in (0, 1, 2, 10, 11, 300, 331, 1000):
        drift = torch.randperm(n, generator=draws(n)).double()
        passing = int((drift > quantile(drift, 1 - share)).sum()) if n else 0
        assert int(select(RandomGrowth(share=share), n).sum()) == passing


def test_every_gaussian_has_the_same_chance():
    densifier, generator, calls = RandomGrowth(share=0.2), draws(), 4000
    state = densifier.init_state(51, CPU)
    hits = sum(densifier.select(state, STEP, generator).int() for _ in range(calls))
    expected = calls * 10 / 51
    assert (hits - expected).abs().max() < 4.5 * (expected * (1 - 10 / 51)) ** 0.5


def test_another_seed_is_another_choice():
    densifier = RandomGrowth(share=0.1)
    assert not torch.equal(select(densifier, 500, seed=3), select(densifier, 500, seed=4))


def test_the_annealed_control_selects_as_many_as_cadam_annealed_at_every_refinement():
    cadam, control = (
        component(compose(["prompt=a red cube", f"densifier={name}"]).densifier)
        for name in ("cadam_annealed", "random_annealed")
    )
    for step in range(0, 601, 10):
        assert control.share(step) == pytest.approx(1 - cadam.tau_Q(step))


@pytest.mark.parametrize("recipe", [None, "bench", "luciddreamer", "gaussiandreamer", "dreamgaussian"])
def test_the_annealed_quantile_follows_the_schedule_and_bounds_growth_as_the_paper_s_does(recipe):
    words = ["prompt=a red cube", "densifier=cadam_annealed", *([f"experiment={recipe}"] if recipe else [])]
    cfg = compose(words)
    tau_Q, refine = component(cfg.densifier).tau_Q, cfg.refine
    calls = [at for at in range(0, cfg.steps + 1, refine.interval) if refine.start < at < refine.end]
    assert tau_Q(refine.start) == 0.5
    assert tau_Q(calls[-1]) == pytest.approx(0.98)
    bound, paper = math.prod(2 - tau_Q(at) for at in calls), 1.1 ** len(calls)
    assert 0.9 * paper < bound < 1.35 * paper
