"""Density: the sum of the opacities of Gaussians on a grid, and the Gaussians near given points.

The density at x is ``sum_i o_i exp(-d_i(x)^2 / 2)``, with the opacity ``o_i`` and the Mahalanobis distance
``d_i`` of each Gaussian. A Gaussian ends at ``d_i = CUTOFF``. Every Gaussian is blurred by ``BLUR`` cells
without a change of its opacity, so that one that is thinner than a cell still reaches a node of the grid, and
a thin wall has no holes.

The work is done in columns: the nodes that a Gaussian reaches are intervals along z, one for each (x, y) of
its bounding box, and the ends of each interval follow from the conditional mean and variance of z. The memory
is therefore bounded, however many Gaussians there are, and a long, thin Gaussian costs no more than the nodes
that it covers. Gaussians that are large in all directions are added to coarser grids, which are then
interpolated.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from cadam3d.core.console import followed
from cadam3d.core.gaussians import Gaussians

CUTOFF = 3.0  # standard deviations
BLUR = 0.5  # cells, standard deviation
# A grid has LEVELS coarser ones, each with half as many cells. A Gaussian belongs to the coarsest one on
# which its smallest standard deviation is at least COARSE cells; the error of linear interpolation is then
# below one percent.
LEVELS = 3
COARSE = 4.0  # cells
# Numbers per temporary array; this bounds the memory.
AT_ONCE = 1 << 21
# Fainter Gaussians are left out. Rasterizers skip them too (1/255).
FAINTEST = 1 / 255
# Standard deviations and positions beyond this are clamped, so that squares of them stay finite.
LARGEST = 1e30  # world units


@dataclass(frozen=True)
class Lattice:
    """Nodes at ``origin + cell * (i, j, k)``; each axis has a multiple of 2**LEVELS cells."""

    origin: Float[Tensor, "3"]  # float64, world units
    cell: float  # world units
    nodes: tuple[int, int, int]

    @property
    def count(self) -> int:
        """Return the number of nodes."""
        return math.prod(self.nodes)

    def coarser(self, level: int) -> "Lattice":
        """Return the grid with ``2**level`` times larger cells and the same corners."""
        x, y, z = ((nodes - 1) // 2**level + 1 for nodes in self.nodes)
        return Lattice(self.origin, self.cell * 2**level, (x, y, z))


def grid_around(low: Float[Tensor, "3"], high: Float[Tensor, "3"], resolution: int) -> Lattice:
    """Return a grid with ``resolution`` cells along the longest side of a box and its margin of two cells."""
    low, high = low.double(), high.double()
    cell = max(float((high - low).max()) / max(resolution - 4, 1), 1e-30)
    unit = 2**LEVELS
    x, y, z = (unit * math.ceil((round(side, 6) + 4) / unit) + 1 for side in ((high - low) / cell).tolist())
    nodes = (x, y, z)
    centre = (low + high) / 2
    return Lattice(centre - cell * (torch.tensor(nodes) - 1) / 2, cell, nodes)


@dataclass(frozen=True)
class Blobs:
    """The Gaussians that count, on the CPU, in float64."""

    rows: Int[Tensor, "n"]  # which Gaussians they are
    means: Float[Tensor, "n 3"]
    covariances: Float[Tensor, "n 3 3"]
    smallest: Float[Tensor, "n"]  # smallest standard deviation, world units
    opacities: Float[Tensor, "n"]

    def index(self, chosen: Tensor) -> "Blobs":
        """Return the chosen ones."""
        return Blobs(**{name: value[chosen] for name, value in vars(self).items()})

    def reach(self) -> Float[Tensor, "n 3"]:
        """Return how far each one extends along the axes, in world units."""
        return CUTOFF * self.covariances.diagonal(dim1=1, dim2=2).sqrt()

    def area(self) -> Float[Tensor, "n"]:
        """Return a rough measure of the area of each one, times its opacity, in world units squared."""
        return self.opacities * self.covariances.diagonal(dim1=1, dim2=2).sum(1)


def blobs(gaussians: Gaussians) -> Blobs:
    """Return the Gaussians that are not too faint to be seen."""
    cpu = gaussians.detach().to("cpu")
    opacities = cpu.opacities.double()
    rows = (opacities >= FAINTEST).nonzero()[:, 0]
    some = cpu.index(rows)
    scales = some.log_scales.double().clamp(-math.log(LARGEST), math.log(LARGEST)).exp()
    axes = some.rotations.double() * scales[:, None]
    return Blobs(
        rows=rows,
        means=some.means.double().clamp(-LARGEST, LARGEST),
        covariances=axes @ axes.transpose(1, 2),
        smallest=scales.amin(1),
        opacities=opacities[rows],
    )


def density(some: Blobs, grid: Lattice, blur: float = BLUR) -> Float[Tensor, "x y z"]:
    """Return the density at every node, in float32; ``blur`` is in cells."""
    smallest = (some.smallest / grid.cell).clamp_min(1e-30)
    levels = (smallest / COARSE).log2().floor().clamp(0, LEVELS).long()
    total: Tensor | None = None
    for level in reversed(range(LEVELS + 1)):
        coarse = grid.coarser(level)
        if total is not None:
            total = torch.nn.functional.interpolate(
                total[None, None], size=coarse.nodes, mode="trilinear", align_corners=True
            )[0, 0]
        chosen = levels == level
        if not bool(chosen.any()):
            continue
        total = torch.zeros(coarse.nodes) if total is None else total
        # All coarser grids get the same blur in world units, so that the size of a Gaussian does not jump.
        _add(total.view(-1), some.index(chosen), coarse, blur / 2**level)
    return torch.zeros(grid.nodes) if total is None else total


def _add(values: Float[Tensor, "nodes"], some: Blobs, grid: Lattice, blur: float) -> None:
    """Add the density of ``some`` to ``values``, in place."""
    for runs in _runs(some, grid, blur, longest=grid.nodes[2]):
        run, step = _expand(runs.lengths)
        apart = step - runs.middle[run]
        exponent = apart.square_().mul_(runs.sharpness[run]).add_(runs.offset[run])
        values.index_add_(0, runs.first[run] + step, exponent.neg_().exp_().mul_(runs.opacity[run]))


@dataclass(frozen=True)
class _Runs:
    """Runs of nodes along z that Gaussians reach; ``offset + sharpness (k - middle)^2`` is half of d^2."""

    blob: Int[Tensor, "r"]
    first: Int[Tensor, "r"]  # number of the first node
    lengths: Int[Tensor, "r"]  # nodes, >= 1
    middle: Float[Tensor, "r"]  # of the Gaussian, in nodes from the first one
    sharpness: Float[Tensor, "r"]
    offset: Float[Tensor, "r"]
    opacity: Float[Tensor, "r"]


def _runs(some: Blobs, grid: Lattice, blur: float, longest: int) -> Iterator[_Runs]:
    """Yield the runs of all Gaussians, at most ``AT_ONCE / longest`` of them at once."""
    means = (some.means - grid.origin) / grid.cell
    covariances = some.covariances / grid.cell**2 + blur**2 * torch.eye(3, dtype=torch.float64)
    last = torch.tensor(grid.nodes) - 1
    reach = CUTOFF * covariances.diagonal(dim1=1, dim2=2).sqrt()
    # A comparison of floats decides what is inside, since huge numbers do not fit into integers.
    low = (means - reach).ceil().clamp_min(0)
    high = torch.minimum((means + reach).floor(), last.double())
    inside = (low <= high).all(1).nonzero()[:, 0]
    low, high, means, covariances = (
        low[inside].long(),
        high[inside].long(),
        means[inside],
        covariances[inside],
    )
    # The distribution of (x, y), and of z for given x and y. Both are stable for very thin Gaussians.
    flat = covariances[:, :2, :2]
    area = (flat[:, 0, 0] * flat[:, 1, 1] - flat[:, 0, 1] ** 2).clamp_min(blur**4)
    inverse = torch.stack([flat[:, 1, 1], -flat[:, 0, 1], flat[:, 0, 0]], 1) / area[:, None]
    cross = covariances[:, :2, 2]
    slope_x = inverse[:, 0] * cross[:, 0] + inverse[:, 1] * cross[:, 1]
    slope_y = inverse[:, 1] * cross[:, 0] + inverse[:, 2] * cross[:, 1]
    variance = covariances[:, 2, 2] - slope_x * cross[:, 0] - slope_y * cross[:, 1]
    variance = variance.clamp_min(blur**2)

    wide = high[:, :2] - low[:, :2] + 1
    ends = (wide[:, 0] * wide[:, 1]).cumsum(0)
    count = int(ends[-1]) if len(ends) else 0
    share = max(1, AT_ONCE // longest)
    for start in followed(range(0, count, share), "surface: Gaussians on a grid"):
        column = torch.arange(start, min(start + share, count))
        g = torch.searchsorted(ends, column, right=True)
        column -= (ends - wide[:, 0] * wide[:, 1])[g]
        x = low[g, 0] + column // wide[g, 1]
        y = low[g, 1] + column % wide[g, 1]
        dx, dy = x - means[g, 0], y - means[g, 1]
        distance = inverse[g, 0] * dx * dx + 2 * inverse[g, 1] * dx * dy + inverse[g, 2] * dy * dy
        middle = means[g, 2] + slope_x[g] * dx + slope_y[g] * dy
        half = ((CUTOFF**2 - distance).clamp_min(0) * variance[g]).sqrt()
        begin = torch.maximum((middle - half).ceil(), low[g, 2].double())
        end = torch.minimum((middle + half).floor(), high[g, 2].double())
        kept = ((distance < CUTOFF**2) & (begin <= end)).nonzero()[:, 0]
        g, begin, end = g[kept], begin[kept], end[kept]
        yield _Runs(
            blob=inside[g],
            first=(x[kept] * grid.nodes[1] + y[kept]) * grid.nodes[2] + begin.long(),
            lengths=(end - begin).long() + 1,
            middle=(middle[kept] - begin).float(),
            sharpness=(0.5 / variance[g]).float(),
            offset=(0.5 * distance[kept]).float(),
            opacity=some.opacities[inside[g]].float(),
        )


def _expand(lengths: Int[Tensor, "r"]) -> tuple[Int[Tensor, "e"], Int[Tensor, "e"]]:
    """Return for each element of consecutive runs the number of its run, and its place in the run."""
    run = torch.repeat_interleave(lengths)
    ends = lengths.cumsum(0)
    return run, torch.arange(len(run)) - (ends - lengths)[run]


def near(
    some: Blobs, grid: Lattice, points: Float[Tensor, "p 3"]
) -> Iterator[tuple[Int[Tensor, "pairs"], Int[Tensor, "pairs"]]]:
    """Yield pairs (blob, point) in which the blurred Gaussian reaches the node nearest to the point.

    All pairs of a point are in the same batch. Points outside the grid count as on its border.
    """
    last = torch.tensor(grid.nodes) - 1
    node = ((points.double() - grid.origin) / grid.cell).round().clamp_min(0).long().minimum(last)
    number = (node[:, 0] * grid.nodes[1] + node[:, 1]) * grid.nodes[2] + node[:, 2]
    order = number.argsort(stable=True)
    ahead = _reaching(some, grid)[number[order]].cumsum(0)
    batches = (ahead // AT_ONCE).bincount() if len(points) else []
    for batch in order.split([count for count in batches if count > 0]):
        # The points are in the order of x, so each batch is in a slab of the grid.
        x = node[batch, 0]
        slab = (some.means[:, 0] - grid.origin[0]) / grid.cell
        reach = some.reach()[:, 0] / grid.cell + CUTOFF * BLUR + 1
        inside = ((slab + reach >= x.min()) & (slab - reach <= x.max())).nonzero()[:, 0]
        for blob, point in _pairs(some.index(inside), grid, number[batch]):
            yield inside[blob], batch[point]


def _reaching(some: Blobs, grid: Lattice) -> Int[Tensor, "nodes"]:
    """Return the number of blurred Gaussians that reach each node."""
    change = torch.zeros(grid.count + 1, dtype=torch.int64)
    for runs in _runs(some, grid, BLUR, longest=8):
        change.index_add_(0, runs.first, torch.ones_like(runs.first))
        change.index_add_(0, runs.first + runs.lengths, -torch.ones_like(runs.first))
    return change.cumsum(0)[:-1]


def _pairs(
    some: Blobs, grid: Lattice, number: Int[Tensor, "p"]
) -> Iterator[tuple[Int[Tensor, "pairs"], Int[Tensor, "pairs"]]]:
    """Yield all pairs (blob, point) at once; ``number`` is the node of each point, in ascending order."""
    # The points of a run of nodes are consecutive: from ``starts[first]`` up to ``starts[first + length]``.
    starts = torch.zeros(grid.count + 1, dtype=torch.int64)
    starts[1:] = torch.bincount(number, minlength=grid.count).cumsum(0)
    found = []
    for runs in _runs(some, grid, BLUR, longest=8):
        begin, end = starts[runs.first], starts[runs.first + runs.lengths]
        held = (begin < end).nonzero()[:, 0]
        run, step = _expand((end - begin)[held])
        found.append((runs.blob[held][run], begin[held][run] + step))
    if found:
        yield torch.cat([blob for blob, _ in found]), torch.cat([point for _, point in found])
