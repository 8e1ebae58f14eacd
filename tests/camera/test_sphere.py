"""Laws of the sphere sampler."""

import torch

from cadam3d.camera.sphere import Sphere
from cadam3d.core.cameras import Cameras


def sample(views: int, seed: int = 0, **changes) -> Cameras:
    sphere = Sphere(**{"size": 40, "distance": [2.5, 3.5], "fov_y_deg": [40.0, 50.0], **changes})
    return sphere.sample(0, views, torch.Generator().manual_seed(seed))


def test_directions_are_uniform_over_the_whole_sphere():
    positions = sample(40_000).positions
    directions = positions / positions.norm(dim=-1, keepdim=True)
    torch.testing.assert_close(directions.mean(dim=0), torch.zeros(3), atol=0.015, rtol=0)
    second = directions.T @ directions / len(directions)
    torch.testing.assert_close(second, torch.eye(3) / 3, atol=0.01, rtol=0)
    fourth = directions.pow(4).mean(dim=0)
    torch.testing.assert_close(fourth, torch.full((3,), 1 / 5), atol=0.01, rtol=0)


def test_distances_and_lenses_stay_in_their_ranges():
    cameras = sample(5000)
    distance = cameras.positions.norm(dim=-1)
    fov = torch.rad2deg(2 * torch.atan(20 / cameras.intrinsics[:, 1, 1]))
    assert 2.499 < distance.min() < 2.51
    assert 3.49 < distance.max() < 3.501
    assert 39.99 < fov.min() < 40.1
    assert 49.9 < fov.max() < 50.01
