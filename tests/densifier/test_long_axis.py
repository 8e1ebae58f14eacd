"""Laws of the long-axis split: what the children look like, which candidates are drawn, and how many."""

from dataclasses import replace

import pytest
import torch
from splats import make_gaussians

from cadam3d.build import component
from cadam3d.core.gaussians import Gaussians
from cadam3d.densifier.base import GradientSignal
from cadam3d.densifier.long_axis import RADIUS, LongAxis
from cadam3d.densifier.refine import Refine
from cadam3d.settings.compose import compose

CPU = torch.device("cpu")
CFG = compose(["prompt=a cube", "densifier=long_axis", "experiment=bench"])
REFINE: Refine = component(CFG.refine)  # from step 100 to 450


def long_axis(**changes) -> LongAxis:
    return replace(component(CFG.densifier), tau_pos=1.0, **changes)


def draws(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def scene(n: int) -> Gaussians:
    """Return Gaussians whose second axis is the longest, turned at random."""
    each = make_gaussians(n, log_scale=-5)
    log_scales = torch.tensor([-5.0, -3.0, -4.0]).expand(n, 3)
    return replace(each, log_scales=log_scales, quats=torch.randn(n, 4, generator=draws(9)))


def plan(densifier: LongAxis, gaussians: Gaussians, pulls: torch.Tensor, step: int = 200, seed: int = 0):
    """Return the refinement if Gaussians have absolute gradients of these norms."""
    signal = GradientSignal(
        means=torch.zeros(len(pulls), 3),
        means2d=torch.zeros(1, len(pulls), 2),
        radii=torch.ones(1, len(pulls)),
        height=2,
        width=2,
        absgrad=torch.stack([pulls, torch.zeros_like(pulls)], dim=-1)[None],
    )
    state = densifier.observe(densifier.init_state(len(pulls), CPU), signal)
    return densifier.plan(state, gaussians, step, REFINE, draws(seed))


@pytest.mark.parametrize("offset", [0.2, 0.45, 0.5])
def test_two_children_on_the_longest_axis_end_where_their_parent_ends(offset):
    parents = scene(20)
    change = plan(long_axis(offset=offset, budget=10**6), parents, torch.full((20,), 2.0))
    assert change.edit is not None
    assert (change.split, change.cloned, change.edit.rows_after) == (20, 0, 40)
    children = change.edit.children
    apart = children.means[1::2] - children.means[::2]
    local = (parents.rotations.mT @ apart[..., None])[..., 0]
    radius = RADIUS * parents.scales[:, 1]
    torch.testing.assert_close(local, torch.tensor([0.0, 1.0, 0.0]) * (2 * offset * radius)[:, None])
    torch.testing.assert_close((children.means[1::2] + children.means[::2]) / 2, parents.means)
    ends = offset * radius + RADIUS * children.scales[::2, 1]
    torch.testing.assert_close(ends, radius)
    # Across the axis a child is as wide as its parent is at the centre of the child.
    across = parents.scales[:, [0, 2]] * (1 - offset**2) ** 0.5
    torch.testing.assert_close(children.scales[::2, [0, 2]], across)
    torch.testing.assert_close(children.opacities[::2], 0.6 * parents.opacities)


@pytest.mark.parametrize(("step", "expected"), [(120, 0), (150, 4), (200, 88), (440, 167)])
def test_the_count_follows_the_root_of_the_time_that_has_passed(step, expected):
    """The budget allows 540 sqrt((step - 100) / 350). Of 200 Gaussians 167 are candidates."""
    pulls = torch.full((200,), 2.0)
    pulls[:33] = 0.5  # below tau_pos
    change = plan(long_axis(budget=540), scene(200), pulls, step=step)
    assert change.split == expected
    assert not change.is_selected[:33].any()


def test_candidates_are_drawn_in_proportion_to_their_gradient():
    pulls = torch.tensor([1.0, 2.0, 3.0, 4.0])
    densifier, hits = long_axis(budget=5), torch.zeros(4)
    for seed in range(2000):
        hits += plan(densifier, scene(4), pulls, step=450, seed=seed).is_selected
    torch.testing.assert_close(hits / 2000, pulls / 10, atol=0.04, rtol=0)
