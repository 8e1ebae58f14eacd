"""MeshMetric: distances between surfaces that are known exactly."""

import math
from functools import partial

import numpy as np
import pytest
import torch

from cadam3d.core.gaussians import Gaussians
from cadam3d.core.mesh import distance
from cadam3d.core.mesh.distance import true_surfaces
from cadam3d.core.rendering import Truth
from cadam3d.metric import mesh
from cadam3d.metric.base import Measurand
from cadam3d.metric.mesh import MeshMetric, distances_between
from cadam3d.prior.shapes.scene import build, signed_distance

SETTINGS = {
    "resolution": 32,
    "level": 0.3,
    "smallest_part": 0.01,
    "triangles": None,
    "threshold": 0.02,
    "samples": 2000,
    "seed": 0,
}


def ball(radius, x=0.0):
    return lambda points: (points - torch.tensor([x, 0.0, 0.0])).norm(dim=1)[None] - radius


@pytest.fixture(scope="module", autouse=True)
def coarse():
    """Use coarser true surfaces and fewer samples, which takes less time."""
    patch = pytest.MonkeyPatch()
    patch.setattr(distance, "TRUE_NODES", 64)
    patch.setattr(distance, "CELL", 2.0 / 64)
    patch.setattr(mesh, "GUIDES", 20_000)
    yield
    patch.undo()


def never_renders(cameras, background):
    raise AssertionError("a mesh needs no picture")


def gaussian_ball() -> Gaussians:
    index = torch.arange(800) + 0.5
    z, angle = 1 - index / 400, math.pi * (1 + math.sqrt(5)) * index
    across = (1 - z * z).sqrt()
    means = torch.stack([across * angle.cos(), across * angle.sin(), z], dim=1)  # evenly on a sphere
    return Gaussians(
        means=0.5 * means,
        log_scales=torch.full((800, 3), math.log(0.02)),
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(800, 4),
        opacity_logits=torch.full((800,), 3.0),
        sh=torch.zeros(800, 1, 3),
    )


def measure(truth, **changes):
    ball = Measurand(gaussians=gaussian_ball(), render=never_renders, prompt="a ball", truth=truth)
    return MeshMetric(**{**SETTINGS, **changes}).measure(ball).numbers


def shaped(distance_to):
    return Truth(never_images, partial(true_surfaces, distance_to))


def never_images(cameras, background):
    raise AssertionError("a mesh needs no true images")


def test_a_true_surface_is_where_the_distance_is_zero():
    [(vertices, faces)] = true_surfaces(ball(0.5, x=0.1))
    assert len(faces) > 1000
    radii = np.linalg.norm(vertices - [0.1, 0, 0], axis=1)
    assert np.abs(radii - 0.5).max() < 0.002


def test_concentric_balls_are_apart_by_the_difference_of_their_radii():
    [small], [large] = true_surfaces(ball(0.5)), true_surfaces(ball(0.6))
    for distances in distances_between(small, large, 1000, 0):
        np.testing.assert_allclose(distances, 0.1, atol=0.003)


def test_shifted_balls_have_the_analytic_mean_distance():
    """At an angle a from the shift s, the distance is |sqrt(r^2 + s^2 - 2 r s cos a) - r|."""
    r, s = 0.5, 0.2
    cosine = np.linspace(-1, 1, 100_001)  # uniform by area
    expected = np.abs(np.sqrt(r * r + s * s - 2 * r * s * cosine) - r).mean()
    [here], [there] = true_surfaces(ball(r)), true_surfaces(ball(r, x=s))
    for distances in distances_between(here, there, 5000, 0):
        assert distances.mean() == pytest.approx(expected, rel=0.02)


def test_distances_to_large_triangles_are_exact():
    square = (np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]), np.array([[0, 1, 2], [0, 2, 3]]))
    above = (square[0] + [0.0, 0.0, 0.3], square[1])
    beside = (square[0] + [2.5, 0.0, 0.0], square[1])
    for distances in distances_between(square, above, 500, 0):
        np.testing.assert_allclose(distances, 0.3, atol=1e-12)
    to_beside, _ = distances_between(square, beside, 20_000, 0)
    assert to_beside.min() >= 0.5
    assert to_beside.mean() == pytest.approx(1.5, rel=0.02)


def test_a_right_mesh_has_a_high_score_and_a_wrong_one_a_low_one():
    right = measure(shaped(ball(0.54)), threshold=0.03)
    wrong = measure(shaped(ball(0.7)), threshold=0.03)
    assert right["mesh_fscore"] > 0.95
    assert right["mesh_chamfer"] < 0.03
    assert wrong["mesh_fscore"] == wrong["mesh_precision"] == wrong["mesh_recall"] == 0.0
    assert 0.1 < wrong["mesh_chamfer"] < 0.2


def test_the_best_mode_counts():
    def both(points):
        return torch.cat([ball(0.7)(points), ball(0.54)(points)])

    assert measure(shaped(both)) == measure(shaped(ball(0.54)))


def test_without_a_true_shape_there_are_no_numbers():
    assert measure(None) == {}
    assert measure(Truth(never_images)) == {}


@pytest.mark.parametrize("prompt", ["a mug", "a tall red pine on a table", "a flat ellipsoid"])
def test_signed_distances_of_a_scene_never_exceed_the_distance(prompt):
    scene = build(prompt).to(torch.device("cpu"), torch.float64)
    draw = torch.Generator().manual_seed(0)
    points = 2 * torch.rand(400, 3, generator=draw, dtype=torch.float64) - 1
    steps = 0.2 * torch.randn(400, 3, generator=draw, dtype=torch.float64)
    here, there = signed_distance(scene, points), signed_distance(scene, points + steps)
    assert ((here - there).abs() <= steps.norm(dim=1) + 1e-9).all()
    assert (here > 0).any()
    assert (signed_distance(scene, scene.offsets) < 0).any()


def test_hollows_that_cannot_be_reached_are_no_part_of_the_truth():
    def shell(points):
        return ((points.norm(dim=1) - 0.5).abs() - 0.1)[None]

    [(vertices, _)] = true_surfaces(shell)
    assert np.linalg.norm(vertices, axis=1).min() > 0.55
