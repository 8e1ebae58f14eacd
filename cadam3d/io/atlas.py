"""Atlas: unwraps a surface onto a picture with xatlas, and paints the picture texel by texel."""

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from cadam3d.core.mesh.surface import Surface
from cadam3d.io.mesh import Texture

# From points of a surface and its normals there to sRGB colours in [0, 1].
ColorFn = Callable[[Float[np.ndarray, "p 3"], Float[np.ndarray, "p 3"]], Float[np.ndarray, "p 3"]]

# Texels between charts, the pieces that the surface is cut into.
PADDING = 4
# Texels at most this far from a triangle belong to it too. Interpolation between texels reads those that are
# less than one row and one column away.
REACH = 1.5
# Texels that are tested or painted at once; this bounds the memory.
AT_ONCE = 1 << 20


def paint(surface: Surface, colors: ColorFn, size: int) -> Texture:
    """Return a texture of ``size`` x ``size`` pixels, in which ``colors`` gives the colour of each texel."""
    from scipy import ndimage  # slow to import

    vertices, faces, uv = _unwrapped(surface, size)
    texel, face, weights = nearest_points(uv[faces] * size, size)
    picture = np.zeros((size * size, 3), dtype=np.uint8)
    is_painted = np.zeros(size * size, dtype=bool)
    is_painted[texel] = True
    for first in range(0, len(texel), AT_ONCE):
        some = slice(first, first + AT_ONCE)
        corners = vertices[faces[face[some]]]
        points = (weights[some, :, None] * surface.vertices[corners]).sum(1)
        normals = (weights[some, :, None] * surface.normals[corners]).sum(1)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        picture[texel[some]] = np.rint(colors(points, normals) * 255).astype(np.uint8)
    # Every other texel gets the colour of the nearest painted one.
    nearest: Any = ndimage.distance_transform_edt(
        ~is_painted.reshape(size, size), return_distances=False, return_indices=True
    )
    filled = picture.reshape(size, size, 3)[tuple(nearest)]
    # The rows of the picture begin at the upper edge, v at the lower one.
    return Texture(vertices, faces, uv, np.ascontiguousarray(filled[::-1]))


def _unwrapped(
    surface: Surface, size: int
) -> tuple[Int[np.ndarray, "w"], Int[np.ndarray, "f 3"], Float[np.ndarray, "w 2"]]:
    """Return the vertices, repeated where charts are cut, the triangles, and the places in [0, 1]."""
    import xatlas  # optional, and slow to import

    atlas = xatlas.Atlas()
    atlas.add_mesh(
        surface.vertices.astype(np.float32),
        surface.faces.astype(np.uint32),
        surface.normals.astype(np.float32),
    )
    charts, packing = xatlas.ChartOptions(), xatlas.PackOptions()
    # xatlas chooses the number of texels per world unit such that all charts fit into one picture of this
    # size.
    packing.resolution, packing.padding, packing.bilinear = size, PADDING, True
    atlas.generate(charts, packing)
    vertices, faces, uv = atlas[0]
    # The packing may be larger than asked for, and is then scaled down.
    scale = np.array([atlas.width, atlas.height]) / max(atlas.width, atlas.height)
    return vertices.astype(np.int64), faces.astype(np.int64), uv.astype(np.float64) * scale


def nearest_points(
    corners: Float[np.ndarray, "f 3 2"], size: int
) -> tuple[Int[np.ndarray, "t"], Int[np.ndarray, "t"], Float[np.ndarray, "t 3"]]:
    """Return the texels near any triangle, the nearest triangle of each, and the weights of its corners.

    ``corners`` are in texels. The weights make the point of the triangle that is nearest to the texel's
    centre. So a triangle without the centre of a texel has texels too, unless other triangles are nearer.
    """
    low = np.clip(np.floor(corners.min(1) - 0.5 - REACH), 0, size - 1).astype(np.int64)
    high = np.clip(np.ceil(corners.max(1) - 0.5 + REACH), 0, size - 1).astype(np.int64)
    wide = high - low + 1
    counts = wide[:, 0] * wide[:, 1]
    ends = counts.cumsum()
    found = []
    cuts = np.searchsorted(ends, np.arange(0, ends[-1], AT_ONCE), side="right")
    for some in np.split(np.arange(len(corners)), cuts[1:]):
        face = np.repeat(some, counts[some])
        step = np.arange(len(face)) - np.repeat(counts[some].cumsum() - counts[some], counts[some])
        column, row = low[face, 0] + step % wide[face, 0], low[face, 1] + step // wide[face, 0]
        weights, distance = _nearest(corners[face], np.stack([column, row], axis=1) + 0.5)
        kept = distance <= REACH
        found.append((row[kept] * size + column[kept], face[kept], weights[kept], distance[kept]))
    texel, face, weights, distance = (np.concatenate(values) for values in zip(*found, strict=True))
    order = np.lexsort([distance, texel])
    texel, first = np.unique(texel[order], return_index=True)
    return texel, face[order[first]], weights[order[first]]


def _nearest(
    corners: Float[np.ndarray, "t 3 2"], points: Float[np.ndarray, "t 2"]
) -> tuple[Float[np.ndarray, "t 3"], Float[np.ndarray, "t"]]:
    """Return the weights of the corners at the place of each triangle that is nearest to its point.

    The second array has the distances, 0 inside a triangle.
    """
    from trimesh.triangles import closest_point, points_to_barycentric  # slow to import

    flat = np.pad(corners, ((0, 0), (0, 0), (0, 1)))
    with np.errstate(divide="ignore", invalid="ignore"):
        places = closest_point(flat, np.pad(points, ((0, 0), (0, 1))))
        weights = points_to_barycentric(flat, places)
    # A triangle without an area has no such weights; its first corner counts.
    is_flat = ~np.isfinite(weights).all(1)
    weights[is_flat], places[is_flat, :2] = (1, 0, 0), corners[is_flat, 0]
    weights = np.clip(weights, 0, 1)
    return weights / weights.sum(1, keepdims=True), np.linalg.norm(points - places[:, :2], axis=1)
