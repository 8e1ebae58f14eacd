"""From coloured points to Gaussians: functions shared by the initializers that start from a point cloud."""

import difflib
import math
import shlex
import stat
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from cadam3d.core.checks import require, require_choice, require_range, require_whole
from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.memory import require_memory
from cadam3d.core.sh import MAX_DEGREE, rgb_to_sh0
from cadam3d.io.frames import TURNS
from cadam3d.io.reading import KINDS

# As in 3DGS (Kerbl et al. 2023, sec. 5.1).
NEIGHBOURS = 3
# Keeps the size of coincident points above zero.
SMALLEST = 1e-4  # world units


@dataclass(frozen=True)
class PointCloud:
    """Coloured points in space."""

    points: Float[Tensor, "n 3"]
    rgb: Float[Tensor, "n 3"]  # in [0, 1]

    def __len__(self) -> int:
        return self.points.shape[0]

    def to(self, device: torch.device) -> "PointCloud":
        """Return the same cloud on ``device``."""
        return PointCloud(self.points.to(device), self.rgb.to(device))


def gaussians_at(cloud: PointCloud, *, scale: float | None, opacity: float, sh_degree: int) -> Gaussians:
    """Return round Gaussians at the points (world units) that have the same colour from every side.

    ``scale`` is their standard deviation in world units. None gives each Gaussian the mean distance to its
    three nearest neighbours, so that neighbours just overlap.
    """
    points, n = cloud.points, len(cloud)
    scales = neighbour_distance(points) if scale is None else points.new_full((n,), scale)
    sh = points.new_zeros(n, (sh_degree + 1) ** 2, 3)
    sh[:, 0] = rgb_to_sh0(cloud.rgb)
    return Gaussians(
        means=points,
        log_scales=scales.log()[:, None].repeat(1, 3),
        quats=points.new_tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1),
        opacity_logits=points.new_full((n,), math.log(opacity / (1 - opacity))),
        sh=sh,
    )


def neighbour_distance(points: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    """Return the mean distance of each point to its three nearest neighbours, or to all if there are fewer.

    The neighbours are exact. A single point gets 1, and no point gets less than 1e-4.
    """
    count = min(NEIGHBOURS, len(points) - 1)
    if count < 1:
        return torch.ones_like(points[:, 0])
    array = points.cpu().numpy()
    # The nearest neighbour that the tree finds is the point itself.
    distances, _ = KDTree(array).query(array, k=count + 1)
    return torch.from_numpy(distances[:, 1:].mean(axis=1)).to(points).clamp_min(SMALLEST)


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


def replicated(cloud: PointCloud, times: int, radius: float, generator: torch.Generator) -> PointCloud:
    """Repeat each point ``times`` times, with the same random offsets within a ball (LucidDreamer).

    With ``times`` 1 the cloud is returned unchanged, without any random draw.
    """
    if times == 1:
        return cloud
    offsets = points_in_ball(times, radius, generator)
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
    require(
        math.isfinite(farthest),
        "initializer.path",
        expected="points at distances below 1e19",
        got=float(points.abs().max()),
        example="initializer.radius=null",
    )
    return center, radius / farthest if farthest > 0 else 1.0


def found_file(path: str, option: str, suffixes: Sequence[str]) -> Path:
    """Return the path that ``initializer.path`` names. Raises ``UserError`` unless it is a file."""
    found = Path(path).expanduser()
    # The system refuses some names, such as one that is too long.
    try:
        kind = stat.S_IFMT(found.stat().st_mode)
    except (OSError, ValueError):
        kind = 0
    if kind != stat.S_IFREG:
        what = f"is {KINDS.get(kind, 'no file')}" if kind else "does not exist"
        raise UserError(
            f"initializer.path: expected a file, got {path!r}, which {what}. "
            f"Try: {another_file(path, option, suffixes)}"
        )
    return found


def another_file(path: str, option: str, suffixes: Sequence[str]) -> str:
    """Return what to type instead of a file that initializer=``option`` cannot read.

    This is the file with the nearest name and one of ``suffixes``, in the same folder or in the current one.
    If there is none, it is the help of the option.
    """
    wrong = Path(path).expanduser()
    files = [*(_content(wrong) or _content(wrong.parent)), *_content(Path())]
    known = {
        file.name: file
        for file in reversed(files)
        if file.suffix.lower() in suffixes and file != wrong and file.is_file()
    }
    near = difflib.get_close_matches(wrong.name, list(known), n=1, cutoff=0.0)
    if not near:
        return f"cadam3d train --help initializer={option}"
    return shlex.quote(f"initializer.path={known[near[0]]}")


def _content(folder: Path) -> list[Path]:
    """Return the sorted content of a folder; nothing for a path that the system cannot list as a folder."""
    try:
        return sorted(folder.iterdir())
    # ValueError: the path has a null byte.
    except (OSError, ValueError):
        return []


def require_points(count: int, scale: object, opacity: object, sh_degree: object) -> None:
    """Raise ``UserError`` unless these keys of an initializer are in their ranges."""
    require_whole("initializer.count", count, low=1, example=2000)
    if scale is not None:
        require_range("initializer.scale", scale, above=0, example=0.03)
    require_range("initializer.opacity", opacity, above=0, below=1, example=0.1)
    require_whole("initializer.sh_degree", sh_degree, low=0, high=MAX_DEGREE, example=0)


def require_place(turn_deg: object, radius: object) -> None:
    """Raise ``UserError`` unless the turn is a multiple of 90 degrees and the radius is None or in (0, 1]."""
    require_choice("initializer.turn_deg", turn_deg, TURNS)
    if radius is not None:
        require_range("initializer.radius", radius, above=0, high=1, example=0.9)


def require_count(count: int, sh_degree: int) -> None:
    """Raise ``UserError`` unless that many Gaussians can be trained in the memory of this machine.

    Each number of a Gaussian is stored with its gradient and its two moments, in single precision.
    """
    numbers = 11 + 3 * (sh_degree + 1) ** 2
    require_memory("initializer.count", count, unit=16 * numbers, example=2000)


def require_copies(replicate: int, replicate_radius: object) -> None:
    """Raise ``UserError`` unless ``replicate`` is at least 1 and ``replicate_radius`` is in (0, 1]."""
    require_whole("initializer.replicate", replicate, low=1, example=20)
    require_memory("initializer.replicate", replicate, unit=16 * 14, example=20)
    require_range("initializer.replicate_radius", replicate_radius, above=0, high=1, example=0.05)
