"""Laws of the functions that initializers share: neighbour distances, and Gaussians at coloured points."""

import pytest
import torch

from cadam3d.core.errors import UserError
from cadam3d.core.sh import evaluate_sh
from cadam3d.initializer.ball import Ball
from cadam3d.initializer.points import (
    PointCloud,
    fit,
    neighbour_distance,
    points_on_surface,
    replicated,
    rows_of,
)
from cadam3d.io.run_folder import found_file


def cloud(n: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(n, 3, generator=torch.Generator().manual_seed(seed))


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def colored(n: int, seed: int = 0) -> PointCloud:
    return PointCloud(cloud(n, seed), torch.rand(n, 3, generator=seeded(seed)))


def gaussians_at(points: PointCloud, *, sh_degree: int = 0, scale_law: str = "mean"):
    ball = Ball(
        count=1,
        radius=1,
        color=[0, 0, 0],
        color_noise=0,
        scale=None,
        scale_law=scale_law,
        opacity=0.1,
        sh_degree=sh_degree,
    )
    return ball.gaussians_at(points, torch.device("cpu"))


def by_hand(points: torch.Tensor) -> torch.Tensor:
    distances = (points[:, None] - points[None]).norm(dim=-1)
    return distances.sort(dim=1).values[:, 1:4].mean(dim=1)


def test_the_law_of_3dgs_is_the_root_of_the_mean_squared_distance():
    points = cloud(100)
    distances = (points[:, None] - points[None]).norm(dim=-1).sort(dim=1).values[:, 1:4]
    torch.testing.assert_close(neighbour_distance(points, "rms"), distances.square().mean(dim=1).sqrt())
    made = gaussians_at(PointCloud(points, points), scale_law="rms")
    torch.testing.assert_close(made.scales[:, 0], neighbour_distance(points, "rms"))


@pytest.mark.parametrize("n", [2, 3, 4, 5, 256, 1000])
def test_neighbour_distances_are_those_of_an_exhaustive_search(n):
    torch.testing.assert_close(neighbour_distance(cloud(n)), by_hand(cloud(n)))


def test_the_distance_of_an_outlier_is_exact():
    points = cloud(512) * 0.01
    points[17] = torch.tensor([50.0, -3.0, 8.0])
    torch.testing.assert_close(neighbour_distance(points), by_hand(points))


def test_coincident_points_keep_a_size():
    assert (neighbour_distance(torch.zeros(512, 3)) > 0).all()


def test_a_single_point_and_an_empty_cloud_are_accepted():
    assert neighbour_distance(torch.zeros(1, 3)).tolist() == [1.0]
    assert neighbour_distance(torch.zeros(0, 3)).shape == (0,)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_gaussians_show_their_color_from_every_side(degree):
    made = gaussians_at(colored(9), sh_degree=degree)
    assert made.sh_degree == degree
    directions = torch.nn.functional.normalize(cloud(9, seed=1), dim=-1)
    torch.testing.assert_close(evaluate_sh(made.sh, directions), colored(9).rgb)


def test_gaussians_are_round_and_have_the_given_opacity():
    points = cloud(9)
    made = gaussians_at(colored(9))
    assert torch.equal(made.means, points)
    torch.testing.assert_close(made.opacities, torch.full((9,), 0.1))
    torch.testing.assert_close(made.scales, neighbour_distance(points)[:, None].expand(9, 3))
    torch.testing.assert_close(made.rotations, torch.eye(3).expand(9, 3, 3))


def test_every_point_is_replicated_at_the_same_offsets():
    original = colored(50)
    made = replicated(original, 20, 0.05, seeded())
    assert len(made) == 1000
    offsets = made.points.view(50, 20, 3) - original.points[:, None]
    torch.testing.assert_close(offsets, offsets[:1].expand(50, 20, 3), atol=1e-6, rtol=0)
    assert offsets.norm(dim=-1).min() > 0
    assert offsets.norm(dim=-1).max() <= 0.05 + 1e-6
    assert torch.equal(made.rgb.view(50, 20, 3), original.rgb[:, None].expand(50, 20, 3))


def test_polar_offsets_have_uniform_distances_and_angles():
    """LucidDreamer's mean distance is half the radius; with equal density it would be three quarters."""
    origin = PointCloud(torch.zeros(1, 3), torch.zeros(1, 3))
    offsets = replicated(origin, 20_000, 0.1, seeded(), "polar").points
    distances = offsets.norm(dim=-1)
    inclinations = (offsets[:, 2] / distances).acos()
    turns = torch.atan2(offsets[:, 1], offsets[:, 0]) % (2 * torch.pi)
    for value, most in ((distances, 0.1), (inclinations, torch.pi), (turns, 2 * torch.pi)):
        quantiles = torch.tensor([0.25, 0.5, 0.75])
        torch.testing.assert_close(value.quantile(quantiles) / most, quantiles, atol=0.01, rtol=0)
    even = replicated(origin, 20_000, 0.1, seeded()).points.norm(dim=-1)
    assert float(even.mean() / distances.mean()) == pytest.approx(1.5, abs=0.02)


def test_one_copy_of_each_point_is_the_cloud_itself_without_random_draws():
    generator = seeded()
    before = generator.get_state()
    original = colored(5)
    assert replicated(original, 1, 0.05, generator) is original
    assert torch.equal(generator.get_state(), before)


def test_rows_are_a_random_choice_in_order():
    rows = rows_of(1000, 300, seeded())
    assert len(rows) == 300
    assert (rows.diff() > 0).all()
    assert rows.float().mean() == pytest.approx(500, abs=50)
    assert not torch.equal(rows, rows_of(1000, 300, seeded(1)))


@pytest.mark.parametrize("count", [None, 10, 11])
def test_all_rows_remain_unless_the_cap_is_smaller(count):
    assert rows_of(10, count, seeded()).tolist() == list(range(10))


def test_fitted_points_are_centred_with_the_farthest_at_the_radius():
    points = cloud(500) * torch.tensor([1.0, 2.0, 0.5]) + 7
    center, factor = fit(points, 0.9)
    placed = (points - center) * factor
    assert float(placed.norm(dim=-1).max()) == pytest.approx(0.9)
    torch.testing.assert_close(placed.amin(dim=0), -placed.amax(dim=0), atol=1e-5, rtol=0)


def test_a_single_point_is_moved_to_the_origin():
    center, factor = fit(cloud(1), 0.5)
    assert ((cloud(1) - center) * factor).tolist() == [[0, 0, 0]]


def test_a_surface_is_covered_in_proportion_to_its_area():
    small = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]])
    faces, weights = points_on_surface(torch.cat([small, 3 * small]), 20_000, seeded())
    assert float(faces.float().mean()) == pytest.approx(0.9, abs=0.01)
    torch.testing.assert_close(weights.sum(dim=1), torch.ones(20_000))
    torch.testing.assert_close(weights.mean(dim=0), torch.full((3,), 1 / 3), atol=0.01, rtol=0)


@pytest.mark.parametrize("name", [".", "absent.ply", "x" * 5000, "null\0byte"])
def test_a_path_that_is_no_file_is_refused(name):
    with pytest.raises(UserError, match=r"^initializer\.path: expected a file"):
        found_file(name, "initializer.path")
