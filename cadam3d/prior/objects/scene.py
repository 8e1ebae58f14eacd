"""Textured meshes as scenes whose images are known."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from cadam3d.core.cameras import Cameras
from cadam3d.core.mesh.textured import TexturedMesh, mixed
from cadam3d.core.rendering import Triangles
from cadam3d.prior.exact import Census, ExactScene
from cadam3d.prior.light import light_on
from cadam3d.prior.objects.zbuffer import Hits, first_hits

# As for procedural shapes: the farthest point of every object is at this distance from the origin.
FIT_RADIUS = 0.85  # world units


@dataclass(frozen=True, eq=False)
class MeshScene(ExactScene):
    """One object, or several of which each is a mode."""

    meshes: Sequence[TexturedMesh]
    world: Callable[[int], Census]  # the census of this size

    @property
    def log_weights(self) -> Float[Tensor, "m"]:
        """Return the logarithms of the modes' weights, which are equal."""
        return torch.full((len(self.meshes),), -math.log(len(self.meshes)), dtype=torch.float64)

    @torch.no_grad()
    def draw(
        self, cameras: Cameras, background: Float[Tensor, "v 3"], samples: int
    ) -> tuple[Float[Tensor, "v m 3 h w"], Float[Tensor, "v m h w"]]:
        """Draw every object."""
        like = cameras.intrinsics
        drawn = torch.stack(
            [_drawn(_moved(mesh, like.device, like.dtype), cameras, samples) for mesh in self.meshes], dim=1
        )
        rgb, alpha = drawn[:, :, :3], drawn[:, :, 3:]
        return rgb + (1 - alpha) * background[:, None, :, None, None], alpha[:, :, 0]

    def surfaces(self) -> list[Triangles]:
        """Return all triangles of each object, also those that cannot be seen."""
        return [(mesh.vertices.double().numpy(), mesh.faces.numpy()) for mesh in self.meshes]

    def census(self, size: int) -> Census:
        """Return the census of the world that the objects are from."""
        return self.world(size)


def read_object(path: str, key: str, up: str) -> TexturedMesh:
    """Return the mesh of a file, upright and as large as every object of the world.

    ``up`` is the up axis of the file. Raises ``UserError``, which names ``key``, if it cannot be read.
    """
    from cadam3d.io.mesh_file import read_mesh  # trimesh is slow to import

    mesh = read_mesh(path, key, up=up)
    used = mesh.vertices[mesh.faces.unique()]  # in float64, since a mesh may be far from the origin
    middle = (used.amin(0) + used.amax(0)) / 2
    radius = (used - middle).norm(dim=1).max()
    return replace(mesh, vertices=((mesh.vertices - middle) * (FIT_RADIUS / radius)).float())


@lru_cache(maxsize=16)
def _moved(mesh: TexturedMesh, device: torch.device, dtype: torch.dtype) -> TexturedMesh:
    return mesh.to(device, dtype)


def _drawn(mesh: TexturedMesh, cameras: Cameras, samples: int) -> Float[Tensor, "v 4 h w"]:
    """Return premultiplied RGB and alpha, with ``samples`` x ``samples`` points per pixel."""
    fine = cameras.resize(cameras.height * samples, cameras.width * samples)
    is_solid = partial(_is_solid, mesh) if mesh.textures.has_holes else None
    images = []
    for view in range(len(cameras)):
        hits = first_hits(mesh.corners, fine, view, is_solid)
        points = mesh.vertices.new_zeros(fine.height * fine.width, 4)
        points[hits.point] = torch.nn.functional.pad(_lit(mesh, fine, view, hits), (0, 1), value=1.0)
        images.append(points.view(cameras.height, samples, cameras.width, samples, 4).mean(dim=(1, 3)))
    return torch.stack(images).clamp_max(1.0).permute(0, 3, 1, 2)


def _is_solid(mesh: TexturedMesh, hits: Hits) -> Bool[Tensor, "n"]:
    return mesh.colors(hits.face, hits.weights)[:, 3] >= 0.5


def _lit(mesh: TexturedMesh, fine: Cameras, view: int, hits: Hits) -> Float[Tensor, "n 3"]:
    """Return the RGB of hits in the light of the world; the side of a face that is seen is its front."""
    corners = mesh.corners.index_select(0, hits.face)
    flat = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat = flat * _side(flat, fine.positions[view] - corners[:, 0])
    corner = 3 * hits.face[:, None] + torch.arange(3, device=hits.face.device)
    normal = mixed(mesh.normals.reshape(-1, 3), corner, hits.weights)
    normal = torch.nn.functional.normalize(normal * _side(normal, flat), dim=1)
    spacing = hits.depth / fine.intrinsics[view, 0, 0]
    color = mesh.colors(hits.face, hits.weights, spacing)[:, :3]
    return color * light_on(normal.T)[:, None]


def _side(one: Float[Tensor, "n 3"], other: Float[Tensor, "n 3"]) -> Float[Tensor, "n 1"]:
    """Return 1 where two vectors point to the same side, and -1 elsewhere."""
    return torch.where((one * other).sum(1, keepdim=True) < 0, -1.0, 1.0)
