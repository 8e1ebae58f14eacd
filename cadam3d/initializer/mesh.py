"""Mesh: Gaussians on the surface of a mesh file, with its colours."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import trimesh
from jaxtyping import Float, Int
from torch import Tensor
from trimesh.resolvers import FilePathResolver

from cadam3d.core.checks import Color, one_of
from cadam3d.core.console import say
from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.initializer.points import (
    FromObject,
    PointCloud,
    Rows,
    found_file,
    one_color,
    points_on_surface,
)
from cadam3d.io.frames import points_to_world, turned_points
from cadam3d.io.gltf import linear, srgb
from cadam3d.io.reading import read_bytes

UPS = ("z", "y")
# Other formats of trimesh may refer to files elsewhere, or run other programs.
SUFFIXES = (".glb", ".gltf", ".obj", ".off", ".ply", ".stl")
# Vertex colours are linear in these files, and textures are sRGB (glTF 2.0, sec. 3.9.2). Other
# formats have sRGB colours only.
LINEAR_SUFFIXES = (".glb", ".gltf")
LARGEST_FILE = 1 << 30  # bytes of a material, a buffer or a picture that a mesh names
# Linear colours of vertices, among the attributes of a part.
VERTEX_LIGHT = "vertex light"


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
        parts = self._load()
        corners = np.concatenate([np.asarray(part.vertices)[np.asarray(part.faces)] for part in parts])
        points = torch.as_tensor(corners, dtype=torch.float32).flatten(end_dim=1)
        upright = turned_points(points_to_world(points, f"+{self.up}"), self.turn_deg)
        corners = self.placed(upright)[0].view(-1, 3, 3)
        faces, weights = points_on_surface(corners, self.count, generator)
        points = (weights[..., None] * corners[faces]).sum(dim=1)
        return self.gaussians_at(PointCloud(points, self._colors(parts, faces, weights)), device)

    def _load(self) -> list[trimesh.Trimesh]:
        """Return the surfaces of the file, each at its place in the scene and with its own colours."""
        path = found_file(self.path)
        nearby = _NearbyFiles(str(path))
        # Every format has its own parser, with its own exceptions.
        try:
            scene = trimesh.load_scene(path, resolver=nearby)
            if path.suffix.lower() in LINEAR_SUFFIXES:
                for geometry in scene.geometry.values():
                    _keep_vertex_light(geometry)
            parts = [part for part in scene.dump() if isinstance(part, trimesh.Trimesh)]
        except Exception as error:
            raise UserError(
                f"initializer.path: expected a file with a mesh ({', '.join(SUFFIXES)}), got {self.path!r}, "
                f"which cannot be read ({str(error) or type(error).__name__})."
            ) from error
        visuals: list[Any] = [part.visual for part in parts]
        is_lost = any(each.kind == "texture" and not _has_picture(each) for each in visuals)
        if is_lost and not all(name.lower().endswith(".mtl") for name in nearby.asked):
            reason = "has no texture that can be read, so it has the colours of its materials"
            say(f"Note: {path.name} {reason}", logging.WARNING)
        is_finite = all(np.isfinite(part.vertices).all() for part in parts)
        if not is_finite or sum(float(part.area) for part in parts) <= 0:
            raise UserError(
                f"initializer.path: expected a mesh with triangles, got {self.path!r}, which has no surface. "
                "Try: initializer=ply, if it holds points"
            )
        return parts

    def _colors(
        self, parts: Sequence[trimesh.Trimesh], faces: Int[Tensor, "n"], weights: Float[Tensor, "n 3"]
    ) -> Float[Tensor, "n 3"]:
        """Return RGB of the sampled points, in [0, 1]; ``faces`` are numbered through all parts."""
        rgb = one_color(self.color, len(faces))
        first = 0
        for part in parts:
            is_here = (faces >= first) & (faces < first + len(part.faces))
            colors = _colors_of(part, (faces[is_here] - first).numpy(), weights[is_here].numpy()[..., None])
            if colors is not None:
                rgb[is_here] = torch.as_tensor(colors[:, :3] / 255.0, dtype=torch.float32)
            first += len(part.faces)
        return rgb


class _NearbyFiles(FilePathResolver):
    """Reads the files that a mesh names, if they are regular files in its folder, and remembers the names."""

    def __init__(self, source: str) -> None:
        super().__init__(source)
        self.asked: list[str] = []

    def get(self, name: str) -> bytes:
        """Return the content of the file ``name``. Raises ``UserError`` if it cannot be read."""
        self.asked.append(name)
        return read_bytes(self.absolute(name), largest=LARGEST_FILE)

    def namespaced(self, namespace: str) -> "_NearbyFiles":
        return _NearbyFiles(str(Path(self.parent, namespace)))


def _has_picture(visual: Any) -> bool:
    """Return whether a texture without vertex colours has a picture that can be decoded."""
    picture = getattr(visual.material, "image", None) or getattr(visual.material, "baseColorTexture", None)
    try:
        return picture is not None and picture.load() is not None
    except (OSError, ValueError, SyntaxError):  # what Pillow raises for a damaged picture
        return False


def _keep_vertex_light(geometry: Any) -> None:
    """Store the vertex colours of a mesh from a glTF file where a copy of the mesh keeps them.

    trimesh drops the vertex colours of a mesh with a material when it copies the mesh.
    """
    if not isinstance(geometry, trimesh.Trimesh):
        return
    visual: Any = geometry.visual
    colors = visual.vertex_colors if visual.kind == "vertex" else None
    if visual.kind == "texture":
        colors = visual.vertex_attributes.get("color")
    if colors is None or len(colors) != len(geometry.vertices):
        return
    most = np.iinfo(colors.dtype).max if colors.dtype.kind in "ui" else 1.0
    light = np.asarray(colors, dtype=np.float64)[:, :3] / most
    geometry.vertex_attributes[VERTEX_LIGHT] = light.clip(0, 1)


def _colors_of(part: trimesh.Trimesh, faces: np.ndarray, barycentric: np.ndarray) -> np.ndarray | None:
    """Return RGB at points of ``faces``, 0 to 255, or None if the part has no colours."""
    visual: Any = part.visual
    rows = np.asarray(part.faces)[faces]
    light = part.vertex_attributes.get(VERTEX_LIGHT)
    if light is not None:
        # The material's colour multiplies the vertex colours.
        at_points = (barycentric * light[rows]).sum(axis=1)
        if visual.kind == "texture":
            at_points = at_points * _material_light(visual, rows, barycentric)
        return 255 * srgb(at_points)
    if visual.kind == "vertex":
        return (barycentric * visual.vertex_colors[rows]).sum(axis=1)
    if visual.kind == "face":
        return visual.face_colors[faces]
    if visual.kind == "texture" and visual.uv is not None and _has_picture(visual):
        return np.asarray(visual.material.to_color((barycentric * visual.uv[rows]).sum(axis=1)))
    if visual.kind == "texture":
        return np.tile(visual.material.main_color, (len(faces), 1))
    return None


def _material_light(visual: Any, rows: np.ndarray, barycentric: np.ndarray) -> np.ndarray:
    """Return the linear RGB by which a material of a glTF file multiplies other colours, in [0, 1]."""
    factor, picture = visual.material.baseColorFactor, visual.material.baseColorTexture
    light = np.ones(3) if factor is None else np.asarray(factor)[:3] / 255
    if picture is None or visual.uv is None:
        return light
    found = np.asarray(visual.material.to_color((barycentric * visual.uv[rows]).sum(axis=1)))
    return light * linear(found[:, :3] / 255)
