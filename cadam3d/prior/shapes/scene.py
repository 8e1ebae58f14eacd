"""From a sentence to a scene: objects are painted, placed and scaled to fit into the unit ball."""

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache

import torch
from jaxtyping import Float, Int
from torch import Tensor

from cadam3d.prior.shapes.grammar import Phrase, Sentence, parse
from cadam3d.prior.shapes.objects import (
    ACCENT,
    MAIN,
    OPEN,
    PLAIN,
    Coat,
    Part,
    Thing,
    bounds,
    moved,
    stretched,
    thing,
)
from cadam3d.prior.shapes.solids import KINDS, Kind, size_row
from cadam3d.prior.shapes.words import COLOURS, OPEN_PALETTE, PATTERNS

# Every scene fits in the ball of this radius around the origin.
FIT_RADIUS = 0.85
# The gap between neighbours, in units of a natural radius of 1.
CLEARANCE = 0.12
# The depth by which an object sinks into its support, so that no gap is visible between them.
SINK = 0.01
# The k-th object of open colour takes the palette shifted by 3 k, so that the colours of objects differ.
OPEN_STRIDE = 3
SUPPORT_DIRECTIONS = 512
PATTERN_NAMES = tuple(dict.fromkeys(PATTERNS.values()))


@dataclass(frozen=True)
class Scene:
    """The input of the tracer, one row per part; parts of the same kind are in consecutive rows."""

    kinds: tuple[tuple[Kind, int], ...]  # kind and number of parts, in row order
    to_local: Float[Tensor, "p 3 3"]  # local = to_local @ (world - offsets)
    offsets: Float[Tensor, "p 3"]
    sizes: Float[Tensor, "p 4"]
    low: Float[Tensor, "p 3"]  # tight box in local coordinates
    high: Float[Tensor, "p 3"]
    centres: Float[Tensor, "p 3"]  # bounding ball in the world
    radii: Float[Tensor, "p"]
    patterns: Int[Tensor, "p"]  # index into PATTERN_NAMES
    paints: Int[Tensor, "p 2"]  # first and second column of ``albedo``
    albedo: Float[Tensor, "m paints 3"]  # in [0, 1], per mode
    log_weights: Float[Tensor, "m"]  # of the modes; they sum to one

    def to(self, device: torch.device, dtype: torch.dtype) -> "Scene":
        """Return the same scene on ``device``, with floating-point numbers in ``dtype``."""
        moved_tensors = {
            name: value.to(device, dtype if value.is_floating_point() else value.dtype)
            for name, value in vars(self).items()
            if isinstance(value, Tensor)
        }
        return replace(self, **moved_tensors)


@dataclass(frozen=True, eq=False)
class _Placed:
    """A painted object, with the height at which others stand on it and the room for others under it."""

    parts: tuple[Part, ...]
    seat: float
    shelter: tuple[float, float] | None

    @property
    def low(self) -> list[float]:
        return bounds(self.parts)[0].tolist()

    @property
    def high(self) -> list[float]:
        return bounds(self.parts)[1].tolist()

    def at(self, x: float, y: float, z: float) -> "_Placed":
        return replace(self, parts=moved(self.parts, x, y, z), seat=self.seat + z)

    def scaled(self, factor: float) -> "_Placed":
        shelter = self.shelter and (self.shelter[0] * factor, self.shelter[1] * factor)
        return _Placed(stretched(self.parts, factor, factor, factor), self.seat * factor, shelter)


def build(prompt: str, key: str = "prompt") -> Scene:
    """Return the scene of the prompt that the setting ``key`` holds.

    Raises ``UserError`` for words or sentences that the grammar does not know.
    """
    return compile_scene(assemble(parse(prompt, key)))


def assemble(sentence: Sentence) -> tuple[Part, ...]:
    """Paint, place and scale all objects of a sentence."""
    return _fit(_arrange(sentence, itertools.count()).parts)


def compile_scene(parts: tuple[Part, ...]) -> Scene:
    """Convert parts to tensors, sorted by kind, in float64 on the CPU."""
    parts = tuple(sorted(parts, key=lambda part: KINDS.index(part.solid.kind)))
    kinds = [part.solid.kind for part in parts]
    colours = list(dict.fromkeys(name for part in parts for name in (part.coat.first, part.coat.second)))
    axes = torch.cat([torch.eye(3), -torch.eye(3)], dim=1).double()
    own_reach = torch.stack([part.solid.kind.support(axes, part.solid.size) for part in parts])
    world_reach = torch.stack([part.solid.support(axes) for part in parts])
    centres = (world_reach[:, :3] - world_reach[:, 3:]) / 2
    directions = sphere_directions(SUPPORT_DIRECTIONS).double().T
    reach = torch.stack([part.solid.support(directions) for part in parts])
    # The margin covers points between the finitely many directions.
    radii = (reach - centres @ directions).amax(1) * 1.01
    matrices, albedo = torch.stack([part.solid.matrix for part in parts]), _albedo(colours)
    return Scene(
        kinds=tuple((kind, kinds.count(kind)) for kind in dict.fromkeys(kinds)),
        to_local=torch.linalg.inv(matrices),
        offsets=torch.stack([part.solid.offset for part in parts]),
        sizes=torch.stack([size_row(part.solid.size) for part in parts]),
        low=-own_reach[:, 3:],
        high=own_reach[:, :3],
        centres=centres,
        radii=radii,
        patterns=torch.tensor([PATTERN_NAMES.index(part.coat.pattern) for part in parts]),
        paints=torch.tensor(
            [[colours.index(part.coat.first), colours.index(part.coat.second)] for part in parts]
        ),
        albedo=albedo,
        log_weights=torch.full((len(albedo),), -math.log(len(albedo)), dtype=torch.float64),
    )


def signed_distance(scene: Scene, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    """Return the signed distance to the surface of the scene, negative inside, or less.

    The sign is exact. The size is at most the distance in world units, and smaller than it near edges and for
    stretched solids (``solids.py``).
    """
    nearest = points.new_full((len(points),), torch.inf)
    first = 0
    for kind, count in scene.kinds:
        for part in range(first, first + count):
            local = scene.to_local[part] @ (points - scene.offsets[part]).T
            own = kind.sdf(local, scene.sizes[part][:, None].expand(-1, len(points)))
            nearest = torch.minimum(nearest, own / torch.linalg.matrix_norm(scene.to_local[part], ord=2))
        first += count
    return nearest


@cache
def sphere_directions(count: int) -> Float[Tensor, "count 3"]:
    """Return nearly uniform unit vectors (a Fibonacci lattice)."""
    index = torch.arange(count, dtype=torch.float64) + 0.5
    z = 1 - 2 * index / count
    angle = math.pi * (1 + math.sqrt(5)) * index
    across = (1 - z * z).sqrt()
    return torch.stack([across * angle.cos(), across * angle.sin(), z], dim=1)


# --- colours


def _colour(name: str) -> Float[Tensor, "3"]:
    shade, _, plain = name.rpartition(" ")
    rgb = torch.tensor(COLOURS[plain], dtype=torch.float64)
    if shade == "dark":
        return 0.55 * rgb
    return 0.5 * rgb + 0.5 if shade == "light" else rgb


def _albedo(colours: list[str]) -> Float[Tensor, "m paints 3"]:
    """Return the colours of every mode: one mode per colour of the palette if a colour is open, else one."""
    modes = len(OPEN_PALETTE) if any(name.startswith(OPEN) for name in colours) else 1

    def row(mode: int) -> Tensor:
        names = [
            OPEN_PALETTE[(mode + OPEN_STRIDE * int(name[len(OPEN) :])) % modes]
            if name.startswith(OPEN)
            else name
            for name in colours
        ]
        return torch.stack([_colour(name) for name in names])

    return torch.stack([row(mode) for mode in range(modes)])


def _paint(item: Thing, phrase: Phrase, index: int) -> tuple[Part, ...]:
    """Choose the colours of MAIN and ACCENT; a pattern is applied to all parts in plain MAIN."""
    open_colour = f"{OPEN}{index}"
    main = phrase.colours[0] if phrase.colours else (open_colour if item.main == OPEN else item.main)
    pattern = phrase.pattern
    if len(phrase.colours) == 2:
        accent = other = phrase.colours[1]
        pattern = pattern or ("striped" if item.main == OPEN else None)
    else:
        accent = item.accent
        # With one colour and a pattern, the other colour is white, or black if white would not be visible.
        other = "black" if main in ("white", "cream") else "white"

    def coat(old: Coat) -> Coat:
        if pattern is not None and old == Coat(MAIN, ACCENT, PLAIN):
            return Coat(main, main if pattern == PLAIN else other, pattern)
        names = {MAIN: main, ACCENT: accent}
        first = names.get(old.first, old.first)
        return Coat(first, first if old.pattern == PLAIN else names.get(old.second, old.second), old.pattern)

    return tuple(replace(part, coat=coat(part.coat)) for part in item.parts)


# --- places


def _arrange(sentence: Sentence, indices: Iterator[int]) -> _Placed:
    """Place all objects of a sentence; ``indices`` count phrases, so that open colours differ."""
    group = sentence.phrase
    first = _place(group, next(indices)) if isinstance(group, Phrase) else _arrange(group, indices)
    others = [_arrange(other, indices) for other in sentence.others]
    if sentence.relation is None:
        return first
    if sentence.relation == "between":
        return _row([others[0], first, others[1]])
    return _relate(first, sentence.relation, others[0])


def _place(phrase: Phrase, index: int) -> _Placed:
    item = thing(phrase.noun)
    parts = stretched(_paint(item, phrase, index), *phrase.stretch)
    low, high = bounds(parts)
    radius = float((high - low).norm()) / 2
    top = float(high[2]) if item.seat is None else item.seat * phrase.stretch[2]
    one = _Placed(parts, top, item.shelter).scaled(item.natural * phrase.size / radius)
    return _row([one] * phrase.count) if phrase.count > 1 else one


def _join(parts: list[_Placed], seat: float, shelter: tuple[float, float] | None = None) -> _Placed:
    return _Placed(tuple(part for placed in parts for part in placed.parts), seat, shelter)


def _stand(placed: _Placed, x: float, y: float, z: float) -> _Placed:
    """Move an object so that it is centred over (x, y) and its lowest point is at height z."""
    low, high = placed.low, placed.high
    return placed.at(x - (low[0] + high[0]) / 2, y - (low[1] + high[1]) / 2, z - low[2])


def _row(items: list[_Placed]) -> _Placed:
    """Place objects side by side on one floor, left to right as seen from the front (-y to +y)."""
    placed, edge = [], 0.0
    for item in items:
        width = item.high[1] - item.low[1]
        placed.append(_stand(item, 0.0, edge + width / 2, 0.0))
        edge += width + CLEARANCE
    return _join(placed, max(item.seat for item in placed))


def _relate(left: _Placed, relation: str, right: _Placed) -> _Placed:
    """Place ``left`` in its relation to ``right``."""
    if relation == "next to":
        return _row([left, right])
    if relation == "under":
        return _under(left, right)
    base = _stand(right, 0.0, 0.0, 0.0)
    if relation in ("on", "above"):
        gap = -SINK if relation == "on" else CLEARANCE * 2
        upper = _stand(left, 0.0, 0.0, base.seat + gap)
        return _join([upper, base], upper.seat)
    sign = 1.0 if relation == "in front of" else -1.0
    depth = (left.high[0] - left.low[0] + base.high[0] - base.low[0]) / 2 + CLEARANCE
    return _join([_stand(left, sign * depth, 0.0, 0.0), base], base.seat)


def _under(left: _Placed, right: _Placed) -> _Placed:
    """Place ``left`` between the legs of ``right``, shrunk to fit, or below it if it has no legs."""
    if right.shelter is None:
        lower = _stand(left, 0.0, 0.0, 0.0)
        upper = _stand(right, 0.0, 0.0, lower.seat - SINK)
        return _join([upper, lower], upper.seat)
    radius, height = right.shelter
    width, depth = left.high[1] - left.low[1], left.high[0] - left.low[0]
    shrink = min(1.0, 0.95 * height / (left.high[2] - left.low[2]), 2 * radius / max(width, depth))
    base = _stand(right, 0.0, 0.0, 0.0)
    return _join([_stand(left.scaled(shrink), 0.0, 0.0, 0.0), base], base.seat)


def _fit(parts: tuple[Part, ...]) -> tuple[Part, ...]:
    """Centre the bounding box on the origin and scale so that the farthest point is at FIT_RADIUS."""
    low, high = bounds(parts)
    centre = ((low + high) / 2).tolist()
    centred = moved(parts, -centre[0], -centre[1], -centre[2])
    directions = sphere_directions(SUPPORT_DIRECTIONS).T
    reach = float(torch.stack([part.solid.support(directions) for part in centred]).max())
    return stretched(centred, *[FIT_RADIUS / reach] * 3)
