"""Sphere tracing: a ray advances by the distance to the surface until it touches the surface (Hart 1996).

Every part is traced separately, in its local coordinates and only by rays that hit its bounding box; the
nearest hit is visible. All parts of one kind are traced together, so that the number of tensor operations
does not grow with the number of parts.

``kernels/trace.cpp`` does the same on vectors of rays, with the same operations in the same order. Therefore
sums of three products are written out here: a matrix product may add them in any order.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from cadam3d.core.cameras import Cameras
from cadam3d.prior.light import dot, light_on, normalized
from cadam3d.prior.shapes.scene import PATTERN_NAMES, Scene, sphere_directions
from cadam3d.prior.shapes.solids import Kind, root

MARCH_STEPS = 48
# Steps between removals of the rays that have hit or missed.
COMPACT_EVERY = 4
# A ray this close to the surface has hit it. A pixel of a typical view is thirty times wider.
HIT_DISTANCE = 5e-4  # world units
# After the last step, a ray this close to the surface has hit it too.
GRAZE_DISTANCE = 4e-3  # world units
# The ball of this radius contains every scene, since scenes are scaled to FIT_RADIUS.
BALL_RADIUS = 0.9  # world units
# As in the rasterizers.
NEAR = 0.01  # world units
# The step of the finite differences that give normals.
NORMAL_STEP = 1e-3  # local coordinates
SPOTS = 26
# The cosine of the angular radius of a spot.
SPOT_COSINE = 0.965


@dataclass(frozen=True)
class Layers:
    """A rendered scene before its colours are chosen; one product with its albedo gives each mode."""

    alpha: Float[Tensor, "v h w"]  # in [0, 1]
    paints: Float[Tensor, "v h w paints"]  # light from each paint, premultiplied with its coverage

    def images(
        self, albedo: Float[Tensor, "m paints 3"], background: Float[Tensor, "v 3"]
    ) -> Float[Tensor, "v m 3 h w"]:
        """Return the image of every mode over the background, in [0, 1]."""
        colour = torch.einsum("vhwp,mpc->vmchw", self.paints, albedo)
        backdrop = torch.einsum("vhw,vc->vchw", 1 - self.alpha, background)
        return colour + backdrop[:, None]


@dataclass(frozen=True)
class _Rays:
    """Rays of all views that hit the bounding ball of the scene, sorted by view."""

    origins: Float[Tensor, "v 3"]
    directions: Float[Tensor, "3 r"]  # unit length
    views: Int[Tensor, "r"]
    pixels: Int[Tensor, "r"]  # number of the pixel among all pixels of all views
    per_view: tuple[int, ...]  # number of rays of each view


@torch.no_grad()
def trace(scene: Scene, cameras: Cameras, samples: int) -> Layers:
    """Render with ``samples`` x ``samples`` rays per pixel, on the device and in the dtype of the cameras."""
    rays = _cast(cameras, samples)
    ray, part, local = _first_hits(scene, rays)
    light, paint = _shade(scene, part, local)
    pixel, share = rays.pixels[ray], 1.0 / samples**2
    shape = (len(cameras), cameras.height, cameras.width)
    count, paints = math.prod(shape), scene.albedo.shape[1]
    alpha = light.new_zeros(count).index_add_(0, pixel, torch.full_like(light, share))
    sent = light.new_zeros(count * paints).index_add_(0, pixel * paints + paint, light * share)
    return Layers(alpha=alpha.reshape(shape).clamp_max(1.0), paints=sent.reshape(*shape, paints))


def _cast(cameras: Cameras, samples: int) -> _Rays:
    """Return rays through a regular grid of points in every pixel, without those that miss the ball."""
    fine = cameras.resize(cameras.height * samples, cameras.width * samples)
    origins, to_world = fine.positions, ray_matrices(fine)
    like = {"dtype": fine.intrinsics.dtype, "device": fine.intrinsics.device}
    rows, columns = torch.arange(fine.height, **like), torch.arange(fine.width, **like)
    y, x = torch.meshgrid(rows + 0.5, columns + 0.5, indexing="ij")
    u, v, w = to_world[:, :, :, None].unbind(2)  # columns, "v 3 1" each
    direction = normalized((u * x.flatten() + v * y.flatten() + w).transpose(0, 1))  # "3 v r"

    along = dot(origins.T[:, :, None], direction)
    apart = dot(origins.T, origins.T)[:, None] - along.clamp_max(0).square()
    view, sample = (apart <= BALL_RADIUS**2).nonzero(as_tuple=True)
    row = torch.div(sample, fine.width * samples, rounding_mode="floor")
    column = torch.div(sample % fine.width, samples, rounding_mode="floor")
    return _Rays(
        origins=origins,
        directions=direction.flatten(1).index_select(1, view * y.numel() + sample),
        views=view,
        pixels=(view * cameras.height + row) * cameras.width + column,
        per_view=tuple(torch.bincount(view, minlength=len(cameras)).tolist()),
    )


def ray_matrices(fine: Cameras) -> Float[Tensor, "v 3 3"]:
    """Return the matrices that map (x, y, 1), in pixels, to the direction of a ray, of any length."""
    return fine.world_to_camera[:, :3, :3].transpose(1, 2) @ torch.linalg.inv(fine.intrinsics)


def local_origins(scene: Scene, origins: Float[Tensor, "v 3"]) -> Float[Tensor, "v p 3"]:
    """Return the origins of the rays in the local coordinates of every part."""
    return torch.einsum("pij,vpj->vpi", scene.to_local, origins[:, None] - scene.offsets[None])


def ball_limits(
    scene: Scene, origins: Float[Tensor, "v 3"]
) -> tuple[Float[Tensor, "v p 3"], Float[Tensor, "v p"]]:
    """Return the centres of the bounding balls as seen from each origin, and a limit for each ball.

    A ray hits the ball if the product of its direction with the centre is at least the limit.
    """
    away = scene.centres - origins[:, None]
    # The condition |away|^2 - towards^2 <= radius^2, solved for `towards`, which differs between rays.
    beyond = away.square().sum(2) - scene.radii.square()
    return away, torch.where(beyond > 0, beyond.clamp_min(0).sqrt(), -torch.inf)


def _candidates(scene: Scene, rays: _Rays) -> tuple[Int[Tensor, "n"], Int[Tensor, "n"]]:
    """Return the pairs (part, ray) in which the ray hits the bounding ball of the part, sorted by part."""
    balls = zip(*ball_limits(scene, rays.origins), rays.directions.split(rays.per_view, dim=1), strict=True)
    masks = [
        dot(away.T[:, :, None], direction[:, None]) >= least[:, None] for away, least, direction in balls
    ]
    part, ray = torch.cat(masks, dim=1).nonzero(as_tuple=True)
    return part, ray


def _first_hits(scene: Scene, rays: _Rays) -> tuple[Int[Tensor, "n"], Int[Tensor, "n"], Float[Tensor, "3 n"]]:
    """Return each ray that hits a part, the part, and the point in its local coordinates, sorted by part."""
    part, ray = _candidates(scene, rays)
    # The same rays in the local coordinates of the parts. The ray parameter stays in world units.
    start = local_origins(scene, rays.origins).flatten(0, 1).T
    origin = start.index_select(1, rays.views[ray] * len(scene.radii) + part)
    direction = dot(_matrices(scene, part).transpose(0, 1), rays.directions.index_select(1, ray)[:, None])
    begin, end = _box_interval(scene, part, origin, direction)
    inside = (begin < end).nonzero()[:, 0]
    part, ray, begin, end = part[inside], ray[inside], begin[inside], end[inside]
    origin, direction = origin.index_select(1, inside), direction.index_select(1, inside)

    sizes = scene.sizes.T.index_select(1, part)
    reached = torch.full_like(begin, torch.inf)
    for kind, rows in _runs(scene, part):
        reached[rows] = _march(
            kind, origin[:, rows], direction[:, rows], sizes[:, rows], begin[rows], end[rows]
        )

    nearest = torch.full_like(rays.directions[0], torch.inf).scatter_reduce_(0, ray, reached, "amin")
    first = ((reached <= nearest[ray]) & reached.isfinite()).nonzero()[:, 0]
    # If a ray hits two parts at the same point, the later part is chosen, so that no ray counts twice.
    winner = torch.full_like(rays.views, -1).scatter_reduce_(0, ray[first], first, "amax")
    chosen = winner[winner >= 0].sort().values
    point = origin.index_select(1, chosen) + reached[chosen] * direction.index_select(1, chosen)
    return ray[chosen], part[chosen], point


def _matrices(scene: Scene, part: Int[Tensor, "n"]) -> Float[Tensor, "3 3 n"]:
    """Return ``to_local`` of the given parts; [i, j] is row i and column j of the matrices."""
    return scene.to_local.flatten(1).T.contiguous().index_select(1, part).reshape(3, 3, -1)


def _box_interval(scene: Scene, part: Tensor, origin: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
    """Return the ray parameters where each ray enters and leaves the box of its part, beyond ``NEAR``."""
    tiny = torch.full_like(direction, 1e-12)
    inverse = 1 / torch.where(direction.abs() < 1e-12, tiny, direction)
    first = (scene.low.T.index_select(1, part) - origin) * inverse
    second = (scene.high.T.index_select(1, part) - origin) * inverse
    begin = torch.minimum(first, second).amax(0).clamp_min(NEAR)
    # Slightly longer than the box, since rounding can empty the interval of a ray along a flat face.
    return begin, torch.maximum(first, second).amin(0) + HIT_DISTANCE


def _march(
    kind: Kind, origin: Tensor, direction: Tensor, sizes: Tensor, begin: Tensor, end: Tensor
) -> Tensor:
    """Return the ray parameter of the first point on the surface, or infinity for a miss."""
    reached = torch.full_like(begin, torch.inf)
    rows = torch.arange(len(begin), device=begin.device)
    t, speed = begin, dot(direction, direction).rsqrt()
    for step in range(MARCH_STEPS):
        advance = kind.sdf(origin + t * direction, sizes) * speed
        t = t + advance
        if step % COMPACT_EVERY != COMPACT_EVERY - 1:
            continue
        is_hit = advance < (HIT_DISTANCE if step < MARCH_STEPS - 1 else GRAZE_DISTANCE)
        is_hit &= t <= end
        reached[rows[is_hit]] = t[is_hit]
        alive = ((~is_hit) & (t < end)).nonzero()[:, 0]
        if len(alive) == 0:
            break
        rows, t, end, speed = rows[alive], t[alive], end[alive], speed[alive]
        origin, direction, sizes = (x.index_select(1, alive) for x in (origin, direction, sizes))
    return reached


def _runs(scene: Scene, part: Tensor) -> list[tuple[Kind, slice]]:
    """Return the rows of each kind, given part numbers in ascending order."""
    runs, first, begin = [], 0, 0
    for kind, count in scene.kinds:
        first += count
        end = int(torch.searchsorted(part, first))
        if end > begin:
            runs.append((kind, slice(begin, end)))
        begin = end
    return runs


# --- light and paint


def _shade(scene: Scene, part: Tensor, local: Tensor) -> tuple[Float[Tensor, "n"], Int[Tensor, "n"]]:
    """Return the light in [0, 1] and the paint of every visible point."""
    sizes = scene.sizes.T.index_select(1, part)
    normal = torch.empty_like(local)
    for kind, rows in _runs(scene, part):
        normal[:, rows] = _gradient(kind, local[:, rows], sizes[:, rows])
    # A normal is mapped to the world by the transposed inverse of the matrix that maps points.
    normal = normalized(dot(_matrices(scene, part), normal[:, None]))
    sent = light_on(normal)

    is_second = torch.zeros_like(part, dtype=torch.bool)
    pattern = scene.patterns[part]
    for kind, rows in _runs(scene, part):
        for index, name in enumerate(PATTERN_NAMES):
            chosen = (pattern[rows] == index).nonzero()[:, 0] + rows.start
            if index == 0 or len(chosen) == 0:
                continue
            own = part[chosen]
            box = ((scene.high + scene.low) / 2).T[:, own], ((scene.high - scene.low) / 2).T[:, own]
            is_second[chosen] = _paint_second(kind, name, local[:, chosen], sizes[:, chosen], box)
    return sent, torch.where(is_second, scene.paints[part, 1], scene.paints[part, 0])


def _gradient(kind: Kind, points: Tensor, sizes: Tensor) -> Tensor:
    """Return the gradient of the distance, up to a factor, from a tetrahedron of points around each point."""
    corners = points.new_tensor([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    probes = points[:, None] + NORMAL_STEP * corners.T[:, :, None]
    a, b, c, d = kind.sdf(probes.flatten(1), sizes.repeat(1, 4)).reshape(4, -1)
    return torch.stack([a + b - c - d, a - b + c - d, a - b - c + d])


def _paint_second(
    kind: Kind, pattern: str, p: Tensor, sizes: Tensor, box: tuple[Tensor, Tensor]
) -> Bool[Tensor, "n"]:
    """Return whether each point has the second colour of its pattern."""
    centre, half = box
    unit = (p - centre) / half  # in [-1, 1]
    if kind.wrap == "ring":
        turn, roll = torch.atan2(p[1], p[0]), torch.atan2(p[2], root(p[0] * p[0] + p[1] * p[1]) - sizes[0])
        return _ring_pattern(pattern, turn / torch.pi, roll / torch.pi)
    if pattern == "spotted":
        return (sphere_directions(SPOTS).to(p) @ normalized(unit)).amax(0) > SPOT_COSINE
    if kind.wrap == "flat":
        # Slightly smaller, so that faces are not on the border between two cells.
        inner = 0.999 * unit
        if pattern == "striped":
            return _is_odd((inner[2] + 1) * 3)
        return _is_odd_sum((inner + 1) * 2)
    across = root(unit[0] * unit[0] + unit[1] * unit[1]).clamp_max(1)
    if kind.name == "ball":
        band = 3 * torch.asin(unit[2].clamp(-1, 1)) / (torch.pi / 2)
    else:
        # Bands run up the side and then over the top to the axis.
        reach, rise = half[:2].amax(0), half[2]
        band = 4 * (unit[2] * rise + (1 - across) * reach) / (reach + rise)
    if pattern == "striped":
        return _is_odd(band)
    azimuth = torch.atan2(p[1], p[0]) / torch.pi
    return _is_odd_sum(torch.stack([band, 4 * azimuth + 4]))


def _ring_pattern(pattern: str, turn: Tensor, roll: Tensor) -> Bool[Tensor, "n"]:
    """Return the pattern on a torus; both angles are in half turns, in [-1, 1]."""
    if pattern == "striped":
        return _is_odd((turn + 1) * 8)
    if pattern == "checkered":
        return _is_odd_sum(torch.stack([(turn + 1) * 7, (roll + 1) * 4]))
    # One spot per cell of a staggered grid. Spots are round, since a cell is about as long as it is high.
    along, around = (turn + 1) * 6, (roll + 1) * 2
    around = around + 0.5 * torch.remainder(along.floor(), 2)
    return (torch.remainder(along, 1) - 0.5).square() + (torch.remainder(around, 1) - 0.5).square() < 0.09


def _is_odd(x: Tensor) -> Bool[Tensor, "n"]:
    return torch.remainder(x.floor(), 2) == 1


def _is_odd_sum(x: Tensor) -> Bool[Tensor, "n"]:
    return torch.remainder(x.floor().sum(0), 2) == 1
