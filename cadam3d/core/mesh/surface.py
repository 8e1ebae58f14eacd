"""Surface: a closed triangle mesh around Gaussians, coloured like their renders.

The surface is where the density (``density.py``) has a given level, found by marching cubes (Lorensen and
Cline 1987, in the variant of Lewiner et al. 2003). Only the outer shell is kept: whatever cannot be reached
from outside is filled before the cubes are marched. Small separate parts are removed, and the rest is
simplified with quadric errors (Garland and Heckbert 1997) as far as it stays watertight.

Fuzzy Gaussians have no surface at a level: what is there has bumps, cracks, and shells behind the cracks.
Such a shell is closed and smoothed. Its *roughness* tells it from others: the share of its area that
smoothing removes.
"""

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from cadam3d.core.checks import BelowOne, Declared, fail, whole, within
from cadam3d.core.console import followed
from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.mesh.density import BLUR, CUTOFF, Blobs, Lattice, blobs, density, grid_around, near
from cadam3d.core.sh import evaluate_sh

# The extent of the object is found on coarse grids, blurred by a whole cell, so that nothing is missed
# between nodes.
EXTENT_RESOLUTION = 48
EXTENT_BLUR = 1.0  # cells
EXTENT_LEVEL = 0.5  # share of the level that a node next to the surface has at least
# A box that becomes smaller than this share of the one before may become still smaller.
SHRINKS = 0.75
EXTENT_PASSES = 40
# The surface is judged, and a rough one is smoothed, on a grid with at most this many cells along its longest
# side. Of the assets that we trained on the exact prior, a robot has the largest roughness, 0.20; the four
# that we trained on a small network have 0.27 to 0.34.
JUDGED = 128  # cells
ROUGH = 0.25
# Thin wires and sheets are not rough, although smoothing removes their area. They lose their inside with it.
KEPT = 0.85  # share of the inside that smoothing keeps at least if the surface is rough
CLOSED = 3 / JUDGED  # share of the longest side: half the width of cracks that close
SMOOTHED = 1.5 / JUDGED  # share of the longest side, standard deviation
# Heights closer to zero are moved away from it.
LEAST_HEIGHT = 1e-3
# A simplification that is not watertight is repeated with these settings, and then with more triangles.
AGGRESSIVENESS = (7.0, 5.0, 4.0, 8.0)
MORE_TRIANGLES = 1.3
# Copies of a vertex move towards the triangles around them by this share of the way.
APART = 0.02
# The opacity of a single Gaussian in the colour of a point, at most, as in the rasterizers.
MOST_OPAQUE = 0.99
COLORS_AT_ONCE = 1 << 18
# Gaussians with less opacity on a ray are left out; all of them together change its colour by less than
# 1/255.
UNSEEN = 1e-4
# Light from all Gaussians together below which a point has no colour of its own.
FAINT = 1e-6


@dataclass(frozen=True)
class Surface:
    """A triangle mesh in world axes, counterclockwise seen from outside."""

    vertices: Float[np.ndarray, "v 3"]  # world units
    faces: Int[np.ndarray, "f 3"]
    normals: Float[np.ndarray, "v 3"]  # of unit length, outwards
    colors: Float[np.ndarray, "v 3"]  # sRGB in [0, 1]
    roughness: float = 0.0  # share of the area that smoothing removes
    is_smoothed: bool = False  # whether it was removed


@dataclass(frozen=True, kw_only=True)
class SurfaceSettings(Declared):
    """Settings of the surface of an asset, which exporters and metrics of meshes inherit."""

    # Node of the configuration, such as "exporter.mesh", with which error messages begin.
    node: ClassVar[str]

    resolution: Annotated[int, whole(low=16, high=1024)]  # cells along the longest side
    level: Annotated[float, within(above=0, high=1000)]  # density at the surface
    smallest_part: BelowOne  # share of the whole area
    triangles: Annotated[int, whole(low=100, high=2**31)] | None  # None = no simplification

    def most_triangles(self) -> int | None:
        """Return the most triangles that the surface may have, or None for no limit."""
        return self.triangles

    def surface(self, gaussians: Gaussians) -> tuple[Surface, "Painter"]:
        """Return the outer surface of ``gaussians``, and what knows the colours between its vertices.

        Raises ``UserError`` if the density does not reach the level anywhere.
        """
        some = blobs(gaussians)
        extent = self._extent(some)
        grid = grid_around(*extent, min(self.resolution, JUDGED))
        height = density(some, grid) / self.level - 1
        vertices, faces = self._shell(height)
        if len(faces) == 0:
            raise self._nothing(some)
        rounded = smoothed(height)
        smooth = self._shell(rounded)
        roughness = 1 - float(areas(*smooth).sum() / areas(vertices, faces).sum())
        is_smoothed = roughness > ROUGH and float((rounded[height > 0] > 0).float().mean()) > KEPT
        if is_smoothed:
            vertices, faces = smooth
        elif self.resolution > JUDGED:
            grid = grid_around(*extent, self.resolution)
            vertices, faces = self._shell(density(some, grid) / self.level - 1)
        vertices = vertices * grid.cell + grid.origin.numpy()
        triangles = self.most_triangles()
        if triangles is not None:
            vertices, faces = simplified(vertices, faces, triangles)
        normals = vertex_normals(vertices, faces)
        painter = Painter(gaussians.sh.detach().to("cpu").float()[some.rows], some, grid)
        colors = painter.colors(vertices, normals)
        return Surface(vertices, faces, normals, colors, roughness, is_smoothed), painter

    def _shell(self, height: Float[Tensor, "x y z"]) -> tuple[np.ndarray, np.ndarray]:
        """Return the outer shell without specks, in units of nodes."""
        return without_specks(*outer_shell(height), self.smallest_part)

    def _extent(self, some: Blobs) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
        """Return the corners of a box around everything except specks.

        The first box holds all Gaussians. Far away or huge faint ones can make it much larger than the
        object, so it shrinks to what is dense in it, until it hardly changes.
        """
        if len(some.rows) == 0:
            raise self._nothing(some)
        reach = some.reach()
        low, high = (some.means - reach).amin(0), (some.means + reach).amax(0)
        for _ in range(EXTENT_PASSES):
            grid = grid_around(low, high, EXTENT_RESOLUTION)
            is_dense = density(some, grid, EXTENT_BLUR) >= EXTENT_LEVEL * self.level
            node = _large_regions(is_dense.numpy(), some, grid, self.smallest_part)
            if len(node) == 0:
                raise self._nothing(some)
            old = float((high - low).max())
            first, last = torch.from_numpy(node.min(0) - 1.0), torch.from_numpy(node.max(0) + 1.0)
            low = torch.maximum(low, grid.origin + grid.cell * first)
            high = torch.minimum(high, grid.origin + grid.cell * last)
            if float((high - low).max()) > SHRINKS * old:
                break
        return low, high

    def _nothing(self, some: Blobs) -> UserError:
        """Return the error for an asset without a surface."""
        most = float(some.opacities.max()) if len(some.rows) else 0.0
        expected = f"a density that the asset reaches; its most opaque Gaussian has {most:.2g}"
        return fail(f"{self.node}.level", expected=expected, got=self.level)


def _large_regions(
    is_dense: Bool[np.ndarray, "x y z"], some: Blobs, grid: Lattice, smallest: float
) -> Int[np.ndarray, "k 3"]:
    """Return the nodes of all connected regions except specks.

    The sizes of regions are compared by the area of the Gaussians whose centres are in them, because a region
    that is only a few cells large has no other measure.
    """
    labels, count = _labelled(is_dense)
    if count <= 1:
        return np.argwhere(is_dense)
    node = ((some.means - grid.origin) / grid.cell).round()
    is_inside = ((node >= 0) & (node < torch.tensor(grid.nodes))).all(1)
    x, y, z = node[is_inside].long().numpy().T
    area = np.bincount(labels[x, y, z], weights=some.area()[is_inside].numpy(), minlength=count + 1)[1:]
    # The area of Gaussians is a rough measure, so a region that may be large enough is kept.
    is_kept = area >= min(smallest / 4 * area.sum(), area.max())
    return np.argwhere(np.concatenate([[False], is_kept])[labels])


def outer_shell(
    height: Float[Tensor, "x y z"],
) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """Return the closed surface, in units of nodes, between inside (``height`` > 0) and outside (< 0).

    Nodes on the border of the grid count as outside. Hollows without a way out are filled. There are no
    triangles if nothing is inside.
    """
    from skimage.measure import marching_cubes  # slow to import

    values = height.numpy().astype(np.float32)
    for axis in range(3):
        border = np.moveaxis(values, axis, 0)
        border[0] = border[-1] = np.minimum(border[[0, -1]], -LEAST_HEIGHT).min()
    is_empty = values < 0
    labels, _ = _labelled(is_empty)
    values[is_empty & (labels != labels[0, 0, 0])] = 1.0
    # A node exactly on the surface would collapse the triangles around it to a point.
    values[np.abs(values) < LEAST_HEIGHT] = LEAST_HEIGHT
    if values.max() < 0:
        return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)
    vertices, faces, _, _ = marching_cubes(values, 0.0, allow_degenerate=False)
    # scikit-image returns triangles clockwise seen from outside.
    return vertices.astype(np.float64), faces[:, ::-1].astype(np.int64)


def smoothed(height: Float[Tensor, "x y z"]) -> Float[Tensor, "x y z"]:
    """Return a height for the same inside, which is not empty, but without bumps, cracks and hollows.

    What no ball fits into without touching the inside is filled (a closing), and the edge of the result is
    blurred.
    """
    from scipy import ndimage  # slow to import

    side = max(height.shape) - 1
    reach = CLOSED * side
    margin = int(reach) + 2
    inside = np.pad(height.numpy() > 0, margin)
    to_inside: Any = ndimage.distance_transform_edt(~inside)
    to_outside: Any = ndimage.distance_transform_edt(to_inside <= reach)
    filled: Any = ndimage.binary_fill_holes(inside | (to_outside > reach))
    blurred = ndimage.gaussian_filter(filled.astype(np.float32), SMOOTHED * side)
    return torch.from_numpy(blurred[margin:-margin, margin:-margin, margin:-margin] - 0.5)


def _labelled(mask: Bool[np.ndarray, "x y z"]) -> tuple[Int[np.ndarray, "x y z"], int]:
    """Return the number of the region of each node, 0 where the mask is False, and the number of regions."""
    from scipy import ndimage  # slow to import

    result: Any = ndimage.label(mask)
    return result


def without_specks(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], smallest: float
) -> tuple[Float[np.ndarray, "w 3"], Int[np.ndarray, "g 3"]]:
    """Return the mesh without parts of less than ``smallest`` of the whole area; the largest part stays."""
    if len(faces) == 0:
        return vertices, faces
    part = parts_of(len(vertices), faces)[faces[:, 0]]
    area = np.bincount(part, weights=areas(vertices, faces))
    is_kept = area >= min(smallest * area.sum(), area.max())
    return compacted(vertices, faces[is_kept[part]])


def simplified(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], triangles: int
) -> tuple[Float[np.ndarray, "w 3"], Int[np.ndarray, "g 3"]]:
    """Return a watertight mesh with at most ``triangles`` triangles, or with as few more as stay watertight.

    A mesh with fewer triangles is returned unchanged.
    """
    import fast_simplification  # slow to import

    target = float(triangles)
    while target < len(faces):
        # The order in which edges collapse depends on the aggressiveness, and so does whether a hole appears.
        for aggressiveness in followed(AGGRESSIVENESS, f"surface: {len(faces):,} to {target:,.0f} triangles"):
            points, corners, *_ = fast_simplification.simplify(
                vertices, faces.astype(np.int32), target_count=int(target), agg=aggressiveness
            )
            points, corners = separated(
                np.asarray(points, dtype=np.float64), np.asarray(corners, dtype=np.int64)
            )
            if len(corners) and is_watertight(corners):
                return points, corners
        target *= MORE_TRIANGLES
    return vertices, faces


def separated(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> tuple[Float[np.ndarray, "w 3"], Int[np.ndarray, "g 3"]]:
    """Return the mesh without folds, with a copy of a vertex for each sheet that touches another one there.

    Collapsing the edges of a closed mesh leaves every edge with as many triangles in one direction as in the
    other, but it can fold two triangles onto each other, or let an edge have four. The triangles of such an
    edge are paired (Gueziec et al. 2001), and the copies of its vertices move apart a little.
    """
    is_flat = (faces == np.roll(faces, 1, axis=1)).any(1)
    faces = faces[~is_flat]
    # Triangles with the same corners in opposite directions cancel each other.
    order = np.argsort(faces, axis=1)
    turn = np.where((order[:, 1] - order[:, 0]) % 3 == 1, 1, -1)
    _, first, same = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_inverse=True)
    net = np.bincount(same.reshape(-1), weights=turn, minlength=len(first)).astype(np.int64)
    faces = np.where((net == turn[first])[:, None], faces[first], faces[first][:, ::-1])[net != 0]
    corner = np.arange(faces.size).reshape(faces.shape)
    begin, end = faces.reshape(-1), np.roll(faces, -1, axis=1).reshape(-1)
    first, second = corner.reshape(-1), np.roll(corner, -1, axis=1).reshape(-1)
    is_up = begin < end
    up, down = np.flatnonzero(is_up), np.flatnonzero(~is_up)
    up, down = up[np.lexsort([end[up], begin[up]])], down[np.lexsort([begin[down], end[down]])]
    if len(up) != len(down) or (begin[up] != end[down]).any() or (end[up] != begin[down]).any():
        return compacted(vertices, faces)
    links = np.stack(
        [np.concatenate([first[up], second[up]]), np.concatenate([second[down], first[down]])], axis=1
    )
    copy = parts_of(faces.size, links)
    source = np.zeros(int(copy.max(initial=-1)) + 1, dtype=np.int64)
    source[copy] = begin
    places = vertices[source]
    is_copied = np.bincount(source, minlength=len(vertices))[source] > 1
    middle = np.repeat(vertices[faces].mean(axis=1), 3, axis=0)
    count = np.bincount(copy, minlength=len(source))[:, None]
    summed = np.stack(
        [np.bincount(copy, weights=middle[:, axis], minlength=len(source)) for axis in range(3)], 1
    )
    places[is_copied] += APART * (summed / np.maximum(count, 1) - places)[is_copied]
    return compacted(places, copy.reshape(faces.shape))


def compacted(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> tuple[Float[np.ndarray, "w 3"], Int[np.ndarray, "f 3"]]:
    """Return the mesh without vertices that no triangle uses."""
    is_used = np.zeros(len(vertices), dtype=bool)
    is_used[faces] = True
    return vertices[is_used], (is_used.cumsum() - 1)[faces]


def is_watertight(faces: Int[np.ndarray, "f 3"]) -> bool:
    """Return whether each edge belongs to two triangles, which run through it in opposite directions."""
    from trimesh.geometry import faces_to_edges  # both are slow to import
    from trimesh.graph import is_watertight as has_closed_edges

    return all(map(bool, has_closed_edges(faces_to_edges(faces))))


def parts_of(count: int, faces: Int[np.ndarray, "f corners"]) -> Int[np.ndarray, "count"]:
    """Return the number of the connected part of each of ``count`` vertices."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    rows, columns = faces[:, :-1].reshape(-1), faces[:, 1:].reshape(-1)
    links = coo_array((np.ones(len(rows), dtype=np.int8), (rows, columns)), shape=(count, count))
    return connected_components(links, directed=False)[1].astype(np.int64)


def areas(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Float[np.ndarray, "f"]:
    """Return the area of each triangle."""
    return np.linalg.norm(_crosses(vertices, faces), axis=1) / 2


def vertex_normals(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> Float[np.ndarray, "v 3"]:
    """Return the directions of the sums of the triangles' normals around each vertex, weighted by area."""
    cross = _crosses(vertices, faces)
    corners, count = faces.reshape(-1), len(vertices)
    summed = [
        np.bincount(corners, weights=np.repeat(cross[:, axis], 3), minlength=count) for axis in range(3)
    ]
    normals = np.stack(summed, axis=1)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    # The triangles around a vertex may cancel each other. Any direction is right there.
    return np.where(length > 0, normals / np.where(length > 0, length, 1), [0.0, 0.0, 1.0])


def _crosses(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Float[np.ndarray, "f 3"]:
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    return np.cross(b - a, c - a)


@dataclass(frozen=True)
class Painter:
    """The colours that an asset shows at points of its surface."""

    sh: Float[Tensor, "n k 3"]  # of the Gaussians in ``some``
    some: Blobs
    grid: Lattice

    def colors(
        self, points: Float[np.ndarray, "p 3"], normals: Float[np.ndarray, "p 3"]
    ) -> Float[np.ndarray, "p 3"]:
        """Return the sRGB colour, in [0, 1], that each point shows to a camera in front of it.

        Each colour is a render of one ray against the normal, with the image formation model of 3DGS: the
        opacity of a Gaussian is its own times the falloff where the ray is nearest to its centre, and the
        Gaussians are composited in the order of their centres. Only Gaussians that reach the point take part,
        so that nothing else hides it, and they fade out towards the end of their reach.
        """
        place, outwards = torch.from_numpy(points), torch.from_numpy(normals)
        rays = torch.cat([place - self.grid.origin, outwards], dim=1).float()
        table = self._table()
        total, weight = torch.zeros(len(points), 3), torch.zeros(len(points))
        for pairs in near(self.some, self.grid, place):
            blob, point = pairs
            alpha, depth = _met(table.index_select(0, blob), rays.index_select(0, point))
            seen = (alpha >= UNSEEN).nonzero()[:, 0]
            order = seen[_by_depth(point[seen], depth[seen])]
            blob, point, alpha = blob[order], point[order], alpha[order]
            light = (_transmitted(alpha.double(), point) * alpha).float()
            for part in torch.arange(len(blob)).split(COLORS_AT_ONCE):
                rgb = evaluate_sh(self.sh[blob[part]], -rays[point[part], 3:])
                total.index_add_(0, point[part], light[part, None] * rgb)
            weight.index_add_(0, point, light)
        colors = total / weight.clamp_min(FAINT)[:, None]
        # Simplification may have moved a vertex away from all Gaussians.
        lost = (weight < FAINT).nonzero()[:, 0]
        if len(lost):
            from scipy.spatial import KDTree  # slow to import

            nearest = torch.from_numpy(KDTree(self.some.means.numpy()).query(points[lost.numpy()])[1])
            colors[lost] = evaluate_sh(self.sh[nearest], -outwards[lost].float())
        return colors.clamp(0, 1).double().numpy()

    def _table(self) -> Float[Tensor, "n 10"]:
        """Return of each Gaussian its centre, the upper half of its inverse covariance, and its opacity."""
        blur = (BLUR * self.grid.cell) ** 2 * torch.eye(3, dtype=torch.float64)
        precision = torch.linalg.inv(self.some.covariances + blur)
        rows, columns = torch.triu_indices(3, 3)
        centres, opacities = self.some.means - self.grid.origin, self.some.opacities[:, None]
        return torch.cat([centres, precision[:, rows, columns], opacities], dim=1).float()


def _met(
    table: Float[Tensor, "pairs 10"], rays: Float[Tensor, "pairs 6"]
) -> tuple[Float[Tensor, "pairs"], Float[Tensor, "pairs"]]:
    """Return the opacity of each Gaussian on its ray, and the depth of its centre below the point.

    A ray is a point and the normal there, and the camera looks against the normal. The opacity is the one at
    the place on the ray that is nearest to the centre. It fades out where the point itself is between
    ``CUTOFF - 1`` and ``CUTOFF`` standard deviations away.
    """
    mx, my, mz, xx, xy, xz, yy, yz, zz, opacity = table.T.contiguous()
    x, y, z, u, v, w = rays.T.contiguous()
    x, y, z = x - mx, y - my, z - mz
    # The inverse covariance times the normal.
    a, b, c = xx * u + xy * v + xz * w, xy * u + yy * v + yz * w, xz * u + yz * v + zz * w
    across = a * x + b * y + c * z
    along = a * u + b * v + c * w
    away = x * (xx * x + 2 * (xy * y + xz * z)) + y * (yy * y + 2 * yz * z) + zz * z * z
    # A huge Gaussian has an inverse covariance of zero in float32, and is the same everywhere.
    distance = (away - across * across / along).nan_to_num(0.0).clamp_min(0)
    # Without the fade, colours would jump where a point enters the reach of a Gaussian.
    fade = (CUTOFF - away.nan_to_num(0.0).clamp_min(0).sqrt()).clamp(0, 1)
    return (opacity * fade * (-0.5 * distance).exp()).clamp_max(MOST_OPAQUE), x * u + y * v + z * w


def _by_depth(point: Int[Tensor, "pairs"], depth: Float[Tensor, "pairs"]) -> Int[Tensor, "pairs"]:
    """Return the order of the pairs by their points, and by depth at the same point."""
    if len(depth) == 0:
        return point
    low, high = depth.min().double(), depth.max().double()
    share = 0.5 * (depth.double() - low) / (high - low).clamp_min(1e-30)
    return torch.from_numpy(np.argsort((point + share).numpy()))


def _transmitted(alpha: Float[Tensor, "pairs"], point: Int[Tensor, "pairs"]) -> Float[Tensor, "pairs"]:
    """Return the product of ``1 - alpha`` over earlier pairs of the same point; pairs are sorted by point."""
    passed = torch.log1p(-alpha).cumsum(0) - torch.log1p(-alpha)
    is_first = torch.ones_like(point, dtype=torch.bool)
    is_first[1:] = point[1:] != point[:-1]
    run = is_first.cumsum(0) - 1
    return (passed - passed[is_first][run]).exp()
