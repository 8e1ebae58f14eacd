"""The study of criteria: its estimate of the gain finds a planted need, and its areas are right."""

import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import cadam3d
from cadam3d.core.cameras import turntable
from cadam3d.core.gaussians import Gaussians, concatenate

NEEDY = 4  # of nine Gaussians in a wall


@pytest.fixture(scope="module")
def criteria():
    sys.path.insert(0, str(Path(__file__).parents[1] / "scripts"))
    try:
        import criteria
    finally:
        sys.path.pop(0)
    return criteria


def wall() -> Gaussians:
    """Return nine grey Gaussians far from each other."""
    side = torch.tensor([-0.5, 0.0, 0.5])
    y, z = (grid.flatten() for grid in torch.meshgrid(side, side, indexing="ij"))
    return Gaussians(
        means=torch.stack([torch.zeros(9), y, z], dim=1),
        log_scales=torch.full((9, 3), -2.5),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(9, 1),
        opacity_logits=torch.full((9,), 2.0),
        sh=torch.zeros(9, 1, 3),
    )


def test_only_the_gaussian_whose_truth_is_two_gaussians_gains(criteria):
    parts = cadam3d.compose("experiment=smoke", "prompt=a red cube", "device=cpu").parts
    coarse, part = wall(), torch.tensor([0.0, 0.1, 0.0])
    halves = wall().index(torch.tensor([NEEDY, NEEDY]))
    halves = replace(
        halves, means=halves.means + torch.stack([part, -part]), log_scales=halves.log_scales - 0.5
    )
    halves.sh[:, 0] = torch.tensor([[1.5, -1.5, -1.5], [-1.5, 1.5, -1.5]])
    others = wall().index(torch.arange(9) != NEEDY)
    fine = concatenate([others, halves])

    def shot(views: int):
        cameras = turntable(views, elevation_deg=0.0, distance=3.0, fov_y_deg=40.0, size=32)
        white = torch.ones(views, 3)
        return criteria.Shot(cameras, white, None, parts.rasterizer.render(fine, cameras, white).rgb.detach())

    frozen = criteria.Frozen(parts, coarse, {}, 20, None, [shot(2)], [], [shot(4)])
    for half in criteria.gains(frozen, groups=3, partitions=2):
        # The others are right already, so refining them only costs.
        assert (half > 0).nonzero().flatten().tolist() == [NEEDY]


def test_areas_of_known_scores(criteria):
    wanted = torch.tensor([False, False, True, True])
    assert criteria.auc(torch.tensor([1.0, 2.0, 3.0, 4.0]), wanted) == 1
    assert criteria.auc(torch.tensor([4.0, 3.0, 2.0, 1.0]), wanted) == 0
    assert criteria.auc(torch.tensor([1.0, 3.0, 2.0, 4.0]), wanted) == 0.75
    assert criteria.auc(torch.zeros(4), wanted) == 0.5  # ties count half
