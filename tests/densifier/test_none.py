"""Laws of the densifier that never grows."""

import torch

from cadam3d.core.edit import RowEdit
from cadam3d.core.gaussians import Gaussians
from cadam3d.densifier.base import GradientSignal
from cadam3d.densifier.none import NoGrowth

CPU = torch.device("cpu")
STEP = 100  # of a refinement; only schedules depend on it
DRAWS = torch.Generator()  # nothing here draws from it


def children(n: int) -> Gaussians:
    return Gaussians(
        means=torch.zeros(n, 3),
        log_scales=torch.zeros(n, 3),
        quats=torch.ones(n, 4),
        opacity_logits=torch.zeros(n),
        sh=torch.zeros(n, 1, 3),
    )


def test_no_gaussian_grows_or_is_reset_whatever_the_gradients():
    loud = GradientSignal(
        means=torch.full((4, 3), 1e6),
        means2d=torch.full((2, 4, 2), 1e6),
        radii=torch.ones(2, 4),
        height=8,
        width=8,
    )
    state = NoGrowth().observe(NoGrowth().init_state(4, CPU), loud)
    assert NoGrowth().select(state, STEP, DRAWS).tolist() == [False] * 4
    assert NoGrowth().unreliable(state).tolist() == [False] * 4


def test_the_masks_follow_the_count_when_pruning_removes_rows():
    edit = RowEdit(keep=torch.tensor([0, 2]), children=children(0), parents=torch.arange(0))
    state = NoGrowth().init_state(4, CPU).carry(edit)
    assert NoGrowth().select(state, STEP, DRAWS).tolist() == [False] * 2


def test_there_are_no_statistics():
    assert NoGrowth().statistics(NoGrowth().init_state(4, CPU), STEP) == {}
