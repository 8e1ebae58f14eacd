"""Cameras: their positions and projections, also after copying, indexing and resizing."""

import math

import pytest
import torch
from torch import Tensor

from cadam3d.core.cameras import Cameras, fitting_distance, look_at, orbit, pinhole, turntable

CORNER_AZIMUTHS = [-180.0, -90.0, -33.0, 0.0, 45.0, 90.0, 179.0]
ELEVATIONS = [-90.0, -89.999, -20.0, 0.0, 60.0, 90.0]


def numbers(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def one(
    azimuth: float = 30, elevation: float = 20, distance: float = 2, height: int = 6, width: int = 8
) -> Cameras:
    return orbit(numbers(azimuth), numbers(elevation), numbers(distance), numbers(50), height, width)


def to_pixels(cameras: Cameras, points: Tensor) -> Tensor:
    """Return pixel coordinates of world ``points`` in the first view."""
    in_camera = points @ cameras.world_to_camera[0, :3, :3].T + cameras.world_to_camera[0, :3, 3]
    in_image = in_camera @ cameras.intrinsics[0].T
    return in_image[:, :2] / in_image[:, 2:]


@pytest.mark.parametrize("elevation", ELEVATIONS)
@pytest.mark.parametrize("azimuth", CORNER_AZIMUTHS)
def test_orbiting_cameras_have_their_angles_and_look_at_the_origin(azimuth, elevation):
    cameras = one(azimuth, elevation, distance=3)
    a, e = math.radians(azimuth), math.radians(elevation)
    position = numbers(math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)) * 3
    torch.testing.assert_close(cameras.positions[0], position)
    torch.testing.assert_close(to_pixels(cameras, torch.zeros(1, 3).double()), numbers(4, 3)[None])


@pytest.mark.parametrize("elevation", ELEVATIONS)
@pytest.mark.parametrize("azimuth", CORNER_AZIMUTHS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_world_to_camera_is_a_rigid_motion_even_at_the_poles(azimuth, elevation, dtype):
    angles = [torch.tensor([angle], dtype=dtype) for angle in (azimuth, elevation)]
    cameras = orbit(*angles, torch.tensor([2.0], dtype=dtype), torch.tensor([50.0], dtype=dtype), 6, 8)
    rotation = cameras.world_to_camera[0, :3, :3]
    torch.testing.assert_close(rotation @ rotation.T, torch.eye(3, dtype=dtype))
    assert torch.linalg.det(rotation).item() == pytest.approx(1, abs=1e-5)
    torch.testing.assert_close(cameras.world_to_camera[0, 3], torch.tensor([0.0, 0, 0, 1], dtype=dtype))


def test_from_the_front_plus_z_is_up_and_plus_y_is_right():
    pixels = to_pixels(one(azimuth=0, elevation=0), torch.eye(3, dtype=torch.float64) * 0.1)
    front, left_of_object, top = pixels - numbers(4, 3)
    torch.testing.assert_close(front, numbers(0, 0))
    assert left_of_object[0] > 0
    assert left_of_object[1].abs() < 1e-9
    assert top[1] < 0
    assert top[0].abs() < 1e-9


def test_azimuths_are_wrapped_into_half_a_turn_either_way():
    azimuth = numbers(-190, -180, 0, 180, 350)
    full = torch.ones_like(azimuth)
    cameras = orbit(azimuth, 0 * full, full, 50 * full, 4, 4)
    torch.testing.assert_close(cameras.azimuth_deg, numbers(170, -180, 0, -180, -10))


@pytest.mark.parametrize("up", [(0, 0, 1), (0, 1, 0), (1, 0, 0), (1, 1, 1), (0, -2, 0)])
def test_looking_along_up_still_gives_a_rotation(up):
    up = numbers(*up)[None]
    matrix = look_at(-up, torch.zeros_like(up), up)[0]
    torch.testing.assert_close(matrix[:3, :3] @ matrix[:3, :3].T, torch.eye(3, dtype=torch.float64))
    torch.testing.assert_close(matrix[2, :3], torch.nn.functional.normalize(up[0], dim=0))


def test_a_pinhole_spans_its_vertical_field_of_view():
    intrinsics = pinhole(numbers(90), height=100, width=40)[0]
    assert intrinsics.tolist() == [[pytest.approx(50), 0, 20], [0, pytest.approx(50), 50], [0, 0, 1]]


def test_resizing_scales_pixel_coordinates_with_the_image():
    cameras, points = (
        one(height=6, width=8),
        torch.randn(5, 3, generator=torch.Generator().manual_seed(0)).double(),
    )
    larger = cameras.resize(height=18, width=16)
    assert (larger.height, larger.width) == (18, 16)
    torch.testing.assert_close(
        to_pixels(larger, 0.1 * points), to_pixels(cameras, 0.1 * points) * numbers(2, 3)
    )


def test_index_picks_views_in_the_given_order():
    cameras = turntable(5, elevation_deg=10.0, distance=2.0, fov_y_deg=40.0, size=4)
    picked = cameras.index(torch.tensor([3, 0]))
    assert len(picked) == 2
    torch.testing.assert_close(picked.azimuth_deg, cameras.azimuth_deg[[3, 0]])
    torch.testing.assert_close(picked.positions, cameras.positions[[3, 0]])
    assert len(cameras.index(slice(1, 4))) == 3


def test_a_turntable_goes_round_once_evenly_from_the_front():
    cameras = turntable(4, elevation_deg=0.0, distance=2.0, fov_y_deg=40.0, size=4)
    torch.testing.assert_close(cameras.azimuth_deg, torch.tensor([0.0, 90.0, -180.0, -90.0]))
    torch.testing.assert_close(cameras.positions.sum(dim=0), torch.zeros(3), atol=1e-5, rtol=0)


def test_at_the_fitting_distance_a_ball_touches_the_border():
    distance = fitting_distance(40.0, radius=0.7)
    # The tangent to the ball leaves the axis at half the field of view.
    assert math.degrees(math.asin(0.7 / distance)) == pytest.approx(20)
