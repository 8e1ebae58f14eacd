"""Mesh: Gaussians on the surface of a mesh file, with its colours."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import trimesh
from jaxtyping import Float, Int
from torch import Tensor

from cadam3d.core.checks import UserError, require_choice, require_color
from cadam3d.core.gaussians import Gaussians
from cadam3d.initializer.base import Initializer
from cadam3d.initializer.points import (
    PointCloud,
    fit,
    found_file,
    gaussians_at,
    points_on_surface,
    require_place,
    require_points,
)
from cadam3d.io.frames import points_to_world, turned_points

UPS = ("z", "y")


@dataclass(frozen=True, kw_only=True)
class Mesh(Initializer):
    """``count`` Gaussians at uniformly random points of a surface; the prompt plays no part.

    Reads whatever trimesh reads (PLY, OBJ, STL, GLB, OFF, ...), with vertex, face or texture colours. It is
    moved and scaled so that its bounding box is centred at the origin, its farthest point at ``radius``.
    """

    path: str  # of the file
    up: str  # which axis of the file points up: "z", or "y" (glTF and most OBJ files, whose front is then +z)
    turn_deg: int  # then turned about the up axis, counterclockwise from above: 0, 90, 180 or 270
    radius: float | None  # world units, at most 1: the object fits in the unit ball; null = as it is
    count: int
    scale: (
        float | None
    )  # standard deviation in world units; null = mean distance to the three nearest neighbours
    opacity: float  # in (0, 1)
    sh_degree: int  # of the colours, 0 to 3
    color: Sequence[float]  # RGB in [0, 1], where the file has no colours

    def __post_init__(self) -> None:
        require_points(self.count, self.scale, self.opacity, self.sh_degree)
        require_choice("initializer.up", self.up, UPS)
        require_place(self.turn_deg, self.radius)
        require_color("initializer.color", self.color)

    def build(self, prompt: str, generator: torch.Generator, device: torch.device) -> Gaussians:
        """Gaussians with equal density everywhere on the surface.

        Raises ``UserError`` if the file is missing, cannot be read or holds no surface.
        """
        mesh = self._load()
        corners = self._place(torch.as_tensor(np.asarray(mesh.vertices), dtype=torch.float32))
        corners = corners[torch.as_tensor(np.asarray(mesh.faces), dtype=torch.int64)]
        faces, weights = points_on_surface(corners, self.count, generator)
        points = (weights[..., None] * corners[faces]).sum(dim=1)
        cloud = PointCloud(points.to(device), self._colors(mesh, faces, weights).to(device))
        return gaussians_at(cloud, scale=self.scale, opacity=self.opacity, sh_degree=self.sh_degree)

    def _load(self) -> trimesh.Trimesh:
        path = found_file(self.path, "/path/to/mesh.glb")
        try:
            mesh = trimesh.load_mesh(path)
        except Exception as error:  # every format has its own parser, with its own exceptions
            reason = str(error) or type(error).__name__
            raise UserError(
                f"initializer.path: {self.path!r} cannot be read ({reason}). Try: a PLY, OBJ, STL or GLB file"
            ) from error
        if len(mesh.faces) == 0 or not np.isfinite(mesh.vertices).all() or mesh.area <= 0:
            raise UserError(
                f"initializer.path: {self.path!r} holds no surface ({len(mesh.vertices)} vertices, "
                f"{len(mesh.faces)} faces). Try: a file with triangles"
            )
        return mesh

    def _place(self, vertices: Float[Tensor, "m 3"]) -> Float[Tensor, "m 3"]:
        """World positions of the file's vertices."""
        upright = turned_points(points_to_world(vertices, f"+{self.up}"), self.turn_deg)
        center, factor = fit(upright, self.radius)
        return (upright - center) * factor

    def _colors(
        self, mesh: trimesh.Trimesh, faces: Int[Tensor, "n"], weights: Float[Tensor, "n 3"]
    ) -> Float[Tensor, "n 3"]:
        """RGB of the sampled points, in [0, 1]."""
        rows = np.asarray(mesh.faces)[faces.numpy()]
        barycentric = weights.numpy()[..., None]
        visual: Any = mesh.visual
        if visual.kind == "vertex":
            rgba = (barycentric * visual.vertex_colors[rows]).sum(axis=1)
        elif visual.kind == "face":
            rgba = visual.face_colors[faces.numpy()]
        elif visual.kind == "texture" and visual.uv is not None:
            rgba = visual.material.to_color((barycentric * visual.uv[rows]).sum(axis=1))
        else:
            return torch.tensor([float(channel) for channel in self.color]).repeat(len(rows), 1)
        return torch.as_tensor(np.asarray(rgba)[:, :3] / 255.0, dtype=torch.float32)
