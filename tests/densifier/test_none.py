"""Laws of the densifier that never grows."""

import torch

from cadam3d.densifier.base import GradientSignal
from cadam3d.densifier.none import NoGrowth

CPU = torch.device("cpu")
STEP = 100  # of a refinement; only schedules depend on it
DRAWS = torch.Generator()  # nothing here draws from it


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
