"""A z-buffer: the first triangle behind every point of a picture, in plain torch on any device.

With the corners P_i of a triangle in homogeneous pixels (x z, y z, z), the point s = (x, y, 1) of the picture
is the projection of

    z s = sum_i w_i P_i,  w_i = e_i / sum_j e_j,  e_i = s . (P_j x P_k),  z = P_0 . (P_1 x P_2) / sum_j e_j.

It is inside if all e_i have the same sign, and no triangle has to be clipped: one that is partly behind the
camera is tried at every point (Olano and Greer 1997). Pixels are counted from the corner of each triangle's
box, which keeps the cross products exact enough in float32.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from cadam3d.core.cameras import Cameras

NEAR = 0.01  # world units, as in the rasterizers
CHUNK = 1 << 21  # pairs of a triangle and a point that are tried together


@dataclass(frozen=True)
class Hits:
    """The points of one picture at which a triangle is seen."""

    point: Int[Tensor, "n"]  # number of the point, row by row
    face: Int[Tensor, "n"]
    weights: Float[Tensor, "n 3"]  # barycentric
    depth: Float[Tensor, "n"]  # along the axis of the camera, in world units

    def where(self, chosen: Tensor) -> "Hits":
        """Return the chosen rows."""
        return Hits(self.point[chosen], self.face[chosen], self.weights[chosen], self.depth[chosen])


def first_hits(
    corners: Float[Tensor, "f 3 3"],
    fine: Cameras,
    view: int,
    is_solid: Callable[[Hits], Bool[Tensor, "n"]] | None = None,
) -> Hits:
    """Return the nearest triangle at the centre of every pixel of one view, at most one per pixel.

    ``is_solid`` says which hits are no holes; None means all. Both sides of a triangle are seen.
    """
    to_camera = fine.world_to_camera[view]
    homogeneous = (corners @ to_camera[:3, :3].T + to_camera[:3, 3]) @ fine.intrinsics[view].T
    face, low, size = _boxes(homogeneous, fine.width, fine.height)
    homogeneous = homogeneous[face]
    homogeneous = homogeneous - homogeneous[:, :, 2:] * torch.nn.functional.pad(low, (0, 1))[:, None]
    a, b, c = homogeneous.unbind(1)
    edges = torch.stack([torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)], dim=1)
    volume = (a * edges[:, 0]).sum(1)
    edges = edges * volume.sign()[:, None, None]
    ends = (size[:, 0] * size[:, 1]).cumsum(0)
    found = []
    for rows in _chunks(ends):
        found.append(_inside(edges[rows], volume[rows].abs(), low[rows], size[rows], face[rows], fine.width))
    hits = Hits(*(torch.cat([getattr(part, name) for part in found]) for name in Hits.__dataclass_fields__))
    if is_solid is not None:
        hits = hits.where(is_solid(hits))
    nearest = hits.depth.new_full((fine.width * fine.height,), torch.inf)
    nearest.scatter_reduce_(0, hits.point, hits.depth, "amin")
    hits = hits.where(hits.depth <= nearest[hits.point])
    # Of two triangles at the same depth, such as at a common edge, the later one is seen.
    winner = torch.full_like(nearest, -1, dtype=torch.long)
    winner.scatter_reduce_(0, hits.point, torch.arange(len(hits.point), device=winner.device), "amax")
    return hits.where(winner[winner >= 0])


def _boxes(
    homogeneous: Float[Tensor, "f 3 3"], width: int, height: int
) -> tuple[Int[Tensor, "n"], Float[Tensor, "n 2"], Int[Tensor, "n 2"]]:
    """Return the triangles that may cover a pixel centre, the first one of each and how many in x and y."""
    depth = homogeneous[:, :, 2]
    is_before = depth > NEAR
    flat = homogeneous[:, :, :2] / depth[:, :, None].clamp_min(NEAR)
    most = torch.tensor([width, height], device=depth.device)
    first = (flat.amin(1) - 0.5).ceil().clamp_min(0)
    last = torch.minimum((flat.amax(1) - 0.5).floor(), most - 1)
    is_cut = ~is_before.all(1)
    first[is_cut], last[is_cut] = 0, (most - 1).to(last)
    size = (last - first + 1).clamp_min(0).long()
    face = ((size.prod(1) > 0) & is_before.any(1)).nonzero()[:, 0]
    return face, first[face] + 0.5, size[face]


def _chunks(ends: Int[Tensor, "n"]) -> list[slice]:
    """Return runs of rows with about ``CHUNK`` pairs each, given the cumulated numbers of pairs."""
    total = int(ends[-1]) if len(ends) else 0
    limits = torch.arange(0, total, CHUNK, device=ends.device)
    borders = [*torch.searchsorted(ends, limits, right=True).tolist(), len(ends)]
    return [slice(first, last) for first, last in pairwise(borders)] or [slice(0, 0)]


def _inside(
    edges: Float[Tensor, "n 3 3"],
    volume: Float[Tensor, "n"],
    low: Float[Tensor, "n 2"],
    size: Int[Tensor, "n 2"],
    face: Int[Tensor, "n"],
    width: int,
) -> Hits:
    """Return all pixel centres inside of triangles, also those that another triangle hides."""
    count = size[:, 0] * size[:, 1]
    row = torch.arange(len(count), device=count.device).repeat_interleave(count)
    number = torch.arange(len(row), device=row.device) - (count.cumsum(0) - count)[row]
    down = torch.div(number, size[row, 0], rounding_mode="floor")
    across = number - down * size[row, 0]
    x, y = across.to(low), down.to(low)
    shares = edges[row, :, 0] * x[:, None] + edges[row, :, 1] * y[:, None] + edges[row, :, 2]
    total = shares.sum(1)
    inside = ((shares >= 0).all(1) & (total > 0)).nonzero()[:, 0]
    row, shares, total = row[inside], shares[inside], total[inside]
    corner = low[row].long()
    point = (corner[:, 1] + down[inside]) * width + corner[:, 0] + across[inside]
    hits = Hits(point, face[row], shares / total[:, None], volume[row] / total)
    return hits.where((hits.depth > NEAR).nonzero()[:, 0])
