"""Solids as signed distance functions: negative inside, positive outside, never larger than the distance.

Each kind of solid is defined in local coordinates and placed in the world by an affine map. A ray keeps its
parameter under an affine map, so sphere tracing in local coordinates is exact for stretched solids too: an
ellipsoid is a stretched ball and needs no approximate distance. Every function here is 1-Lipschitz and has
the right sign, which is all that sphere tracing requires (Hart 1996, sec. 2). Many are the maximum of a few
planes.

``kernels/trace.cpp`` has the same functions for vectors of rays. Both use the same operations of IEEE
arithmetic in the same order and no trigonometry, so that in float32 both find the same bits. A change of one
is therefore a change of both, and ``tests/prior/test_native_tracer.py`` compares them.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

# At most this many numbers describe the shape of a solid; most kinds use fewer.
SIZES_PER_SOLID = 4
STAR_POINTS = 5
AXES = {"x": 0, "y": 1, "z": 2}

# Maps points "3 n" and sizes "4 n", in local coordinates, to distances "n".
SdfFn = Callable[[Tensor, Tensor], Tensor]
# Maps directions "3 k" and sizes to the maximum of p . d over the points p of the solid, "k".
SupportFn = Callable[[Tensor, tuple[float, ...]], Tensor]


@dataclass(frozen=True, eq=False)
class Kind:
    """A family of solids."""

    name: str
    sdf: SdfFn
    support: SupportFn
    wrap: str  # coordinates of patterns: "ring" (two angles), "round" (azimuth, height) or "flat" (x, y, z)


@dataclass(frozen=True, eq=False)
class Solid:
    """One solid in the world: world = matrix @ local + offset."""

    kind: Kind
    size: tuple[float, ...]
    matrix: Float[Tensor, "3 3"]
    offset: Float[Tensor, "3"]

    def at(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> "Solid":
        """Return the solid moved by a vector."""
        return replace(self, offset=self.offset + torch.tensor([x, y, z], dtype=torch.float64))

    def turned(self, axis: str, degrees: float) -> "Solid":
        """Return the solid turned about a world axis through the origin, right-handed."""
        return self.mapped(rotation(axis, degrees))

    def stretched(self, x: float = 1.0, y: float = 1.0, z: float = 1.0) -> "Solid":
        """Return the solid stretched along the world axes, about the origin."""
        return self.mapped(torch.diag(torch.tensor([x, y, z], dtype=torch.float64)))

    def mapped(self, matrix: Float[Tensor, "3 3"]) -> "Solid":
        """Return the solid under a linear map of the world."""
        return replace(self, matrix=matrix @ self.matrix, offset=matrix @ self.offset)

    def support(self, directions: Float[Tensor, "3 k"]) -> Float[Tensor, "k"]:
        """Return how far the solid extends along each direction: the maximum of p . d over its points p."""
        return self.kind.support(self.matrix.T @ directions, self.size) + self.offset @ directions

    def distance(self, points: Float[Tensor, "3 n"]) -> Float[Tensor, "n"]:
        """Return a lower bound of the world distance to the surface, with the exact sign."""
        local = torch.linalg.inv(self.matrix) @ (points - self.offset[:, None])
        sizes = size_row(self.size)[:, None].expand(-1, local.shape[1])
        return self.kind.sdf(local, sizes) * torch.linalg.svdvals(self.matrix)[-1]


def size_row(size: tuple[float, ...]) -> Float[Tensor, "4"]:
    """Return the sizes of a solid, padded with zeros to ``SIZES_PER_SOLID``."""
    return torch.tensor((*size, *[0.0] * (SIZES_PER_SOLID - len(size))), dtype=torch.float64)


def rotation(axis: str, degrees: float) -> Float[Tensor, "3 3"]:
    """Return the right-handed rotation about a world axis."""
    angle, first = math.radians(degrees), (AXES[axis] + 1) % 3
    second = (first + 1) % 3
    matrix = torch.eye(3, dtype=torch.float64)
    matrix[first, first] = matrix[second, second] = math.cos(angle)
    matrix[first, second], matrix[second, first] = -math.sin(angle), math.sin(angle)
    return matrix


def root(x: Tensor) -> Tensor:
    """Return the square root from operations that IEEE arithmetic rounds in one way.

    ``torch.sqrt`` calls a library on some machines, which rounds differently.
    """
    return x * x.clamp_min(1e-30).rsqrt()


BALL = Kind(
    "ball",
    lambda p, size: root(p[0] * p[0] + p[1] * p[1] + p[2] * p[2]) - size[0],
    lambda d, size: size[0] * d.norm(dim=0),
    "round",
)

# Half lengths.
BOX = Kind(
    "box",
    lambda p, size: (p.abs() - size[:3]).amax(0),
    lambda d, size: torch.tensor(size, dtype=d.dtype) @ d.abs(),
    "flat",
)


def _frustum_sdf(p: Tensor, size: Tensor) -> Tensor:
    bottom, top, half = size[0], size[1], size[2]
    slope = (bottom - top) / (2 * half)
    radius = root(p[0] * p[0] + p[1] * p[1])
    side = (radius - (bottom + top) / 2 + slope * p[2]) * torch.rsqrt(1 + slope * slope)
    return torch.maximum(side, p[2].abs() - half)


def _frustum_support(d: Tensor, size: tuple[float, ...]) -> Tensor:
    bottom, top, half = size
    across = d[:2].norm(dim=0)
    return torch.maximum(bottom * across - half * d[2], top * across + half * d[2])


# About z: bottom radius, top radius, half height (cylinder, cone, disc).
FRUSTUM = Kind("frustum", _frustum_sdf, _frustum_support, "round")


def _tube_sdf(p: Tensor, size: Tensor) -> Tensor:
    outer, inner, half = size[0], size[1], size[2]
    radius = root(p[0] * p[0] + p[1] * p[1])
    wall = (radius - (outer + inner) / 2).abs() - (outer - inner) / 2
    return torch.maximum(wall, p[2].abs() - half)


# About z: outer radius, inner radius, half height.
TUBE = Kind(
    "tube",
    _tube_sdf,
    lambda d, size: size[0] * d[:2].norm(dim=0) + size[2] * d[2].abs(),
    "round",
)


def _torus_sdf(p: Tensor, size: Tensor) -> Tensor:
    away = root(p[0] * p[0] + p[1] * p[1]) - size[0]
    return root(away * away + p[2] * p[2]) - size[1]


# About z: ring radius, pipe radius.
TORUS = Kind(
    "torus",
    _torus_sdf,
    lambda d, size: size[0] * d[:2].norm(dim=0) + size[1] * d.norm(dim=0),
    "ring",
)


def _arc_sdf(p: Tensor, size: Tensor) -> Tensor:
    x, ring, sine, cosine = p[0].abs(), size[0], size[2], size[3]
    away = root(x * x + p[1] * p[1]) - ring
    dx, dy = x - ring * sine, p[1] - ring * cosine
    # The sine of the difference between the angles of the point and of the end.
    is_beyond = x * cosine > p[1] * sine
    return root(torch.where(is_beyond, dx * dx + dy * dy, away * away) + p[2] * p[2]) - size[1]


def _arc_support(d: Tensor, size: tuple[float, ...]) -> Tensor:
    x = d[0].abs()
    angle = torch.atan2(x, d[1]).clamp(max=math.atan2(size[2], size[3]))
    return size[0] * (angle.sin() * x + angle.cos() * d[1]) + size[1] * d.norm(dim=0)


# A torus within an angle of +y, with round ends: ring radius, pipe radius, sine and cosine of the angle.
ARC = Kind("arc", _arc_sdf, _arc_support, "ring")


def _capsule_sdf(p: Tensor, size: Tensor) -> Tensor:
    beyond = (p[2].abs() - size[1]).clamp_min(0)
    return root(p[0] * p[0] + p[1] * p[1] + beyond * beyond) - size[0]


# About z: radius, half length of its axis.
CAPSULE = Kind(
    "capsule",
    _capsule_sdf,
    lambda d, size: size[0] * d.norm(dim=0) + size[1] * d[2].abs(),
    "round",
)


def _star_sdf(p: Tensor, size: Tensor) -> Tensor:
    # Fold the plane into one half of one point. Reflections keep distances, so the result is still a bound.
    across, along, sector = p[1].abs(), p[2], math.pi / STAR_POINTS
    for angle in (3 * sector, sector):
        beyond = 2 * (across * math.cos(angle) - along * math.sin(angle)).clamp_min(0)
        across, along = across - beyond * math.cos(angle), along + beyond * math.sin(angle)
    # The edge runs from the tip (outer, 0) to the notch (inner cos sector, inner sin sector).
    edge_x, edge_y = size[1] * math.cos(sector) - size[0], size[1] * math.sin(sector)
    side = edge_y * (along - size[0]) - edge_x * across.abs()
    return torch.maximum(side * torch.rsqrt(edge_x * edge_x + edge_y * edge_y), p[0].abs() - size[2])


def _star_support(d: Tensor, size: tuple[float, ...]) -> Tensor:
    angles = 2 * math.pi / STAR_POINTS * torch.arange(STAR_POINTS, dtype=d.dtype)
    tips = size[0] * torch.stack([angles.sin(), angles.cos()], dim=1)
    return (tips @ d[1:]).amax(0) + size[2] * d[0].abs()


# Five points in the y-z plane, one up, thick along x: outer radius, inner radius, half thickness.
STAR = Kind("star", _star_sdf, _star_support, "flat")


# --- polytopes: the maximum of their planes; they have no sizes, and only their matrix changes their shape

_ROOT2, _ROOT3, _ROOT5 = math.sqrt(2), math.sqrt(3), math.sqrt(5)


def _pyramid_sdf(p: Tensor, size: Tensor) -> Tensor:
    side = (2 * torch.maximum(p[0].abs(), p[1].abs()) + p[2] - 1) * (1 / _ROOT5)
    return torch.maximum(side, -1 - p[2])


def _gable_sdf(p: Tensor, size: Tensor) -> Tensor:
    slope = (2 * p[1].abs() + p[2] - 1) * (1 / _ROOT5)
    return torch.maximum(torch.maximum(slope, p[0].abs() - 1), -1 - p[2])


def _tetrahedron_sdf(p: Tensor, size: Tensor) -> Tensor:
    rise = p[2] * (1 / 3)
    sides = p[0] * (_ROOT2 / 3) + p[1].abs() * (_ROOT2 / _ROOT3) + rise
    return torch.maximum(torch.maximum(sides, rise - p[0] * (2 * _ROOT2 / 3)), -p[2]) - 1 / 3


def _polytope(name: str, sdf: SdfFn, corners: list[list[float]]) -> Kind:
    """Return the kind with this distance and these corners."""
    points = torch.tensor(corners, dtype=torch.float64)

    def support(d: Tensor, size: tuple[float, ...]) -> Tensor:
        return (points.to(d) @ d).amax(0)

    return Kind(name, sdf, support, "flat")


# A square base of side 2 at z = -1 and an apex at z = 1.
PYRAMID = _polytope("pyramid", _pyramid_sdf, [[0, 0, 1], [1, 1, -1], [1, -1, -1], [-1, 1, -1], [-1, -1, -1]])
# A roof: a base of side 2 at z = -1 and a ridge along x at z = 1.
GABLE = _polytope(
    "gable", _gable_sdf, [[1, 0, 1], [-1, 0, 1], [1, 1, -1], [1, -1, -1], [-1, 1, -1], [-1, -1, -1]]
)
# A regular tetrahedron of circumradius 1, with one face below.
TETRAHEDRON = _polytope(
    "tetrahedron",
    _tetrahedron_sdf,
    [
        [0, 0, 1],
        [2 * _ROOT2 / 3, 0, -1 / 3],
        [-_ROOT2 / 3, _ROOT2 / _ROOT3, -1 / 3],
        [-_ROOT2 / 3, -_ROOT2 / _ROOT3, -1 / 3],
    ],
)
OCTAHEDRON = _polytope(
    "octahedron",
    lambda p, size: (p[0].abs() + p[1].abs() + p[2].abs() - 1) * (1 / _ROOT3),
    [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]],
)
KINDS = (BALL, BOX, FRUSTUM, TUBE, TORUS, ARC, CAPSULE, STAR, PYRAMID, GABLE, TETRAHEDRON, OCTAHEDRON)


# --- constructors: they take full lengths, and the solids are centred on the origin


def _solid(kind: Kind, *size: float, stretch: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> Solid:
    matrix = torch.diag(torch.tensor(stretch, dtype=torch.float64))
    return Solid(kind=kind, size=size, matrix=matrix, offset=torch.zeros(3, dtype=torch.float64))


def ball(radius: float) -> Solid:
    """Return a ball."""
    return _solid(BALL, radius)


def ellipsoid(x: float, y: float, z: float) -> Solid:
    """Return an ellipsoid with these half axes."""
    return _solid(BALL, 1.0, stretch=(x, y, z))


def box(x: float, y: float, z: float) -> Solid:
    """Return a box with these side lengths."""
    return _solid(BOX, x / 2, y / 2, z / 2)


def cylinder(radius: float, height: float) -> Solid:
    """Return a cylinder about z."""
    return _solid(FRUSTUM, radius, radius, height / 2)


def frustum(bottom: float, top: float, height: float) -> Solid:
    """Return a cone about z that is cut off at the ``top`` radius."""
    return _solid(FRUSTUM, bottom, top, height / 2)


def cone(radius: float, height: float) -> Solid:
    """Return a cone about z with its apex up."""
    return _solid(FRUSTUM, radius, 0.0, height / 2)


def tube(outer: float, inner: float, height: float) -> Solid:
    """Return a cylinder about z with a hole."""
    return _solid(TUBE, outer, inner, height / 2)


def torus(ring: float, pipe: float) -> Solid:
    """Return a torus about z with these radii of the ring and of the pipe."""
    return _solid(TORUS, ring, pipe)


def arc(ring: float, pipe: float, degrees: float) -> Solid:
    """Return the part of a torus about z within ``degrees`` to either side of +y."""
    angle = math.radians(degrees)
    return _solid(ARC, ring, pipe, math.sin(angle), math.cos(angle))


def capsule(radius: float, length: float) -> Solid:
    """Return a cylinder about z with round ends, ``length`` from end to end."""
    return _solid(CAPSULE, radius, length / 2 - radius)


def star(outer: float, inner: float, thickness: float) -> Solid:
    """Return a five-pointed star that faces +x."""
    return _solid(STAR, outer, inner, thickness / 2)


def pyramid(x: float, y: float, z: float) -> Solid:
    """Return a pyramid on a rectangular base."""
    return _solid(PYRAMID, stretch=(x / 2, y / 2, z / 2))


def gable(x: float, y: float, z: float) -> Solid:
    """Return a gable roof with its ridge along x."""
    return _solid(GABLE, stretch=(x / 2, y / 2, z / 2))


def tetrahedron(radius: float) -> Solid:
    """Return a regular tetrahedron in a ball of ``radius``, with one face below."""
    return _solid(TETRAHEDRON, stretch=(radius, radius, radius))


def octahedron(x: float, y: float, z: float) -> Solid:
    """Return an octahedron with these half diagonals."""
    return _solid(OCTAHEDRON, stretch=(x, y, z))
