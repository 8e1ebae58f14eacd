"""From coloured points to Gaussians: what the initializers share that start from points or from an object."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from cadam3d.core.checks import Positive, one_of, require, whole, within
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.sh import MAX_DEGREE, rgb_to_sh0
from cadam3d.initializer.base import Initializer
from cadam3d.io.frames import TURNS

# As in 3DGS (Kerbl et al. 2023, sec. 5.1).
NEIGHBOURS = 3
# Keeps the size of coincident points above zero.
SMALLEST = 1e-4  # world units
# How distances to neighbours are combined. rms is the law of the 3DGS code, and of all published recipes.
SCALE_LAWS = ("mean", "rms")
# How points are drawn in a ball, see :func:`replicated`.
REPLICATE_LAWS = ("even", "polar")
# No machine can train more Gaussians.
Rows = Annotated[int, whole(low=1, high=100_000_000)]
Copies = Annotated[int, whole(low=1, high=1000)]
Radius = Annotated[float, within(above=0, high=1)]
ReplicateLaw = Annotated[str, one_of(REPLICATE_LAWS)]


@dataclass(frozen=True)
class PointCloud:
    """Coloured points in space."""

    points: Float[Tensor, "n 3"]
    rgb: Float[Tensor, "n 3"]  # in [0, 1]

    def __len__(self) -> int:
        return self.points.shape[0]


@dataclass(frozen=True, kw_only=True)
class FromPoints(Initializer):
    """Base of the initializers that put round Gaussians at points."""

    scale: Positive | None  # world units
    scale_law: Annotated[str, one_of(SCALE_LAWS)]
    opacity: Annotated[float, within(above=0, below=1)]
    sh_degree: Annotated[int, whole(low=0, high=MAX_DEGREE)] | None

    def gaussians_at(self, cloud: PointCloud, device: torch.device) -> Gaussians:
        """Return round Gaussians on ``device`` that have the same colour from every side.

        They are at the points of a cloud in world units. If ``scale`` is None, each has the distance to its
        three nearest neighbours, so that neighbours just overlap.
        """
        points, n = cloud.points.to(device), len(cloud)
        law = self.scale_law
        scales = neighbour_distance(points, law) if self.scale is None else points.new_full((n,), self.scale)
        sh = points.new_zeros(n, ((self.sh_degree or 0) + 1) ** 2, 3)
        sh[:, 0] = rgb_to_sh0(cloud.rgb.to(device))
        return Gaussians(
            means=points,
            log_scales=scales.log()[:, None].repeat(1, 3),
            quats=points.new_tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1),
            opacity_logits=points.new_full((n,), math.log(self.opacity / (1 - self.opacity))),
            sh=sh,
        )


@dataclass(frozen=True, kw_only=True)
class FromObject(FromPoints):
    """Base of the initializers that move an object of its own size and front into the world."""

    turn_deg: Annotated[int, one_of(TURNS)]
    radius: Radius | None  # world units
    factor: Annotated[float, within(above=0, high=1000)] | None  # world units per unit of the object
    lift: Annotated[float, within(low=-1, high=1)]  # world units

    def __post_init__(self) -> None:
        super().__post_init__()
        is_one = self.factor is None or self.radius is None
        self.expect(is_one, "radius", f"null, since factor={self.factor} sets the size", "null")

    def placed(self, points: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "n 3"], float]:
        """Return points of the object, which is upright, in the world, and the factor of their distances.

        They are fitted to ``radius`` (:func:`fit`). With a ``factor`` they are multiplied by it instead, and
        not centred. Then they are lifted.
        """
        center, factor = fit(points, self.radius)
        factor = factor if self.factor is None else self.factor
        moved = (points - center) * factor
        if self.lift:
            moved[:, 2] += self.lift
        return moved, factor


def neighbour_distance(points: Float[Tensor, "n 3"], law: str = "mean") -> Float[Tensor, "n"]:
    """Return the mean distance of each point to its three nearest neighbours, or to all if there are fewer.

    With the ``law`` "rms" it is the root of the mean squared distance. The neighbours are exact. A single
    point gets 1, and no point gets less than 1e-4.
    """
    count = min(NEIGHBOURS, len(points) - 1)
    if count < 1:
        return torch.ones_like(points[:, 0])
    array = points.cpu().numpy()
    # The nearest neighbour that the tree finds is the point itself.
    distances, _ = KDTree(array).query(array, k=count + 1)
    power = {"mean": 1, "rms": 2}[law]
    combined = (distances[:, 1:] ** power).mean(axis=1) ** (1 / power)
    return torch.from_numpy(combined).to(points).clamp_min(SMALLEST)


def one_color(color: Sequence[float], count: int) -> Float[Tensor, "count 3"]:
    """Return the same RGB for ``count`` points."""
    return torch.tensor([float(channel) for channel in color]).repeat(count, 1)


def points_in_ball(count: int, radius: float, generator: torch.Generator) -> Float[Tensor, "count 3"]:
    """Draw random points with equal density everywhere in a ball around the origin."""
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    # The volume of a ball grows with the cube of its radius.
    radii = radius * torch.rand(count, 1, generator=generator) ** (1 / 3)
    return directions * radii


def points_on_surface(
    corners: Float[Tensor, "f 3 3"], count: int, generator: torch.Generator
) -> tuple[Int[Tensor, "count"], Float[Tensor, "count 3"]]:
    """Draw points that are uniform over the area of a surface.

    Returns the number of the triangle of each point and its barycentric weights within the triangle.
    """
    edges = corners[:, 1:] - corners[:, :1]
    areas = torch.linalg.cross(edges[:, 0], edges[:, 1], dim=-1).norm(dim=-1).double().cumsum(dim=0)
    drawn = torch.rand(count, generator=generator, dtype=torch.float64) * areas[-1]
    faces = torch.searchsorted(areas, drawn, right=True).clamp_max(len(areas) - 1)
    root, share = torch.rand(count, 2, generator=generator).unbind(dim=1)
    # The square root makes the points uniform over the area of the triangle.
    root = root.sqrt()
    return faces, torch.stack([1 - root, root * (1 - share), root * share], dim=1)


def rows_of(n: int, count: int | None, generator: torch.Generator) -> Int[Tensor, "rows"]:
    """Draw at most ``count`` of ``n`` rows, in ascending order; all rows if ``count`` is None."""
    if count is None or count >= n:
        return torch.arange(n)
    return torch.randperm(n, generator=generator)[:count].sort().values


def polar_points_in_ball(count: int, radius: float, generator: torch.Generator) -> Float[Tensor, "count 3"]:
    """Draw points in a ball with a uniform distance from the centre and two uniform angles.

    They are denser near the centre and near the vertical axis.
    """
    distance, inclination, turn = torch.rand(3, count, generator=generator)
    inclination, turn = math.pi * inclination, 2 * math.pi * turn
    flat = inclination.sin()
    directions = torch.stack([flat * turn.cos(), flat * turn.sin(), inclination.cos()], dim=1)
    return radius * distance[:, None] * directions


def replicated(
    cloud: PointCloud, times: int, radius: float, generator: torch.Generator, law: str = "even"
) -> PointCloud:
    """Repeat each point ``times`` times, with the same random offsets within a ball (LucidDreamer).

    The ``law`` "even" draws offsets with equal density everywhere in the ball. "polar" draws distance and
    angles uniformly, as LucidDreamer's code does. With ``times`` 1 the cloud is returned unchanged, without
    any random draw.
    """
    if times == 1:
        return cloud
    offsets = {"even": points_in_ball, "polar": polar_points_in_ball}[law](times, radius, generator)
    points = cloud.points.repeat_interleave(times, dim=0) + offsets.repeat(len(cloud), 1)
    return PointCloud(points, cloud.rgb.repeat_interleave(times, dim=0))


def grown(
    cloud: PointCloud, candidates: int, distance: float, noise: float, generator: torch.Generator
) -> PointCloud:
    """Add random points of the bounding box that are close to the cloud (GaussianDreamer's point growing).

    Of ``candidates`` points, those nearer than ``distance`` to a point of the cloud are added. Each takes the
    colour of its nearest point, plus a random amount of up to ``noise`` per channel.
    """
    low, high = cloud.points.amin(dim=0), cloud.points.amax(dim=0)
    drawn = low + (high - low) * torch.rand(candidates, 3, generator=generator)
    _, nearest = KDTree(cloud.points.numpy()).query(drawn.numpy(), distance_upper_bound=distance)
    neighbour = torch.from_numpy(nearest)
    # The tree returns len(cloud) if no point is within ``distance``.
    is_near = neighbour < len(cloud)
    rgb = cloud.rgb[neighbour[is_near]] + noise * torch.rand(int(is_near.sum()), 3, generator=generator)
    return PointCloud(torch.cat([cloud.points, drawn[is_near]]), torch.cat([cloud.rgb, rgb.clamp_max(1)]))


def fit(points: Float[Tensor, "n 3"], radius: float | None) -> tuple[Float[Tensor, "3"], float]:
    """Return the centre of the bounding box, and the factor that then moves the farthest point to ``radius``.

    Returns the origin and 1 if ``radius`` is None, so that position and size do not change. Raises
    ``UserError`` if the distances have no number in float32.
    """
    if radius is None:
        return torch.zeros_like(points[0]), 1.0
    center = (points.amin(dim=0) + points.amax(dim=0)) / 2
    farthest = float((points - center).norm(dim=-1).max())
    expected, got = "points at distances below 1e19", float(points.abs().max())
    require(math.isfinite(farthest), "initializer.path", expected=expected, got=got)
    return center, radius / farthest if farthest > 0 else 1.0
