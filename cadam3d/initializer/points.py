"""From coloured points to Gaussians: what every initializer that starts from a point cloud shares."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.checks import require_range
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.sh import MAX_DEGREE, rgb_to_sh0

NEIGHBOURS = 3  # as 3DGS (Kerbl et al. 2023, sec. 5.1)
CHUNK = 2**24  # distances held at a time
SMALLEST = 1e-4  # world units; coincident points would have no size at all


def gaussians_at(
    points: Float[Tensor, "n 3"],
    rgb: Float[Tensor, "n 3"],
    *,
    scale: float | None,
    opacity: float,
    sh_degree: int,
) -> Gaussians:
    """Round Gaussians at ``points`` (world units) that show ``rgb`` (in [0, 1]) from every side.

    ``scale`` is their standard deviation in world units; None gives each the mean distance to its three
    nearest neighbours, so that they just overlap.
    """
    n = len(points)
    scales = neighbour_distance(points) if scale is None else points.new_full((n,), scale)
    sh = points.new_zeros(n, (sh_degree + 1) ** 2, 3)
    sh[:, 0] = rgb_to_sh0(rgb)
    return Gaussians(
        means=points,
        log_scales=scales.log()[:, None].repeat(1, 3),
        quats=points.new_tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1),
        opacity_logits=points.new_full((n,), math.log(opacity / (1 - opacity))),
        sh=sh,
    )


def neighbour_distance(points: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    """Mean distance of each point to its three nearest others (to all others, if they are fewer).

    Exhaustive, in chunks of bounded memory. A point without neighbours gets 1; none gets less than 1e-4.
    """
    n = len(points)
    count = min(NEIGHBOURS, n - 1)
    if count < 1:
        return points.new_ones(n)
    nearest = [
        torch.cdist(rows, points, compute_mode="donot_use_mm_for_euclid_dist")
        .topk(count + 1, dim=1, largest=False)
        .values[:, 1:]  # the first is the point itself, at distance zero
        .mean(dim=1)
        for rows in points.split(max(CHUNK // n, 1))
    ]
    return torch.cat(nearest).clamp_min(SMALLEST)


def require_points(count: int, scale: float | None, opacity: float, sh_degree: int) -> None:
    """Raise ``UserError`` unless these keys of an initializer make sense."""
    require_range("initializer.count", count, low=1, example=2000)
    if scale is not None:
        require_range("initializer.scale", scale, above=0, example=0.03)
    require_range("initializer.opacity", opacity, above=0, below=1, example=0.1)
    require_range("initializer.sh_degree", sh_degree, low=0, high=MAX_DEGREE, example=0)
