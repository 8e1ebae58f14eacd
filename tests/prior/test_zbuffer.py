"""The z-buffer, compared with rays against every triangle."""

import pytest
import torch
import trimesh
from torch import Tensor

from cadam3d.core.cameras import Cameras, orbit
from cadam3d.prior.objects import zbuffer
from cadam3d.prior.objects.zbuffer import Hits, first_hits

SIZE = 24


def camera(
    azimuth: float = 20.0, elevation: float = 15.0, distance: float = 3.0, size: int = SIZE
) -> Cameras:
    values = (torch.tensor([value], dtype=torch.float64) for value in (azimuth, elevation, distance, 45.0))
    return orbit(*values, size, size)


def soup(count: int, seed: int) -> Tensor:
    """Random triangles around the origin, "n 3 3"."""
    generator = torch.Generator().manual_seed(seed)
    middle = 2 * torch.rand(count, 1, 3, generator=generator, dtype=torch.float64) - 1
    return middle + 0.5 * torch.randn(count, 3, 3, generator=generator, dtype=torch.float64)


def rays(cameras: Cameras) -> tuple[Tensor, Tensor]:
    """Return the position of the camera and the ray through each pixel, whose depth is 1."""
    x, y = torch.meshgrid(torch.arange(cameras.width), torch.arange(cameras.height), indexing="xy")
    pixels = torch.stack([x + 0.5, y + 0.5, torch.ones_like(x)], dim=-1).reshape(-1, 3).double()
    rotation = cameras.world_to_camera[0, :3, :3]
    return cameras.positions[0], pixels @ torch.linalg.inv(cameras.intrinsics[0]).T @ rotation


def brute_force(corners: Tensor, cameras: Cameras) -> tuple[Tensor, Tensor]:
    """Return the depth and the number of the first triangle of each pixel (Möller and Trumbore 1997)."""
    origin, direction = rays(cameras)
    first, second = (corners[:, end] - corners[:, 0] for end in (1, 2))
    cross = torch.linalg.cross(direction[:, None], second[None])
    determinant = (first * cross).sum(-1)
    away = origin - corners[:, 0]
    u = (away * cross).sum(-1) / determinant
    other = torch.linalg.cross(away, first)
    v = (direction[:, None] * other).sum(-1) / determinant
    depth = (second * other).sum(-1) / determinant
    is_hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (depth > zbuffer.NEAR)
    return torch.where(is_hit, depth, torch.inf).min(dim=1)


def dense(hits: Hits, cameras: Cameras) -> tuple[Tensor, Tensor]:
    depth = torch.full((cameras.width * cameras.height,), torch.inf, dtype=hits.depth.dtype)
    face = torch.full_like(depth, -1, dtype=torch.long)
    depth[hits.point], face[hits.point] = hits.depth, hits.face
    return depth, face


@pytest.mark.parametrize("distance", [3.0, 1.0, 0.2], ids=["outside", "among them", "inside"])
@pytest.mark.parametrize("seed", [0, 1])
def test_every_pixel_has_the_triangle_that_brute_force_finds(distance, seed, monkeypatch):
    """From inside, triangles are behind the near plane or partly behind the camera; both sides are seen."""
    monkeypatch.setattr(zbuffer, "GROWTH", 0.0)
    corners, cameras = soup(60, seed), camera(distance=distance)
    hits = first_hits(corners, cameras, 0)
    depth, face = dense(hits, cameras)
    expected, nearest = brute_force(corners, cameras)
    assert int(expected.isfinite().sum()) > 20
    torch.testing.assert_close(depth, expected, rtol=1e-6, atol=1e-6)
    seen = expected.isfinite()
    assert torch.equal(face[seen], nearest[seen])
    # The weights are those of the point in space.
    point = (hits.weights[:, :, None] * corners[hits.face]).sum(1)
    origin, direction = rays(cameras)
    torch.testing.assert_close(point, origin + hits.depth[:, None] * direction[hits.point], atol=1e-6, rtol=0)
    # The other winding shows the other sides.
    turned, _ = dense(first_hits(corners.flip(1), cameras, 0), cameras)
    torch.testing.assert_close(turned, depth)


def test_single_precision_differs_at_few_silhouettes_only():
    corners, cameras = soup(60, 0), camera()
    exact, exact_face = dense(first_hits(corners, cameras, 0), cameras)
    depth, face = dense(first_hits(corners.float(), cameras.to(torch.float32), 0), cameras)
    same = face == exact_face
    assert float(same.double().mean()) > 0.99
    torch.testing.assert_close(depth[same].double(), exact[same], atol=1e-3, rtol=1e-3)


@pytest.mark.parametrize(("cells", "size"), [(3, 224), (16, 33), (33, 63)])
@pytest.mark.parametrize(("azimuth", "elevation"), [(0.0, 0.0), (45.0, 0.0), (0.0, 30.0)])
def test_a_wall_of_triangles_has_no_cracks(cells, size, azimuth, elevation):
    """Seen from the front, many pixel centres are exactly on a common edge."""
    ticks = torch.linspace(-1, 1, cells + 1)
    y, z = torch.meshgrid(ticks, ticks, indexing="ij")
    vertices = torch.stack([torch.zeros_like(y), y, z], dim=-1).reshape(-1, 3)
    number = torch.arange((cells + 1) ** 2).reshape(cells + 1, cells + 1)
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]
    faces = torch.cat([torch.stack(each, dim=-1).reshape(-1, 3) for each in ((a, b, c), (a, c, d))])
    cameras = camera(azimuth, elevation, size=size)
    hits = first_hits(vertices[faces], cameras.to(torch.float32), 0)
    assert len(hits.point.unique()) == len(hits.point)
    origin, direction = rays(cameras)
    place = origin - origin[:1] / direction[:, :1] * direction
    is_inside = (place[:, 1:].abs() < 1 - 1e-4).all(1)
    is_outside = (place[:, 1:].abs() > 1 + 1e-3).any(1)
    is_hit = torch.zeros(size * size, dtype=torch.bool)
    is_hit[hits.point] = True
    assert bool(is_hit[is_inside].all())
    assert not bool(is_hit[is_outside].any())


@pytest.mark.parametrize("chunk", [50, 1000])
def test_the_borders_of_chunks_change_nothing(chunk, monkeypatch):
    corners, cameras = soup(30, 2), camera()
    expected = first_hits(corners, cameras, 0)
    monkeypatch.setattr(zbuffer, "CHUNK", chunk)
    for name, value in vars(first_hits(corners, cameras, 0)).items():
        assert torch.equal(value, vars(expected)[name])


def test_many_layers_need_no_more_memory_than_one(monkeypatch):
    """Behind each other are 100 walls, of which no more than one chunk is kept."""
    monkeypatch.setattr(zbuffer, "CHUNK", 1000)
    most = []
    nearest = Hits.nearest
    monkeypatch.setattr(Hits, "nearest", lambda hits, n: most.append(len(hits.point)) or nearest(hits, n))
    wall = torch.tensor([[0.0, -9, -9], [0, 9, -9], [0, 0, 9]], dtype=torch.float64)
    shift = torch.linspace(-1, 1, 100, dtype=torch.float64)[:, None, None]
    hits = first_hits(wall + shift * torch.tensor([1.0, 0, 0], dtype=torch.float64), camera(), 0)
    assert bool((hits.face == 99).all())
    assert len(hits.point) == SIZE**2
    assert max(most) <= 3 * SIZE**2 + 1000


@pytest.mark.parametrize("elevation", [0.0, 15.0])
def test_triangles_of_no_area_or_seen_from_the_side_never_come_in_front(elevation):
    wall = torch.tensor([[[0.0, -2, -2], [0, 2, -2], [0, 0, 3]]])
    point, line = torch.full((1, 3, 3), 0.5), torch.tensor([[[0.1, 0, 0], [0.2, 0, 0], [0.3, 0, 0]]])
    side = torch.tensor([[[0.1, 0.0, -1], [0.9, 0.0, -1], [0.5, 0.0, 1]]])
    cameras = camera(0.0, elevation, size=33).to(torch.float32)
    hits = first_hits(torch.cat([wall, point, line, side]), cameras, 0)
    assert bool(hits.weights.isfinite().all())
    assert bool(((hits.weights >= 0) & (hits.weights <= 1)).all())
    assert not bool((hits.face == 1).any())
    assert int((hits.face == 0).sum()) > 0.9 * len(hits.point)
    assert bool((hits.depth > 1.5).all())


def test_nothing_in_view_is_no_hit():
    behind = soup(10, 0) + 100 * camera().positions[0]
    assert len(first_hits(behind, camera(), 0).point) == 0
    assert len(first_hits(behind[:0], camera(), 0).point) == 0


def test_rays_of_embree_hit_the_same_triangles_of_a_sphere():
    pytest.importorskip("embreex")
    from trimesh.ray.ray_pyembree import RayMeshIntersector

    sphere = trimesh.creation.icosphere(subdivisions=4)
    cameras = camera(size=64)
    origin, direction = rays(cameras)
    origins = origin.expand_as(direction).numpy()
    expected = RayMeshIntersector(sphere).intersects_first(origins, direction.numpy())
    _, face = dense(first_hits(torch.tensor(sphere.triangles.copy()), cameras, 0), cameras)
    assert float((face == torch.from_numpy(expected)).double().mean()) > 0.995
    assert int(((face >= 0) != torch.from_numpy(expected >= 0)).sum()) <= 2
