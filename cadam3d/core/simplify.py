"""Simplify: from many Gaussians to a given number without training, by pruning or by merging.

Merging keeps the moments of what it merges. It is a greedy reduction of a Gaussian mixture: near pairs are
merged in the order of Runnalls' bound on the change of the mixture (Runnalls 2007, IEEE Transactions on
Aerospace and Electronic Systems 43(3)), written from the mathematics.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import softplus

from cadam3d.core.checks import Count, Declared, one_of, within
from cadam3d.core.contribution import RenderWithGradient, contributions
from cadam3d.core.edit import RowEdit
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.sh import SH_C0

METHODS = ("merge", "contribution", "opacity")
# Exponent of Thomsen's formula for the surface of an ellipsoid, whose error is at most 1.1 %.
THOMSEN = 1.6075
NEIGHBOURS = 6  # of each Gaussian, with one of which it may merge
# Differences below these are small: in space, as a share of the spread of the object, and in colour.
FINE, COLOR = 0.004, 0.05
LIGHTEST = 1e-30  # weight of a Gaussian that is fully transparent
OPAQUE = 1e-6  # smallest transparency of a merged Gaussian
FLATTEST = 1e-20  # square of the smallest scale of a merged Gaussian, in world units^2


@dataclass(frozen=True, kw_only=True)
class Simplify(Declared):
    """Settings of the number of Gaussians and of the method, for components that inherit them."""

    count: Count | None  # None = all, or as `fraction` says
    fraction: Annotated[float, within(above=0, high=1)] | None
    simplify: Annotated[str, one_of(METHODS)]

    def __post_init__(self) -> None:
        super().__post_init__()
        is_one = self.count is None or self.fraction is None
        self.expect(is_one, "fraction", f"null with count={self.count}", "null")

    def size(self, n: int) -> int:
        """Return how many of ``n`` Gaussians stay."""
        wanted = n if self.fraction is None else math.ceil(self.fraction * n)
        return min(n, wanted if self.count is None else self.count)

    def simplified(self, gaussians: Gaussians, render: RenderWithGradient) -> Gaussians:
        """Return :meth:`size` Gaussians that stand for ``gaussians``; the same object if all stay."""
        size = self.size(len(gaussians))
        if size == len(gaussians):
            return gaussians
        return simplification(gaussians, size, self.simplify, render).apply(gaussians)


def simplification(
    gaussians: Gaussians, count: int, method: str, render: RenderWithGradient | None = None
) -> RowEdit:
    """Return the edit that leaves ``count`` of more Gaussians; it draws no random numbers.

    ``opacity`` keeps the most opaque ones. ``contribution`` keeps those with the largest sum of blending
    weights over the pixels of 12 views, which ``render`` shows. ``merge`` replaces groups by one Gaussian
    each, a child of the heaviest of its group; ``_pooled`` says how. It leaves fewer if fewer are finite.
    """
    if method == "merge":
        return _merge(gaussians.detach(), count)
    if method == "opacity":
        importance = gaussians.opacities
    else:
        assert render is not None, "contributions are seen in renders"
        importance = contributions(gaussians, render)
    order = importance.detach().nan_to_num(nan=-1.0).argsort(descending=True, stable=True)
    none = order[:0]
    return RowEdit(keep=order[:count].sort().values, children=gaussians.detach().index(none), parents=none)


def shadows(scales: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    """Return the mean area of the ellipsoids' shadows over all directions, with an error below 1.1 %.

    By Cauchy's formula, it is a quarter of the surface. Twice the shadow times the opacity is what a Gaussian
    adds to the alphas of a picture, in world units^2 and averaged over all views, if nothing is in front.
    """
    a, b, c = scales.unbind(dim=-1)
    products = torch.stack([a * b, b * c, a * c])
    return math.pi * products.pow(THOMSEN).mean(dim=0).pow(1 / THOMSEN)


@dataclass(frozen=True)
class _Mixture:
    """Weighted Gaussians in double precision, with one colour each."""

    weights: Float[Tensor, "n"]  # opacity times mean shadow
    means: Float[Tensor, "n 3"]
    covariances: Float[Tensor, "n 3 3"]
    colors: Float[Tensor, "n 3"]

    @classmethod
    def of(cls, gaussians: Gaussians) -> "_Mixture":
        """Return the mixture that double-precision Gaussians are."""
        axes = gaussians.rotations * gaussians.scales[:, None]
        return cls(
            weights=(gaussians.opacities * shadows(gaussians.scales)).clamp_min(LIGHTEST),
            means=gaussians.means,
            covariances=axes @ axes.mT,
            colors=SH_C0 * gaussians.sh[:, 0],
        )

    def map(self, change: Callable[[Tensor], Tensor]) -> "_Mixture":
        """Return a mixture, each tensor replaced by ``change(tensor)``."""
        return _Mixture(*(change(tensor) for tensor in vars(self).values()))

    def merged(self, i: Int[Tensor, "p"], j: Int[Tensor, "p"]) -> "_Mixture":
        """Return one Gaussian for each pair, with its weight, mean, covariance and mean colour."""
        weights = self.weights[i] + self.weights[j]
        part = (self.weights[j] / weights)[:, None]
        apart = self.means[j] - self.means[i]
        spread = (part * (1 - part) * apart)[:, :, None] * apart[:, None, :]
        return _Mixture(
            weights=weights,
            means=self.means[i] + part * apart,
            covariances=torch.lerp(self.covariances[i], self.covariances[j], part[:, :, None]) + spread,
            colors=torch.lerp(self.colors[i], self.colors[j], part),
        )

    def entropies(self, floor: float) -> Float[Tensor, "n"]:
        """Return the logarithms of the volumes, each blurred by ``floor`` world units."""
        a, b, c, _, d, e, _, _, f = self.covariances.flatten(1).unbind(-1)
        a, d, f = a + floor**2, d + floor**2, f + floor**2
        determinants = a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d)
        return determinants.clamp_min(torch.finfo(determinants.dtype).tiny).log() / 2

    def costs(self, i: Int[Tensor, "p"], j: Int[Tensor, "p"], floor: float) -> Float[Tensor, "p"]:
        """Return Runnalls' bound for each pair, with the colour as three more axes of fixed width."""
        merged, entropies = self.merged(i, j), self.entropies(floor)
        first, second = self.weights[i], self.weights[j]
        colors = (self.colors[i] - self.colors[j]).square().sum(dim=-1) / (2 * COLOR**2)
        change = merged.weights * merged.entropies(floor) - first * entropies[i] - second * entropies[j]
        return change + first * second / merged.weights * colors


def _merge(gaussians: Gaussians, count: int) -> RowEdit:
    """Return the edit that replaces groups of near Gaussians by one each, computed on the CPU."""
    exact = gaussians.to("cpu").to(torch.float64)
    mixture = _Mixture.of(exact)
    numbers = torch.cat([mixture.means, mixture.covariances.flatten(1), mixture.weights[:, None]], dim=1)
    rows = numbers.isfinite().all(dim=1).nonzero()[:, 0]
    groups = _groups(mixture.map(lambda tensor: tensor[rows]), count)
    is_alone = (groups.bincount() == 1)[groups]
    together = rows[~is_alone]
    _, groups, sizes = groups[~is_alone].unique(return_inverse=True, return_counts=True)
    # The heaviest of each group, which is the first in this order.
    order = mixture.weights[together].argsort(descending=True, stable=True)
    order = order[groups[order].argsort(stable=True)]
    heaviest = together[order[sizes.cumsum(dim=0) - sizes]]
    children = _pooled(exact.index(together), groups, len(sizes)).to(gaussians.means.dtype)
    return RowEdit(
        keep=rows[is_alone].to(gaussians.device),
        children=children.to(gaussians.device),
        parents=heaviest.to(gaussians.device),
    )


def _groups(mixture: _Mixture, count: int) -> Int[Tensor, "n"]:
    """Return the number of the group of each Gaussian, from 0 on, for ``count`` groups at most.

    In each round, pairs merge that are the best choice of both, the cheapest first.
    """
    groups = torch.arange(len(mixture.weights))
    share = mixture.weights / mixture.weights.sum()
    apart = mixture.means - share @ mixture.means
    floor = FINE * float((share @ apart.square()).sum().sqrt())
    while (n := len(mixture.weights)) > count:
        i, j = (ends[: n - count] for ends in _pairs(mixture, floor))
        is_kept = torch.ones(n, dtype=torch.bool).index_fill(0, torch.cat([i, j]), False)
        number = is_kept.cumsum(dim=0) - 1
        number[i] = number[j] = torch.arange(n - 2 * len(i), n - len(i))
        groups, merged = number[groups], mixture.merged(i, j)
        mixture = _Mixture(
            *(
                torch.cat([old[is_kept], new])
                for old, new in zip(vars(mixture).values(), vars(merged).values(), strict=True)
            )
        )
    return groups


def _pairs(mixture: _Mixture, floor: float) -> tuple[Int[Tensor, "p"], Int[Tensor, "p"]]:
    """Return pairs without a common member in the order of their costs; there is at least one."""
    from scipy.spatial import KDTree  # slow to import

    n, points = len(mixture.weights), mixture.means.numpy()
    near = torch.from_numpy(KDTree(points).query(points, k=min(NEIGHBOURS + 1, n))[1])
    itself = torch.arange(n)[:, None].expand_as(near)
    low, high = torch.minimum(itself, near), torch.maximum(itself, near)
    pairs = (low * n + high)[low < high].unique()
    i, j = pairs // n, pairs % n
    order = mixture.costs(i, j, floor).argsort(stable=True)
    i, j, rank = i[order], j[order], torch.arange(len(order))
    best = torch.full((n,), len(order)).scatter_reduce(0, torch.cat([i, j]), rank.repeat(2), "amin")
    is_mutual = (best[i] == rank) & (best[j] == rank)
    return i[is_mutual], j[is_mutual]


def _pooled(gaussians: Gaussians, groups: Int[Tensor, "n"], count: int) -> Gaussians:
    """Return one Gaussian for each of ``count`` groups.

    Its mean and covariance are those of the group as a mixture, in which each Gaussian has its opacity times
    its shadow as weight, and its colour is their mean. So is the sum of the weights, unless the opacity would
    then be higher than that of the whole group one behind the other.
    """
    from scipy.spatial.transform import Rotation  # slow to import

    mixture = _Mixture.of(gaussians)
    weights = mixture.weights.new_zeros(count).index_add(0, groups, mixture.weights)
    share = mixture.weights / weights[groups]

    def mean(rows: Tensor) -> Tensor:
        total = rows.new_zeros(count, *rows.shape[1:])
        return total.index_add(0, groups, rows * share.view(-1, *[1] * (rows.ndim - 1)))

    means = mean(gaussians.means)
    apart = gaussians.means - means[groups]
    variances, axes = torch.linalg.eigh(mean(mixture.covariances + apart[:, :, None] * apart[:, None, :]))
    scales = variances.clamp_min(FLATTEST).sqrt()
    axes[:, :, 0] *= torch.linalg.det(axes)[:, None]  # a rotation, not a reflection
    quats = torch.from_numpy(Rotation.from_matrix(axes.numpy()).as_quat(scalar_first=True))
    clear = torch.zeros_like(weights).index_add(0, groups, softplus(gaussians.opacity_logits))
    opacities = torch.minimum(weights / shadows(scales), -torch.expm1(-clear))
    return Gaussians(means, scales.log(), quats, opacities.logit(eps=OPAQUE), mean(gaussians.sh))
