"""Traced images: inside the unit ball, equal to brute force, and lit by a light that does not move."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from cadam3d.core.cameras import Cameras, fitting_distance, turntable
from cadam3d.prior.light import AMBIENT, DIFFUSE, LIGHT, SKY, WRAP
from cadam3d.prior.shapes.grammar import parse
from cadam3d.prior.shapes.objects import Part, known_objects, known_primitives
from cadam3d.prior.shapes.scene import FIT_RADIUS, Scene, assemble, build, compile_scene, sphere_directions
from cadam3d.prior.shapes.tracer import Layers, trace
from cadam3d.prior.shapes.words import COLOURS

PROMPTS = (
    "a red and yellow checkered torus",
    "a small blue cube on a large green sphere",
    "a red cone next to a yellow cylinder",
    "a white sphere between a red cube and a blue cube",
    "a spotted mushroom",
    "a red mug on a table",
    "a ball under a table",
    "a tall striped cone in front of a flat disc",
)


def look(prompt: str, size: int = 40, views: int = 4, samples: int = 1) -> tuple[Scene, Layers]:
    scene = build(prompt).to(torch.device("cpu"), torch.float32)
    return scene, trace(scene, cameras(size, views), samples)


def cameras(size: int, views: int, elevation_deg: float = 15.0) -> Cameras:
    return turntable(
        views, elevation_deg=elevation_deg, distance=fitting_distance(40.0), fov_y_deg=40.0, size=size
    )


def inside(parts: tuple[Part, ...], points: Tensor) -> Tensor:
    return torch.stack([part.solid.distance(points) for part in parts]).amin(0) < 0


def expected_light(normal: Tensor) -> Tensor:
    light = torch.nn.functional.normalize(torch.tensor(LIGHT, dtype=torch.float64), dim=0)
    facing = ((normal @ light + WRAP) / (1 + WRAP)).clamp_min(0)
    return AMBIENT + SKY * (0.5 + 0.5 * normal[..., 2]) + DIFFUSE * facing


@pytest.mark.parametrize("prompt", [*known_primitives(), *known_objects(), *PROMPTS])
def test_every_scene_fills_the_ball_and_is_seen_from_all_sides(prompt: str) -> None:
    parts = assemble(parse(prompt))
    directions = sphere_directions(2000).T
    reach = torch.stack([part.solid.support(directions) for part in parts]).amax(0)
    assert 0.97 * FIT_RADIUS < float(reach.max()) < 1.02 * FIT_RADIUS
    layers = trace(compile_scene(parts).to(torch.device("cpu"), torch.float32), cameras(32, 2), 1)
    coverage = layers.alpha.mean(dim=(1, 2))
    assert bool(((coverage > 0.02) & (coverage < 0.80)).all())
    border = torch.cat([layers.alpha[:, [0, -1]].flatten(), layers.alpha[:, :, [0, -1]].flatten()])
    assert float(border.max()) == 0.0


def rays(view: Cameras) -> tuple[torch.Tensor, torch.Tensor]:
    """Return world-space ray origins, and unit directions through every pixel centre, "v h w 3"."""
    rows, columns = (torch.arange(size).to(view.intrinsics) + 0.5 for size in (view.height, view.width))
    y, x = torch.meshgrid(rows, columns, indexing="ij")
    to_world = view.world_to_camera[:, :3, :3].transpose(1, 2) @ torch.linalg.inv(view.intrinsics)
    directions = torch.einsum("vij,hwj->vhwi", to_world, torch.stack([x, y, torch.ones_like(x)], dim=-1))
    return view.positions, torch.nn.functional.normalize(directions, dim=-1)


@pytest.mark.parametrize("prompt", ["mug", "star", "arch", "tetrahedron", PROMPTS[2]])
def test_silhouette_equals_brute_force(prompt: str) -> None:
    """A pixel is covered if and only if one of many points along its ray is inside a solid."""
    parts = assemble(parse(prompt))
    view = cameras(16, 2).to(torch.float64)
    layers = trace(compile_scene(parts), view, 1)
    origins, directions = rays(view)
    depths = fitting_distance(40.0) + torch.linspace(-0.9, 0.9, 500, dtype=torch.float64)
    points = origins[:, None, None, None] + depths[:, None] * directions[..., None, :]
    walked = inside(parts, points.reshape(-1, 3).T).reshape(points.shape[:-1]).any(-1)
    # The walk may step over a thin corner; the opposite error is impossible.
    assert bool((layers.alpha[walked] > 0).all())
    assert float(((layers.alpha > 0) & ~walked).double().mean()) < 0.01


@pytest.mark.parametrize("prompt", ["a rocket", "a hammer next to a tall chair"])
def test_picture_equals_brute_force(prompt: str) -> None:
    """Find the first point inside a solid by small steps and bisection, and its normal by autograd."""
    parts = assemble(parse(prompt))
    view = cameras(24, 2, elevation_deg=30.0).to(torch.float64)
    layers = trace(compile_scene(parts), view, 1)
    origins, directions = rays(view)
    start = origins[:, None, None].expand_as(directions)[layers.alpha > 0].T
    direction = directions[layers.alpha > 0].T
    depths = fitting_distance(40.0) + torch.linspace(-0.9, 0.9, 400, dtype=torch.float64)
    walk = (start[..., None] + direction[..., None] * depths).flatten(1)
    is_in = inside(parts, walk).reshape(-1, 400)
    found = is_in.any(1)
    start, direction, far = start[:, found], direction[:, found], depths[is_in.double().argmax(1)[found]]
    near = far - 1.8 / 399
    for _ in range(25):
        middle = (near + far) / 2
        enters = inside(parts, start + middle * direction)
        near, far = torch.where(enters, near, middle), torch.where(enters, middle, far)

    point = (start + far * direction).requires_grad_(True)
    distance = torch.stack([part.solid.distance(point) for part in parts])
    nearest = distance.argmin(0)
    (gradient,) = torch.autograd.grad(distance.amin(0).sum(), point)
    light = expected_light(torch.nn.functional.normalize(gradient, dim=0).T)
    colours = torch.tensor([COLOURS[part.coat.first] for part in parts], dtype=torch.float64)
    scene = compile_scene(parts)
    image = layers.images(scene.albedo, torch.zeros(2, 3, dtype=torch.float64))[:, 0].permute(0, 2, 3, 1)
    error = (image[layers.alpha > 0][found] - colours[nearest] * light[:, None]).abs().amax(1)
    # A ray that passes an edge within the tolerance of a hit may hit the neighbouring face.
    assert float((error < 0.02).double().mean()) > 0.96


def test_light_on_a_sphere_equals_the_formula() -> None:
    """A point of the world has the same light from every side, since light depends on the normal alone."""
    view = cameras(64, 3, elevation_deg=35.0).to(torch.float64)
    layers = trace(build("a white sphere"), view, 1)
    origins, directions = rays(view)
    along = -(origins[:, None, None] * directions).sum(-1)
    square = along**2 - (origins.square().sum(-1) - FIT_RADIUS**2)[:, None, None]
    # Leave out the rim, where normals change fast.
    is_inner = square > 0.02
    point = origins[:, None, None] + (along - square.clamp_min(0).sqrt())[..., None] * directions
    expected = expected_light(point / FIT_RADIUS)
    torch.testing.assert_close(layers.paints.sum(-1)[is_inner], expected[is_inner], atol=5e-3, rtol=0)


def test_turning_scene_and_camera_together_changes_no_silhouette() -> None:
    parts = assemble(parse("a rocket next to a chair"))
    turned = tuple(replace(part, solid=part.solid.turned("z", 90)) for part in parts)
    view = cameras(40, 4).to(torch.float64)
    before = trace(compile_scene(parts), view, 2).alpha
    after = trace(compile_scene(turned), view, 2).alpha
    # View i now shows the same side as view i - 1 did before.
    assert float((after - before.roll(1, 0)).abs().mean()) < 1e-3


@pytest.mark.parametrize("prompt", ["sphere", "cube", "cone", "disc"])
def test_a_symmetric_object_looks_the_same_from_every_quarter(prompt: str) -> None:
    _, layers = look(prompt, samples=2)
    assert float((layers.alpha - layers.alpha[:1]).abs().mean()) < 2e-3


def test_finer_sampling_makes_soft_edges_of_the_same_shape() -> None:
    _, coarse = look("a sphere", size=64, samples=1)
    _, fine = look("a sphere", size=64, samples=4)
    assert set(coarse.alpha.unique().tolist()) == {0.0, 1.0}
    soft = (fine.alpha > 0.01) & (fine.alpha < 0.99)
    assert 0.01 < float(soft.float().mean()) < 0.1
    torch.testing.assert_close(coarse.alpha.mean(), fine.alpha.mean(), rtol=0.01, atol=0)
    # A sphere of radius r at distance d shows a disc of radius r / sqrt(d^2 - r^2) at unit focal length.
    distance = fitting_distance(40.0)
    radius = FIT_RADIUS / (distance**2 - FIT_RADIUS**2) ** 0.5 * float(cameras(64, 1).intrinsics[0, 0, 0])
    torch.testing.assert_close(
        fine.alpha.sum(dim=(1, 2)), torch.full((4,), torch.pi * radius**2), rtol=0.01, atol=0
    )


def test_an_open_colour_is_a_mixture_and_a_named_one_is_not() -> None:
    assert build("a torus").albedo.shape[0] == 8
    torch.testing.assert_close(
        build("a torus").log_weights.exp().sum(), torch.tensor(1.0, dtype=torch.float64)
    )
    assert build("a red torus").albedo.shape[0] == 1
    assert build("a lighthouse").albedo.shape[0] == 1
    two = build("a cube on a sphere").albedo
    assert two.shape[:2] == (8, 2)
    assert float((two[:, 0] - two[:, 1]).abs().amax(-1).min()) > 0.1  # never both the same colour


@pytest.mark.parametrize(
    ("prompt", "above"), [("a red cube on a blue sphere", True), ("a red cube under a blue sphere", False)]
)
def test_on_and_under_are_above_and_below(prompt: str, above: bool) -> None:
    scene, layers = look(prompt)
    image = layers.images(scene.albedo, torch.zeros(4, 3))[0, 0]
    rows = torch.arange(40.0)
    red, blue = ((image[channel] > 0.3).float().sum(1) for channel in (0, 2))
    mean_red, mean_blue = ((count * rows).sum() / count.sum() for count in (red, blue))
    assert bool(mean_red < mean_blue) is above


def test_an_object_between_others_is_in_the_middle_as_seen_from_the_front() -> None:
    scene, layers = look("a green sphere between a red cube and a blue cube")
    image = layers.images(scene.albedo, torch.zeros(4, 3))[0, 0]
    columns = torch.arange(40.0)
    is_main = image > 0.9 * image.amax(0) - 1e-6
    centres = []
    for channel in (0, 1, 2):
        count = (is_main[channel] & (image[channel] > 0.3)).float().sum(0)
        centres.append(float((count * columns).sum() / count.sum()))
    assert centres == sorted(centres)
