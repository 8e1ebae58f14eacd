"""Laws of AbsGS: gradients of opposite pixels count in full. All other laws are in test_baseline.py."""

import pytest
import torch
from splats import make_gaussians

from cadam3d.build import component
from cadam3d.densifier.absgrad import AbsGrad
from cadam3d.densifier.base import GradientSignal
from cadam3d.densifier.baseline import VIEWS, Baseline
from cadam3d.settings.compose import compose

CPU = torch.device("cpu")
STEP = 100  # of a refinement; only schedules depend on it
DRAWS = torch.Generator()  # nothing here draws from it
BASELINE = {"tau_pos": 0.25, "views": "sum_norm", "grad_multiplier": 1.0, "screen_px": None}
SETTINGS = BASELINE | {"tau_clone": None}


def signal(means2d: torch.Tensor, absgrad: torch.Tensor | None, height=2, width=2) -> GradientSignal:
    """Return a signal; at 2 x 2 pixels one pixel is one NDC unit."""
    return GradientSignal(
        means=torch.zeros(means2d.shape[1], 3),
        means2d=means2d,
        radii=torch.ones(means2d.shape[:2]),
        height=height,
        width=width,
        absgrad=absgrad,
    )


def test_gradients_that_cancel_count_in_full():
    cancelled, pulls = torch.zeros(1, 2, 2), torch.tensor([[[0.3, 0.0], [0.1, 0.1]]])
    evidence = signal(cancelled, pulls)
    state = AbsGrad(**SETTINGS).observe(AbsGrad(**SETTINGS).init_state(2, CPU), evidence)
    assert AbsGrad(**SETTINGS).select(state, STEP, DRAWS).tolist() == [True, False]
    state = Baseline(**BASELINE).observe(Baseline(**BASELINE).init_state(2, CPU), evidence)
    assert not Baseline(**BASELINE).select(state, STEP, DRAWS).any()


@pytest.mark.parametrize("views", VIEWS)
def test_absgrad_is_the_baseline_with_absolute_gradients(views):
    pulls = torch.rand(3, 9, 2, generator=torch.Generator().manual_seed(0))
    changes = {"views": views, "grad_multiplier": 2.0}
    ours, theirs = AbsGrad(**SETTINGS | changes), Baseline(**BASELINE | changes)
    one = ours.observe(ours.init_state(9, CPU), signal(torch.zeros(3, 9, 2), pulls, height=10, width=60))
    two = theirs.observe(theirs.init_state(9, CPU), signal(pulls, None, height=10, width=60))
    assert all(torch.equal(rows, one.to_dict()[name]) for name, rows in two.to_dict().items())
    assert torch.equal(ours.unreliable(one), theirs.unreliable(two))


@pytest.mark.parametrize("views", VIEWS)
def test_absgs_splits_by_absolute_gradients_and_clones_by_plain_ones(views):
    """As in the released code: large Gaussians by one gradient and threshold, small ones by the other."""
    draw = torch.Generator().manual_seed(0)
    plain, pulls = torch.rand(2, 40, 2, generator=draw), torch.rand(2, 40, 2, generator=draw)
    gaussians = make_gaussians(40, log_scale=-9)
    gaussians.log_scales[::2] += 8  # above tau_scale
    absgs = AbsGrad(**SETTINGS | {"views": views, "tau_pos": 0.9, "tau_clone": 0.7})
    state = absgs.observe(absgs.init_state(40, CPU), signal(plain, pulls))

    def selected_by(evidence: torch.Tensor, tau_pos: float) -> torch.Tensor:
        baseline = Baseline(**BASELINE | {"views": views, "tau_pos": tau_pos})
        sums = baseline.observe(baseline.init_state(40, CPU), signal(evidence, None))
        return baseline.select(sums, STEP, DRAWS)

    expected = selected_by(plain, 0.7)
    expected[::2] = selected_by(pulls, 0.9)[::2]
    refine = component(compose(["prompt=a red cube"]).refine)
    plan = absgs.plan(state, gaussians, STEP, refine, torch.Generator())
    assert torch.equal(plan.is_selected, expected)
    assert plan.split == int(expected[::2].sum()) > 0
    assert plan.cloned == int(expected[1::2].sum()) > 0
