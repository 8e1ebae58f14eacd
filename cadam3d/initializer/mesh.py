"""Mesh: Gaussians on the surface of a mesh file, with its colours."""

from dataclasses import dataclass
from typing import Annotated

import torch

from cadam3d.core.checks import Color, one_of
from cadam3d.core.gaussians import Gaussians
from cadam3d.initializer.points import FromObject, PointCloud, Rows, points_on_surface
from cadam3d.io.frames import turned_points
from cadam3d.io.mesh_file import read_mesh

UPS = ("z", "y")


@dataclass(frozen=True, kw_only=True)
class Mesh(FromObject):
    """``count`` Gaussians at uniformly random points of a surface; the prompt is not used.

    Reads PLY, OBJ, STL, GLB, glTF and OFF files, with vertex, face or texture colours.
    """

    path: str
    up: Annotated[str, one_of(UPS)]
    count: Rows
    color: Color

    def build(self, prompt: str, generator: torch.Generator, device: torch.device) -> Gaussians:
        """Return Gaussians on ``device`` that cover the surface with equal density.

        Raises ``UserError`` if the file is missing, cannot be read or has no surface.
        """
        mesh = read_mesh(self.path, "initializer.path", up=f"+{self.up}", plain=self.color)
        corners = turned_points(mesh.corners.float().flatten(end_dim=1), self.turn_deg)
        corners = self.placed(corners)[0].view(-1, 3, 3)
        faces, weights = points_on_surface(corners, self.count, generator)
        points = (weights[..., None] * corners[faces]).sum(dim=1)
        rgb = mesh.colors(faces, weights)[:, :3]
        return self.gaussians_at(PointCloud(points, rgb), device)
