"""Laws of AbsGS: gradients of opposite pixels count in full. All other laws are in test_baseline.py."""

import pytest
import torch

from cadam3d.densifier.absgrad import AbsGrad
from cadam3d.densifier.base import GradientSignal
from cadam3d.densifier.baseline import VIEWS, Baseline

CPU = torch.device("cpu")
STEP = 100  # of a refinement; only schedules depend on it
DRAWS = torch.Generator()  # nothing here draws from it
SETTINGS = {"tau_pos": 0.25, "views": "sum_norm", "grad_multiplier": 1.0, "screen_px": None}


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
    state = Baseline(**SETTINGS).observe(Baseline(**SETTINGS).init_state(2, CPU), evidence)
    assert not Baseline(**SETTINGS).select(state, STEP, DRAWS).any()


@pytest.mark.parametrize("views", VIEWS)
def test_absgrad_is_the_baseline_with_absolute_gradients(views):
    pulls = torch.rand(3, 9, 2, generator=torch.Generator().manual_seed(0))
    settings = SETTINGS | {"views": views, "grad_multiplier": 2.0}
    ours, theirs = AbsGrad(**settings), Baseline(**settings)
    one = ours.observe(ours.init_state(9, CPU), signal(torch.zeros(3, 9, 2), pulls, height=10, width=60))
    two = theirs.observe(theirs.init_state(9, CPU), signal(pulls, None, height=10, width=60))
    assert all(torch.equal(rows, two.to_dict()[name]) for name, rows in one.to_dict().items())
    assert torch.equal(ours.unreliable(one), theirs.unreliable(two))
