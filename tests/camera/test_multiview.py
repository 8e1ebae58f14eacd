"""Laws of the multiview sampler."""

import math

import pytest
import torch

from cadam3d.camera.multiview import Multiview
from cadam3d.core.cameras import Cameras
from cadam3d.core.errors import UserError

PUBLISHED = {
    "size": 40,
    "elevation_deg": [0.0, 30.0],
    "elevation_law": "mixture",
    "relative_distance": [0.8, 1.0],
    "fov_y_deg": [15.0, 60.0],
}


def sample(views: int, seed: int = 0, **changes) -> Cameras:
    return Multiview(**{**PUBLISHED, **changes}).sample(0, views, torch.Generator().manual_seed(seed))


def groups(values: torch.Tensor) -> torch.Tensor:
    return values.view(-1, 4)


def fov_y(cameras: Cameras) -> torch.Tensor:
    return 2 * torch.atan(cameras.height / 2 / cameras.intrinsics[:, 1, 1])


def test_views_of_a_group_share_all_but_the_azimuth():
    cameras = sample(400)
    for values in (cameras.elevation_deg, cameras.positions.norm(dim=-1), fov_y(cameras)):
        torch.testing.assert_close(groups(values), groups(values)[:, :1].expand(-1, 4))
        assert len(groups(values)[:, 0].unique()) > 90  # and groups differ


def test_azimuths_of_a_group_are_at_right_angles_from_a_random_start():
    azimuth = groups(sample(8000).azimuth_deg)
    torch.testing.assert_close(azimuth - azimuth[:, :1], torch.arange(4.0).mul(90).expand(2000, 4))
    start = azimuth[:, 0]
    assert -180 <= start.min() < -179
    assert -91 < start.max() < -90
    assert float(start.mean()) == pytest.approx(-135, abs=2)


def test_half_the_height_of_the_image_at_the_origin_is_the_relative_distance():
    cameras = sample(8000)
    half = cameras.positions.norm(dim=-1) * torch.tan(fov_y(cameras) / 2)
    assert 0.8 - 1e-4 <= half.min() < 0.802
    assert 0.998 < half.max() <= 1 + 1e-4
    assert float(half.mean()) == pytest.approx(0.9, abs=0.01)


def test_lenses_and_elevations_stay_in_their_ranges():
    cameras = sample(8000)
    assert math.radians(14.99) < fov_y(cameras).min() < math.radians(15.2)
    assert math.radians(59.8) < fov_y(cameras).max() < math.radians(60.01)
    assert -1e-3 <= cameras.elevation_deg.min() < 0.2
    assert cameras.elevation_deg.max() <= 30 + 1e-3


def test_opposite_views_look_at_each_other():
    position = sample(4, elevation_deg=[0.0, 0.0]).positions
    torch.testing.assert_close(position[0], -position[2], atol=1e-5, rtol=0)
    torch.testing.assert_close((position[0] * position[1]).sum(), torch.tensor(0.0), atol=1e-4, rtol=0)


@pytest.mark.parametrize("views", [1, 2, 5, 10])
def test_an_incomplete_group_is_refused(views):
    for call in (lambda: sample(views), lambda: Multiview(**PUBLISHED).check_views(views)):
        with pytest.raises(
            UserError, match=rf"^views: expected a multiple of 4.*got {views}\. Try: views=4$"
        ):
            call()
