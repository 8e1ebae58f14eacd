"""From coloured points to Gaussians: what every initializer that starts from a point cloud shares."""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from cadam3d.core.checks import require_range, require_whole
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.sh import MAX_DEGREE, rgb_to_sh0

NEIGHBOURS = 3  # as 3DGS (Kerbl et al. 2023, sec. 5.1)
BLOCK = 256  # points whose neighbours are sought together
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

    Exact. A point without neighbours gets 1; none gets less than 1e-4.
    """
    count = min(NEIGHBOURS, len(points) - 1)
    if count < 1:
        return torch.ones_like(points[:, 0])
    result = torch.empty_like(points[:, 0])
    for rows in _blocks(points, torch.arange(len(points), device=points.device)):
        block = points[rows]
        # No point of the block has its neighbours farther away than within the block itself.
        reach = _nearest(block, block, count).max()
        is_near = ((points >= block.amin(dim=0) - reach) & (points <= block.amax(dim=0) + reach)).all(dim=-1)
        result[rows] = _nearest(block, points[is_near], count).mean(dim=1)
    return result.clamp_min(SMALLEST)


def require_points(count: object, scale: object, opacity: object, sh_degree: object) -> None:
    """Raise ``UserError`` unless these keys of an initializer make sense."""
    require_whole("initializer.count", count, low=1, example=2000)
    if scale is not None:
        require_range("initializer.scale", scale, above=0, example=0.03)
    require_range("initializer.opacity", opacity, above=0, below=1, example=0.1)
    require_whole("initializer.sh_degree", sh_degree, low=0, high=MAX_DEGREE, example=0)


def _blocks(points: Float[Tensor, "n 3"], rows: Int[Tensor, "rows"]) -> list[Tensor]:
    """Row numbers in compact groups: halved along the widest axis until small (a k-d tree)."""
    if len(rows) <= BLOCK:
        return [rows]
    inside = points[rows]
    axis = int((inside.amax(dim=0) - inside.amin(dim=0)).argmax())
    ordered = rows[inside[:, axis].argsort(stable=True)]
    half = len(rows) // 2
    return _blocks(points, ordered[:half]) + _blocks(points, ordered[half:])


def _nearest(
    block: Float[Tensor, "b 3"], others: Float[Tensor, "m 3"], count: int
) -> Float[Tensor, "b count"]:
    """Distances to the ``count`` nearest of ``others``, which contain the block itself."""
    distances = torch.cdist(block, others, compute_mode="donot_use_mm_for_euclid_dist")
    return distances.topk(count + 1, dim=1, largest=False).values[:, 1:]  # the first is the point itself
