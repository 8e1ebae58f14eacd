"""Textures of surfaces: what a program reads between texels is the colour of the surface there."""

import numpy as np
import pytest
import trimesh
from scipy.ndimage import map_coordinates

from cadam3d.core.mesh.surface import Surface
from cadam3d.io.atlas import nearest_points, paint

STRIPES = 3.0


def colors(points, normals):
    """Return colours that change over the whole surface, and differ most on opposite sides."""
    return 0.5 + 0.5 * np.sin(STRIPES * points)


@pytest.fixture(scope="module")
def ball():
    """Return a ball with a fine side, whose triangles are smaller than a texel."""
    mesh = trimesh.creation.icosphere(subdivisions=3)
    mesh = mesh.subdivide(np.flatnonzero(mesh.triangles_center[:, 2] > 0.7))
    mesh = mesh.subdivide(np.flatnonzero(mesh.triangles_center[:, 2] > 0.9))
    vertices = np.asarray(mesh.vertices)
    vertices = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    return Surface(vertices, np.asarray(mesh.faces), vertices, colors(vertices, vertices))


def seen(texture, weights):
    """Return the colours that bilinear filtering gives at points of every triangle."""
    size = len(texture.picture)
    u, v = (weights @ texture.uv[texture.faces]).reshape(-1, 2).T
    # Texel centres are at half numbers, and rows begin at the upper edge.
    places = [(1 - v) * size - 0.5, u * size - 0.5]
    picture = texture.picture.astype(np.float64) / 255
    bands = [map_coordinates(picture[..., band], places, order=1, mode="nearest") for band in range(3)]
    return np.stack(bands, axis=1)


@pytest.mark.parametrize("size", [64, 256])
def test_every_triangle_has_its_own_colours_up_to_its_edges(ball, size):
    pytest.importorskip("xatlas")
    texture = paint(ball, colors, size)
    weights = np.concatenate([np.eye(3), 0.5 - 0.5 * np.eye(3), np.full((1, 3), 1 / 3)])
    points = (weights @ ball.vertices[texture.vertices[texture.faces]]).reshape(-1, 3)
    error = np.abs(seen(texture, weights) - colors(points, points)).max(axis=1)
    assert error.max() < 3 / size
    assert error.mean() < 0.4 / size


def test_texels_belong_to_the_nearest_triangle():
    corners = np.array([[[2.0, 2.0], [6.0, 2.0], [2.0, 6.0]], [[9.1, 9.1], [9.3, 9.1], [9.1, 9.3]]])
    texel, face, weights = nearest_points(corners, 12)
    assert len(np.unique(texel)) == len(texel)
    where = dict(zip(texel.tolist(), zip(face.tolist(), weights.tolist(), strict=True), strict=True))
    np.testing.assert_allclose(where[3 * 12 + 3][1], [0.25, 0.375, 0.375])  # its centre is at (3.5, 3.5)
    np.testing.assert_allclose(where[1 * 12 + 3][1], [0.625, 0.375, 0.0])  # below an edge
    assert where[9 * 12 + 9][0] == 1  # without the centre of any texel
    assert 6 * 12 + 6 not in where  # too far from both
    np.testing.assert_allclose(weights.sum(1), 1)
    assert weights.min() >= 0
