"""A z-buffer: the first triangle behind every point of a picture, in plain torch on any device.

With the corners P_i of a triangle in homogeneous pixels (x z, y z, z), the point s = (x, y, 1) of the picture
is the projection of

    z s = sum_i w_i P_i,  w_i = e_i / sum_j e_j,  e_i = s . (P_j x P_k),  z = P_0 . (P_1 x P_2) / sum_j e_j.

It is inside if all e_i have the same sign, and no triangle has to be clipped: one that is partly behind the
camera is tried at every point (Olano and Greer 1997). Pixels are counted from the corner of each triangle's
box, which keeps the cross products exact enough in float32. Each triangle is enlarged a little, because
rounding could leave a point on a common edge out of both of its triangles.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from cadam3d.core.cameras import Cameras

NEAR = 0.01  # world units, as in the rasterizers
CHUNK = 1 << 21  # points in the boxes of triangles that are tried together
SLACK = 0.01  # pixels, more than the rounding of the ends of a row
GROWTH = 1e-4  # of the size of a triangle, by which it is enlarged


@dataclass(frozen=True)
class Hits:
    """The points of one picture at which a triangle is seen."""

    point: Int[Tensor, "n"]  # number of the point, row by row
    face: Int[Tensor, "n"]
    weights: Float[Tensor, "n 3"]  # barycentric
    depth: Float[Tensor, "n"]  # along the axis of the camera, in world units

    def where(self, chosen: Int[Tensor, "m"]) -> "Hits":
        """Return the chosen rows."""
        return Hits(*(getattr(self, name).index_select(0, chosen) for name in Hits.__dataclass_fields__))

    def joined(self, other: "Hits") -> "Hits":
        """Return the rows of both."""
        return Hits(*(torch.cat([vars(self)[name], vars(other)[name]]) for name in vars(self)))

    def nearest(self, points: int) -> "Hits":
        """Return the nearest hit of each of ``points`` points that has one."""
        depth = self.depth.new_full((points,), torch.inf).scatter_reduce_(0, self.point, self.depth, "amin")
        hits = self.where((self.depth <= depth[self.point]).nonzero()[:, 0])
        # Of two triangles at the same depth, such as at a common edge, the later one is seen.
        winner = torch.full_like(depth, -1, dtype=torch.long)
        winner.scatter_reduce_(0, hits.point, torch.arange(len(hits.point), device=winner.device), "amax")
        return hits.where(winner[winner >= 0])


def first_hits(
    corners: Float[Tensor, "f 3 3"],
    fine: Cameras,
    view: int,
    is_solid: Callable[[Hits], Bool[Tensor, "n"]] | None = None,
) -> Hits:
    """Return the nearest triangle at the centre of every pixel of one view, at most one per pixel.

    ``is_solid`` says which hits are no holes; None means all. Both sides of a triangle are seen.
    """
    to_pixels = fine.intrinsics[view] @ fine.world_to_camera[view, :3]
    homogeneous = to_pixels[:, :3] @ corners.reshape(-1, 3).T + to_pixels[:, 3:]
    face, low, size = _boxes(homogeneous.reshape(3, -1, 3), fine.width, fine.height)
    kept = homogeneous.reshape(3, -1, 3).index_select(1, face)
    a, b, c = (kept - torch.nn.functional.pad(low, (0, 0, 0, 1))[:, :, None] * kept[2]).unbind(2)
    cross = partial(torch.linalg.cross, dim=0)
    edges = torch.stack([cross(b, c), cross(c, a), cross(a, b)], dim=1)
    edges = edges * (a * edges[:, 0]).sum(0).sign()
    edges = edges + GROWTH * edges.sum(1, keepdim=True)
    nearest = None
    # The memory depends on the picture, and not on how many triangles are behind each other.
    for rows in _chunks((size[0] * size[1]).cumsum(0)):
        part = (edges[:, :, rows], kept[2, rows], low[:, rows], size[:, rows], face[rows])
        hits = _inside(*part, fine.width)
        hits = hits if is_solid is None else hits.where(is_solid(hits).nonzero()[:, 0])
        hits = hits if nearest is None else nearest.joined(hits)
        nearest = hits.nearest(fine.width * fine.height)
    assert nearest is not None
    return nearest


def _boxes(
    homogeneous: Float[Tensor, "3 f 3"], width: int, height: int
) -> tuple[Int[Tensor, "n"], Float[Tensor, "2 n"], Int[Tensor, "2 n"]]:
    """Return the triangles that may cover a pixel centre, the first one of each and how many in x and y."""
    depth = homogeneous[2:]
    a, b, c = torch.cat([homogeneous[:2] / depth.clamp_min(NEAR), depth]).unbind(2)
    least, most = torch.minimum(torch.minimum(a, b), c), torch.maximum(torch.maximum(a, b), c)
    limits = least.new_tensor([[width - 1], [height - 1]])
    is_cut = least[2] <= NEAR
    first = (least[:2] - 0.5 - SLACK).ceil().clamp_min(0).masked_fill(is_cut, 0)
    last = torch.where(is_cut, limits, torch.minimum((most[:2] - 0.5 + SLACK).floor(), limits))
    size = (last - first + 1).clamp_min(0)
    face = ((size[0] * size[1] > 0) & (most[2] > NEAR)).nonzero()[:, 0]
    return face, first.index_select(1, face) + 0.5, size.index_select(1, face).long()


def _chunks(ends: Int[Tensor, "n"]) -> list[slice]:
    """Return runs of rows with about ``CHUNK`` pairs each, given the cumulated numbers of pairs."""
    total = int(ends[-1]) if len(ends) else 0
    limits = torch.arange(0, total, CHUNK, device=ends.device)
    borders = [*torch.searchsorted(ends, limits, right=True).tolist(), len(ends)]
    return [slice(first, last) for first, last in pairwise(borders)] or [slice(0, 0)]


def _inside(
    edges: Float[Tensor, "3 3 n"],
    depth: Float[Tensor, "n 3"],
    low: Float[Tensor, "2 n"],
    size: Int[Tensor, "2 n"],
    face: Int[Tensor, "n"],
    width: int,
) -> Hits:
    """Return all pixel centres inside of triangles, also those that another triangle hides."""
    # First the rows of each triangle, and where e_i = level + slope x changes its sign in them.
    owner, y = _repeated(size[1])
    slope, down, level = (each.index_select(1, owner) for each in edges)
    level = level + down * y
    crossing = -level / slope
    first = torch.where(slope > 0, crossing, 0).amax(0)
    last = torch.where(slope < 0, crossing, torch.inf).amin(0)
    first = (first - SLACK).ceil().clamp_min(0)
    last = torch.minimum((last + SLACK).floor(), size[0].index_select(0, owner) - 1)
    row, x = _repeated((last - first + 1).clamp_min(0).long())
    x = x + first.index_select(0, row)
    shares = level.index_select(1, row) + slope.index_select(1, row) * x
    total = shares.sum(0)
    owner = owner.index_select(0, row)
    inside = ((shares.amin(0) >= 0) & (total > 0)).nonzero()[:, 0]
    owner, weights = owner[inside], (shares.index_select(1, inside) / total[inside]).T
    left, upper = low.index_select(1, owner).long()
    point = (upper + y[row[inside]]) * width + left + x[inside].long()
    hits = Hits(point, face[owner], weights, (weights * depth.index_select(0, owner)).sum(1))
    return hits.where((hits.depth > NEAR).nonzero()[:, 0])


def _repeated(count: Int[Tensor, "n"]) -> tuple[Int[Tensor, "m"], Int[Tensor, "m"]]:
    """Return each number ``count`` times, and how often it was there before."""
    number = torch.arange(len(count), device=count.device).repeat_interleave(count)
    first = count.cumsum(0) - count
    return number, torch.arange(len(number), device=count.device) - first.index_select(0, number)
