"""Laws of the axes of files: a change of axes turns the object and changes nothing visible."""

import pytest
import torch

from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.sh import sh_basis
from cadam3d.io.frames import (
    AXES,
    UPS,
    band_matrix,
    file_to_world,
    points_to_world,
    turned_points,
    world_to_file,
)


def random_gaussians(n: int = 40, degree: int = 3, seed: int = 0, dtype=torch.float64) -> Gaussians:
    draw = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=draw, dtype=dtype)

    return Gaussians(normal(n, 3), normal(n, 3), normal(n, 4), normal(n), normal(n, (degree + 1) ** 2, 3))


def covariances(gaussians: Gaussians) -> torch.Tensor:
    half = gaussians.rotations * gaussians.scales[:, None, :]
    return half @ half.transpose(1, 2)


def axes(up: str) -> torch.Tensor:
    return torch.tensor(AXES[up], dtype=torch.float64)


@pytest.mark.parametrize("up", UPS)
def test_axes_are_rotations_that_mirror_nothing(up):
    torch.testing.assert_close(axes(up) @ axes(up).T, torch.eye(3, dtype=torch.float64))
    assert torch.linalg.det(axes(up)).item() == pytest.approx(1.0)


@pytest.mark.parametrize(("up", "file_up"), [("-y", (0, -1, 0)), ("+y", (0, 1, 0)), ("+z", (0, 0, 1))])
def test_axes_are_named_after_the_direction_of_up(up, file_up):
    assert (axes(up) @ torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)).tolist() == list(file_up)


@pytest.mark.parametrize("up", ["-y", "+y"])
def test_the_front_faces_the_first_camera_of_viewers(up):
    assert (axes(up) @ torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)).tolist() == [0.0, 0.0, 1.0]


@pytest.mark.parametrize("up", UPS)
def test_means_and_covariances_turn_with_the_axes(up):
    world, turn = random_gaussians(), axes(up)
    local = world_to_file(world, up)
    torch.testing.assert_close(local.means, world.means @ turn.T)
    torch.testing.assert_close(covariances(local), turn @ covariances(world) @ turn.T)


@pytest.mark.parametrize("up", UPS)
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_colours_along_turned_directions_are_unchanged(up, degree):
    world = random_gaussians(degree=degree)
    directions = torch.nn.functional.normalize(random_gaussians(seed=1).means, dim=1)
    local = world_to_file(world, up)

    def colours(gaussians, seen_along):
        return torch.einsum("nk,gkc->gnc", sh_basis(seen_along, degree), gaussians.sh)

    torch.testing.assert_close(colours(local, directions @ axes(up).T), colours(world, directions))


@pytest.mark.parametrize("up", UPS)
@pytest.mark.parametrize("degree", [0, 1])
def test_the_round_trip_is_exact_to_the_bit_up_to_degree_one(up, degree):
    world = random_gaussians(degree=degree, dtype=torch.float32)
    back = file_to_world(world_to_file(world, up), up)
    for name, tensor in world.tensors().items():
        assert torch.equal(back.tensors()[name], tensor), name


@pytest.mark.parametrize("up", ["-y", "+y"])
def test_the_round_trip_rounds_higher_bands_only_slightly(up):
    world = random_gaussians(n=2000, degree=3, dtype=torch.float32)
    back = file_to_world(world_to_file(world, up), up)
    for name in ("means", "log_scales", "quats", "opacity_logits"):
        assert torch.equal(back.tensors()[name], world.tensors()[name]), name
    torch.testing.assert_close(back.sh, world.sh, rtol=0, atol=1e-6)  # coefficients of size 1 to 4


def test_the_vector_rule_of_band_one_agrees_with_the_fitted_matrix():
    world = random_gaussians(degree=1)
    matrix = band_matrix(1, tuple(axes("-y").flatten().tolist()))
    expected = torch.einsum("ij,njc->nic", matrix, world.sh[:, 1:])
    torch.testing.assert_close(world_to_file(world, "-y").sh[:, 1:], expected)


def test_an_unknown_up_axis_is_refused_with_the_choices():
    with pytest.raises(UserError, match=r"-y\|\+y\|\+z"):
        world_to_file(random_gaussians(), "up")


@pytest.mark.parametrize("up", UPS)
def test_points_are_converted_like_gaussians(up):
    world = random_gaussians(dtype=torch.float32)
    assert torch.equal(points_to_world(world_to_file(world, up).means, up), world.means)


def test_a_quarter_turn_moves_the_front_to_the_left():
    front = torch.tensor([[1.0, 0.0, 0.5]])
    assert turned_points(front, 90).tolist() == [[0.0, 1.0, 0.5]]
