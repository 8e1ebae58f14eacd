"""TexturedMesh: triangles with textures, and the colours of their points."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

# The meshes that are read (``io/mesh_file.py``). Other formats may refer to files elsewhere, or run other
# programs.
MESH_SUFFIXES = (".glb", ".gltf", ".obj", ".off", ".ply", ".stl")
# Faces that meet at a smaller angle are shaded as one smooth surface.
CREASE_DEG = 40.0


@dataclass(frozen=True)
class Textures:
    """Pictures in one table of texels, each with all its halved copies, the last of which is one texel."""

    texels: UInt8[Tensor, "texels 4"]  # RGBA, rows from the upper edge
    # First texel, width and height of each level of each picture. Levels beyond the last one repeat it.
    levels: Int[Tensor, "m levels 3"]

    @classmethod
    def of(cls, pictures: Sequence[UInt8[np.ndarray, "_ _ 4"]]) -> "Textures":
        """Return the table of pictures of any sizes."""
        pyramids = [_halved(torch.from_numpy(np.array(picture))) for picture in pictures]
        depth, first, rows = max(map(len, pyramids)), 0, []
        for pyramid in pyramids:
            row = []
            for level in pyramid:
                row.append((first, level.shape[1], level.shape[0]))
                first += level.shape[0] * level.shape[1]
            rows.append(row + row[-1:] * (depth - len(row)))
        texels = torch.cat([level.reshape(-1, 4) for pyramid in pyramids for level in pyramid])
        return cls(texels, torch.tensor(rows))

    def at(
        self, picture: Int[Tensor, "n"], uv: Float[Tensor, "n 2"], level: Int[Tensor, "n"]
    ) -> Float[Tensor, "n 4"]:
        """Return RGBA in [0, 1], interpolated between the four nearest texels of a level.

        ``uv`` has its origin at the lower left, and pictures repeat. A level is clamped to those that exist.
        """
        most = self.levels.shape[1] - 1
        row = picture * (most + 1) + level.clamp(0, most)
        first, width, height = self.levels.reshape(-1, 3).index_select(0, row).unbind(1)
        x = torch.remainder(uv[:, 0], 1) * width - 0.5
        y = torch.remainder(-uv[:, 1], 1) * height - 0.5
        left, upper = x.floor(), y.floor()
        color = torch.zeros(len(uv), 4, dtype=uv.dtype, device=uv.device)
        for right, across in ((0, 1 - (x - left)), (1, x - left)):
            for lower, down in ((0, 1 - (y - upper)), (1, y - upper)):
                column = torch.remainder(left.long() + right, width)
                row = torch.remainder(upper.long() + lower, height)
                texel = self.texels.index_select(0, first + row * width + column)
                color += (across * down)[:, None] * texel
        return color / 255

    @cached_property
    def has_holes(self) -> bool:
        """Return whether a texel is transparent."""
        return bool((self.texels[:, 3] < 128).any())


def _halved(picture: UInt8[Tensor, "h w 4"]) -> list[UInt8[Tensor, "_ _ 4"]]:
    """Return a picture and its copies of half the size, down to one texel."""
    found, level = [picture], picture.permute(2, 0, 1).float()
    while max(level.shape[1:]) > 1:
        size = (max(1, level.shape[1] // 2), max(1, level.shape[2] // 2))
        level = torch.nn.functional.adaptive_avg_pool2d(level, size)
        found.append(level.round().byte().permute(1, 2, 0))
    return found


# Compared by identity, so that what is computed from a mesh can be kept for it.
@dataclass(frozen=True, eq=False)
class TexturedMesh:
    """Triangles in world units, +z up and the front at +x, each with a picture."""

    vertices: Float[Tensor, "n 3"]
    faces: Int[Tensor, "f 3"]
    uv: Float[Tensor, "n 2"]  # origin at the lower left; pictures repeat
    tint: Float[Tensor, "n 3"]  # sRGB in [0, 1], by which the picture is multiplied
    picture: Int[Tensor, "f"]  # of ``textures``
    textures: Textures

    def to(self, device: torch.device, dtype: torch.dtype) -> "TexturedMesh":
        """Return the same mesh on ``device``, with floating-point numbers in ``dtype``."""
        tensors = {name: getattr(self, name) for name in ("vertices", "faces", "uv", "tint", "picture")}
        textures = Textures(self.textures.texels.to(device), self.textures.levels.to(device))
        moved = {
            name: value.to(device, dtype if value.is_floating_point() else value.dtype)
            for name, value in tensors.items()
        }
        return replace(self, **moved, textures=textures)

    @cached_property
    def corners(self) -> Float[Tensor, "f 3 3"]:
        """Return the positions of the corners of every face."""
        return self.vertices[self.faces]

    @cached_property
    def texels_per_area(self) -> Float[Tensor, "f"]:
        """Return the texels of the full picture per square world unit of every face."""
        width, height = self.textures.levels[self.picture, 0, 1:].to(self.uv).unbind(1)
        (a, b), edges = (_edges(self.uv[self.faces]).unbind(1), _edges(self.corners))
        flat = (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).abs() * width * height
        return flat / torch.linalg.cross(edges[:, 0], edges[:, 1]).norm(dim=1).clamp_min(1e-20)

    def colors(
        self, face: Int[Tensor, "n"], weights: Float[Tensor, "n 3"], spacing: Float[Tensor, "n"] | float = 0.0
    ) -> Float[Tensor, "n 4"]:
        """Return RGBA in [0, 1] at points of faces, given by their barycentric weights.

        ``spacing`` is the distance between neighbouring points in world units. The level of the picture is
        the one whose texels are about as large.
        """
        rows = self.faces.index_select(0, face)
        uv = mixed(self.uv, rows, weights)
        texels = self.texels_per_area.index_select(0, face) * spacing**2
        level = (0.5 * texels.clamp_min(1).log2()).round().long()
        color = self.textures.at(self.picture.index_select(0, face), uv, level)
        color[:, :3] *= mixed(self.tint, rows, weights)
        return color

    @cached_property
    def normals(self) -> Float[Tensor, "f 3 3"]:
        """Return unit normals at the corners of every face, smooth except at creases.

        The normals that a file may have are not used, since programs write different ones.
        """
        import trimesh
        from trimesh.graph import connected_component_labels

        device, vertices, faces = self.faces.device, self.vertices.cpu().double(), self.faces.cpu().numpy()
        merged = trimesh.Trimesh(vertices.numpy(), faces, process=False)
        merged.merge_vertices()
        is_smooth = merged.face_adjacency_angles < np.radians(CREASE_DEG)
        group = connected_component_labels(merged.face_adjacency[is_smooth], node_count=len(faces))
        # The number of a place and a group; each has one normal, to which large faces contribute more.
        corner = merged.faces.astype(np.int64) * (int(group.max()) + 1) + group[:, None]
        _, place = np.unique(corner, return_inverse=True)
        edges = _edges(vertices[self.faces.cpu()])
        wide = torch.linalg.cross(edges[:, 0], edges[:, 1])
        total = torch.zeros(int(place.max()) + 1, 3, dtype=torch.float64)
        total.index_add_(0, torch.from_numpy(place.reshape(-1)), wide.repeat_interleave(3, dim=0))
        normal = torch.nn.functional.normalize(total, dim=1)[torch.from_numpy(place.reshape(-1, 3))]
        return normal.to(device, self.vertices.dtype)


def mixed(
    values: Float[Tensor, "m c"], rows: Int[Tensor, "n 3"], weights: Float[Tensor, "n 3"]
) -> Float[Tensor, "n c"]:
    """Return weighted sums of three rows of ``values``."""
    # On a CPU, index_select is several times as fast as indexing.
    a, b, c = (
        values.index_select(0, each) * weight[:, None] for each, weight in zip(rows.T, weights.T, strict=True)
    )
    return a + b + c


def _edges(corners: Float[Tensor, "f 3 d"]) -> Float[Tensor, "f 2 d"]:
    return corners[:, 1:] - corners[:, :1]
