"""Surfaces of Gaussians: closed, at the right place, without an inside, and in the colours of a render."""

import math

import numpy as np
import pytest
import torch
import trimesh

from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians, concatenate
from cadam3d.core.mesh.density import CUTOFF, blobs, density, grid_around, near
from cadam3d.core.mesh.surface import SurfaceSettings, is_watertight, separated, simplified
from cadam3d.core.sh import rgb_to_sh0

RED, BLUE = (0.9, 0.1, 0.1), (0.1, 0.2, 0.9)


class Settings(SurfaceSettings):
    node = "exporter.mesh"


def settings(**changes) -> Settings:
    return Settings(**{"resolution": 48, "level": 0.3, "smallest_part": 0.01, "triangles": None, **changes})


def ball(radius: float, count: int = 1500, color=RED, scale: float = 0.03) -> Gaussians:
    """Return opaque Gaussians, evenly on a sphere."""
    index = torch.arange(count) + 0.5
    z, angle = 1 - 2 * index / count, math.pi * (1 + math.sqrt(5)) * index
    across = (1 - z * z).sqrt()
    return at(torch.stack([across * angle.cos(), across * angle.sin(), z], 1) * radius, color, scale)


def at(means: torch.Tensor, color=RED, scale: float = 0.03, logit: float = 3.0) -> Gaussians:
    n = len(means)
    return Gaussians(
        means=means.float(),
        log_scales=torch.full((n, 3), math.log(scale)),
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(n, 4),
        opacity_logits=torch.full((n,), logit),
        sh=rgb_to_sh0(torch.tensor(color)).expand(n, 1, 3),
    )


def facts(vertices: np.ndarray, faces: np.ndarray) -> trimesh.Trimesh:
    return trimesh.Trimesh(vertices, faces, process=False)


def surface(gaussians: Gaussians, **changes):
    return settings(**changes).surface(gaussians)[0]


def random_gaussians(n: int, seed: int = 0) -> Gaussians:
    draw = torch.Generator().manual_seed(seed)
    return Gaussians(
        means=0.3 * torch.randn(n, 3, generator=draw),
        log_scales=-3.0 + torch.randn(n, 3, generator=draw),
        quats=torch.randn(n, 4, generator=draw),
        opacity_logits=torch.randn(n, generator=draw),
        sh=torch.randn(n, 4, 3, generator=draw),
    )


def test_the_density_is_the_sum_of_the_truncated_gaussians():
    some = blobs(random_gaussians(60))
    grid = grid_around(torch.tensor([-1.0] * 3), torch.tensor([1.0, 0.8, 1.2]), 24)
    axes = [torch.arange(nodes, dtype=torch.float64) for nodes in grid.nodes]
    away = (grid.origin + grid.cell * torch.cartesian_prod(*axes))[:, None] - some.means
    blurred = some.covariances + (0.5 * grid.cell) ** 2 * torch.eye(3)
    distance = torch.einsum("pni,nij,pnj->pn", away, torch.linalg.inv(blurred), away)
    expected = (some.opacities * (-distance / 2).exp() * (distance < CUTOFF**2)).sum(1)
    # Gaussians that are large in all directions are interpolated from coarser grids.
    torch.testing.assert_close(density(some, grid).flatten().double(), expected, atol=0.02, rtol=0.01)


def test_pairs_of_gaussians_and_points_are_complete():
    some = blobs(random_gaussians(40))
    grid = grid_around(torch.tensor([-1.0] * 3), torch.tensor([1.0] * 3), 40)
    points = torch.rand(200, 3, generator=torch.Generator().manual_seed(1)) - 0.5
    node = grid.origin + grid.cell * ((points.double() - grid.origin) / grid.cell).round()
    away = node[:, None] - some.means
    blurred = some.covariances + (0.5 * grid.cell) ** 2 * torch.eye(3)
    distance = torch.einsum("pni,nij,pnj->pn", away, torch.linalg.inv(blurred), away)
    wanted = {(int(blob), int(point)) for point, blob in (distance < CUTOFF**2).nonzero()}
    found = {
        pair
        for blob, point in near(some, grid, points)
        for pair in zip(blob.tolist(), point.tolist(), strict=True)
    }
    assert found == wanted


def test_a_ball_of_gaussians_is_a_watertight_ball_of_the_right_size():
    shape = surface(ball(0.5), resolution=64)
    numbers = facts(shape.vertices, shape.faces)
    radii = np.linalg.norm(shape.vertices, axis=1)
    assert numbers.is_watertight
    assert numbers.body_count == 1
    # The level is where a layer of Gaussians is faint: at most two standard deviations outside their centres.
    assert 0.5 < radii.min() <= radii.max() < 0.5 + CUTOFF * 0.03
    assert radii.std() < 0.005
    assert numbers.volume == pytest.approx(4 / 3 * math.pi * radii.mean() ** 3, rel=0.01)
    assert ((shape.normals * shape.vertices).sum(1) / radii).min() > 0.9


def test_an_inner_shell_vanishes():
    outer, both = surface(ball(0.5)), surface(concatenate([ball(0.5), ball(0.2, color=BLUE)]))
    assert np.linalg.norm(both.vertices, axis=1).min() > 0.45
    assert len(both.faces) == len(outer.faces)
    np.testing.assert_allclose(both.colors, np.tile(RED, (len(both.colors), 1)), atol=1e-5)


def test_specks_are_removed_however_far_away_they_are():
    speck = at(torch.tensor([[30.0, 0.0, 0.0]]), scale=0.01)
    with_speck, without = surface(concatenate([ball(0.5), speck])), surface(ball(0.5))
    assert facts(with_speck.vertices, with_speck.faces).body_count == 1
    assert np.linalg.norm(with_speck.vertices, axis=1).max() < 0.6
    assert len(with_speck.faces) > 0.4 * len(without.faces)  # the resolution is that of the object


def test_a_fuzzy_ball_is_smoothed_to_a_ball_and_a_solid_ball_is_not():
    draw = torch.Generator().manual_seed(0)
    near = ball(0.5, 6000).means * (1 + 0.08 * torch.randn(6000, 1, generator=draw))
    fuzzy = surface(at(near, scale=0.012), resolution=64)
    assert fuzzy.is_smoothed
    assert fuzzy.roughness > 0.25
    assert is_watertight(fuzzy.faces)
    assert facts(fuzzy.vertices, fuzzy.faces).area < 2 * 4 * math.pi * 0.5**2
    solid = surface(ball(0.5), resolution=64)
    assert not solid.is_smoothed
    assert solid.roughness < 0.05


@pytest.mark.parametrize("resolution", [48, 128])
def test_a_thin_wire_is_not_smoothed_away(resolution):
    angle = torch.arange(1000) / 1000 * 2 * math.pi
    ring = at(torch.stack([angle.cos(), angle.sin(), 0 * angle], 1) * 0.8, scale=0.006)
    assert not surface(ring, resolution=resolution).is_smoothed


def test_two_objects_stay_two_parts():
    right = ball(0.2)
    right.means = right.means + torch.tensor([0.0, 0.8, 0.0])
    shape = surface(concatenate([ball(0.4), right]))
    assert facts(shape.vertices, shape.faces).body_count == 2


@pytest.mark.parametrize("thin", [1e-3, 1e-6])
def test_a_wall_thinner_than_a_cell_has_no_holes(thin):
    y, z = torch.meshgrid(torch.linspace(-0.5, 0.5, 30), torch.linspace(-0.5, 0.5, 30), indexing="ij")
    wall = at(torch.stack([torch.full_like(y, 0.0037), y, z], -1).reshape(-1, 3))
    wall.log_scales[:, 0] = math.log(thin)
    shape = surface(wall)
    numbers = facts(shape.vertices, shape.faces)
    assert numbers.is_watertight
    assert numbers.body_count == 1
    corners = len(np.unique(shape.faces))
    edges = len(shape.faces) * 3 // 2
    assert corners - edges + len(shape.faces) == 2  # Euler: like a ball, so nothing goes through it


@pytest.mark.parametrize("seed", range(4))
def test_simplification_keeps_a_mesh_watertight(seed):
    full = surface(random_gaussians(150, seed), smallest_part=0.0)
    assert is_watertight(full.faces)
    target = len(full.faces) // 3
    vertices, faces = simplified(full.vertices, full.faces, target)
    assert is_watertight(faces)
    assert len(faces) < 1.9 * target  # these shapes touch themselves in many places
    before, after = facts(full.vertices, full.faces), facts(vertices, faces)
    assert after.volume == pytest.approx(before.volume, rel=0.02)


def test_a_simple_shape_gets_as_few_triangles_as_requested():
    full = surface(ball(0.5))
    vertices, faces = simplified(full.vertices, full.faces, 500)
    assert is_watertight(faces)
    assert 450 <= len(faces) <= 500
    assert len(np.unique(faces)) == len(vertices)


def test_sheets_that_touch_in_an_edge_become_separate():
    """Glue two tetrahedra along an edge, and add a fold of two triangles."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, -1, 0], [0, 0, -1]], dtype=float)
    one = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
    other = np.array([[0, 4, 1], [0, 1, 5], [1, 4, 5], [4, 0, 5]])
    fold = np.array([[1, 2, 3], [3, 2, 1], [2, 2, 3]])
    assert not is_watertight(np.concatenate([one, other]))
    moved, faces = separated(vertices, np.concatenate([one, other, fold]))
    assert is_watertight(faces)
    assert len(faces) == 8
    assert len(moved) == 8
    assert len(np.unique(moved, axis=0)) == 8


def test_colours_are_those_in_front_of_the_others():
    """Put a blue layer below a red one; both reach the surface, but only red is visible."""
    layers = concatenate([ball(0.44, color=BLUE, scale=0.05), ball(0.5, scale=0.05, count=3000)])
    colors = surface(layers).colors
    assert colors[:, 0].mean() > 0.85
    assert colors[:, 2].mean() < 0.15


def test_colours_of_degree_one_are_seen_against_the_normal():
    gaussians = ball(0.5)
    gaussians.sh = torch.cat([gaussians.sh, torch.zeros(len(gaussians), 3, 3)], 1)
    gaussians.sh[:, 2, 1] = 0.3  # green grows with the z of the direction from the camera
    shape = surface(gaussians)
    below = shape.colors[shape.normals[:, 2] < -0.95, 1].mean()
    above = shape.colors[shape.normals[:, 2] > 0.95, 1].mean()
    assert below > RED[1] + 0.1
    assert above == pytest.approx(0.0, abs=0.02)


def test_watertight_means_that_every_edge_has_two_triangles_in_opposite_directions():
    tetrahedron = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
    assert is_watertight(tetrahedron)
    assert not is_watertight(tetrahedron[:3])
    assert not is_watertight(np.concatenate([tetrahedron[:3], tetrahedron[3:, ::-1]]))
    assert not is_watertight(np.concatenate([tetrahedron, tetrahedron[:1]]))


def test_an_asset_without_a_surface_gets_a_message_with_its_density():
    with pytest.raises(UserError, match=r"exporter\.mesh\.level: "):
        surface(at(torch.zeros(0, 3)))
    faint = at(0.1 * torch.randn(5, 3, generator=torch.Generator().manual_seed(0)), logit=-3.0)
    with pytest.raises(UserError, match=r"exporter\.mesh\.level: .* Gaussian has 0\.047, got 0\.3"):
        surface(faint)
    assert len(surface(faint, level=0.01).faces) > 0


@pytest.mark.parametrize("key", ["means", "log_scales"])
@pytest.mark.parametrize("value", [3e38, -3e38, 80.0])
def test_extreme_numbers_give_a_mesh_or_a_message(key, value):
    gaussians = ball(0.5, count=200)
    gaussians.tensors()[key][0] = value
    try:
        shape = surface(gaussians)
    except UserError as error:
        message = str(error)
    else:
        assert facts(shape.vertices, shape.faces).is_watertight
        return
    assert "Try: " in message
