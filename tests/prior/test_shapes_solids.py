"""Laws of the signed distance functions and of their support functions."""

import math

import pytest
import torch

from cadam3d.prior.shapes.solids import (
    KINDS,
    Solid,
    arc,
    ball,
    box,
    capsule,
    cone,
    cylinder,
    ellipsoid,
    frustum,
    gable,
    octahedron,
    pyramid,
    star,
    tetrahedron,
    torus,
    tube,
)

# Every solid with its volume from a textbook.
VOLUMES: dict[str, tuple[Solid, float]] = {
    "ball": (ball(0.8), 4 / 3 * math.pi * 0.8**3),
    "ellipsoid": (ellipsoid(0.9, 0.5, 0.3), 4 / 3 * math.pi * 0.9 * 0.5 * 0.3),
    "box": (box(1.0, 1.4, 0.6), 1.0 * 1.4 * 0.6),
    "cylinder": (cylinder(0.5, 1.2), math.pi * 0.25 * 1.2),
    "cone": (cone(0.7, 1.4), math.pi * 0.49 * 1.4 / 3),
    "frustum": (frustum(0.7, 0.3, 1.0), math.pi / 3 * (0.49 + 0.21 + 0.09)),
    "tube": (tube(0.8, 0.5, 0.6), math.pi * (0.64 - 0.25) * 0.6),
    "torus": (torus(0.6, 0.25), 2 * math.pi**2 * 0.6 * 0.0625),
    "arc": (arc(0.6, 0.2, 100), 2 * math.radians(100) * 0.6 * math.pi * 0.04 + 4 / 3 * math.pi * 0.008),
    "capsule": (capsule(0.4, 1.6), math.pi * 0.16 * 0.8 + 4 / 3 * math.pi * 0.064),
    "pyramid": (pyramid(1.2, 1.0, 1.4), 1.2 * 1.0 * 1.4 / 3),
    "gable": (gable(1.2, 1.0, 0.8), 1.2 * 1.0 * 0.8 / 2),
    "tetrahedron": (tetrahedron(0.95), 8 / (9 * math.sqrt(3)) * 0.95**3),
    "octahedron": (octahedron(0.9, 0.7, 0.8), 4 / 3 * 0.9 * 0.7 * 0.8),
    "star": (star(0.9, 0.4, 0.5), 5 * 0.9 * 0.4 * math.sin(math.pi / 5) * 0.5),
}
SOLIDS = [pytest.param(solid, id=name) for name, (solid, _) in VOLUMES.items()]


def random_points(count: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(3, count, generator=generator, dtype=torch.float64) * 2 - 1


def unit_vectors(count: int, seed: int = 1) -> torch.Tensor:
    return torch.nn.functional.normalize(random_points(count, seed), dim=0)


def test_every_kind_is_tested_in_this_file() -> None:
    assert {solid.kind for solid, _ in VOLUMES.values()} == set(KINDS)


@pytest.mark.parametrize("name", VOLUMES)
def test_inside_has_the_volume_of_the_textbook(name: str) -> None:
    solid, volume = VOLUMES[name]
    points = random_points(60_000)
    share = float((solid.distance(points) < 0).double().mean())
    error = math.sqrt(volume / 8 * (1 - volume / 8) / points.shape[1])
    assert abs(share - volume / 8) < 4 * error


@pytest.mark.parametrize("solid", SOLIDS)
def test_distance_never_overshoots_the_surface(solid: Solid) -> None:
    """The function is 1-Lipschitz with the right sign: no point of the surface is nearer than its value."""
    first, step = random_points(20_000), 0.3 * random_points(20_000, seed=2)
    difference = (solid.distance(first + step) - solid.distance(first)).abs()
    assert bool((difference <= step.norm(dim=0) * (1 + 1e-9)).all())


@pytest.mark.parametrize("solid", SOLIDS)
def test_distance_grows_on_the_way_out(solid: Solid) -> None:
    """The bound stays useful far away, so that a ray that advances by it makes progress."""
    away = unit_vectors(500) * 6
    assert bool((solid.distance(away) > 0.3).all())


@pytest.mark.parametrize("solid", SOLIDS)
def test_no_inner_point_is_beyond_the_support(solid: Solid) -> None:
    points, directions = random_points(40_000), unit_vectors(40)
    inner = points[:, solid.distance(points) < 0]
    assert bool((directions.T @ inner <= solid.support(directions)[:, None] + 1e-12).all())


@pytest.mark.parametrize("solid", SOLIDS)
def test_the_surface_touches_every_supporting_plane(solid: Solid) -> None:
    """The gradient of a support function is the point that touches the supporting plane."""
    moved = solid.turned("x", 20).turned("z", 50).at(0.1, -0.2, 0.3)
    directions = unit_vectors(60).requires_grad_(True)
    (touching,) = torch.autograd.grad(moved.support(directions).sum(), directions)
    assert float(moved.distance(touching).abs().max()) < 1e-9


def test_turns_are_right_handed() -> None:
    for axis, start, end in (
        ("x", (0, 1, 0), (0, 0, 1)),
        ("y", (0, 0, 1), (1, 0, 0)),
        ("z", (1, 0, 0), (0, 1, 0)),
    ):
        turned = ball(0.1).at(*map(float, start)).turned(axis, 90)
        torch.testing.assert_close(turned.offset, torch.tensor(end, dtype=torch.float64))
