"""Laws of what initializers share: neighbour distances, and Gaussians at coloured points."""

import pytest
import torch

from cadam3d.core.sh import evaluate_sh
from cadam3d.initializer.points import BLOCK, gaussians_at, neighbour_distance


def cloud(n: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(n, 3, generator=torch.Generator().manual_seed(seed))


def by_hand(points: torch.Tensor) -> torch.Tensor:
    distances = (points[:, None] - points[None]).norm(dim=-1)
    return distances.sort(dim=1).values[:, 1:4].mean(dim=1)


@pytest.mark.parametrize("n", [2, 3, 4, 5, BLOCK, BLOCK + 1, 3 * BLOCK + 7])
def test_neighbour_distances_are_those_of_an_exhaustive_search(n):
    torch.testing.assert_close(neighbour_distance(cloud(n)), by_hand(cloud(n)))


def test_an_outlier_far_from_everybody_is_measured_right():
    points = cloud(2 * BLOCK) * 0.01
    points[17] = torch.tensor([50.0, -3.0, 8.0])
    torch.testing.assert_close(neighbour_distance(points), by_hand(points))


def test_points_on_a_line_and_on_a_grid_are_measured_right():
    line = torch.zeros(2 * BLOCK, 3)
    line[:, 1] = torch.arange(2 * BLOCK)
    assert neighbour_distance(line)[5:-5].tolist() == pytest.approx([4 / 3] * (2 * BLOCK - 10))
    grid = torch.cartesian_prod(*[torch.arange(9.0)] * 3)
    assert neighbour_distance(grid).tolist() == [1.0] * 729


def test_coincident_points_keep_a_size():
    assert (neighbour_distance(torch.zeros(2 * BLOCK, 3)) > 0).all()


def test_a_lonely_point_and_an_empty_cloud_are_no_problem():
    assert neighbour_distance(torch.zeros(1, 3)).tolist() == [1.0]
    assert neighbour_distance(torch.zeros(0, 3)).shape == (0,)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_gaussians_show_their_color_from_every_side(degree):
    rgb = torch.rand(9, 3, generator=torch.Generator().manual_seed(0))
    made = gaussians_at(cloud(9), rgb, scale=None, opacity=0.1, sh_degree=degree)
    assert made.sh_degree == degree
    directions = torch.nn.functional.normalize(cloud(9, seed=1), dim=-1)
    torch.testing.assert_close(evaluate_sh(made.sh, directions), rgb)


def test_gaussians_are_round_and_as_opaque_as_asked():
    points = cloud(9)
    made = gaussians_at(points, torch.rand(9, 3), scale=None, opacity=0.1, sh_degree=0)
    assert torch.equal(made.means, points)
    torch.testing.assert_close(made.opacities, torch.full((9,), 0.1))
    torch.testing.assert_close(made.scales, neighbour_distance(points)[:, None].expand(9, 3))
    torch.testing.assert_close(made.rotations, torch.eye(3).expand(9, 3, 3))


def test_a_given_scale_is_everybodys():
    made = gaussians_at(cloud(9), torch.rand(9, 3), scale=0.03, opacity=0.1, sh_degree=0)
    torch.testing.assert_close(made.scales, torch.full((9, 3), 0.03))
