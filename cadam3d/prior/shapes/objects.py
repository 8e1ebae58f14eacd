"""The objects of the world: primitives and composed objects, each made of a few painted solids.

Local coordinates have +z up and the front at +x; seen from the front, +y is to the right. Position and unit
of an object do not matter, since ``natural`` defines its size relative to others.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.prior.shapes.solids import (
    Solid,
    arc,
    ball,
    box,
    capsule,
    cone,
    cylinder,
    ellipsoid,
    frustum,
    gable,
    octahedron,
    pyramid,
    star,
    tetrahedron,
    torus,
    tube,
)

PLAIN = "plain"  # the pattern of one colour
# Colours that the prompt may choose.
MAIN, ACCENT = "main", "accent"
# A colour that the prompt leaves open. It gives one mode per colour of the palette.
OPEN = "open"
UNIT_AXES = torch.cat([torch.eye(3, dtype=torch.float64), -torch.eye(3, dtype=torch.float64)], dim=1)


@dataclass(frozen=True)
class Coat:
    """The colours of a part: names of colours, or MAIN and ACCENT for those that the prompt may choose."""

    first: str
    second: str
    pattern: str = PLAIN


@dataclass(frozen=True, eq=False)
class Part:
    """One painted solid."""

    solid: Solid
    coat: Coat


@dataclass(frozen=True, eq=False)
class Thing:
    """A named object before the colours of the prompt are applied."""

    parts: tuple[Part, ...]
    main: str  # default colour, or OPEN
    accent: str  # default second colour
    natural: float = 1.0  # radius relative to other objects
    seat: float | None = None  # height at which other objects stand on it; None = its top
    shelter: tuple[float, float] | None = None  # radius and height of the room for objects under it


# A colour or a coat, and the solids that have it.
Group = tuple[str | Coat, *tuple[Solid, ...]]


def bounds(parts: tuple[Part, ...]) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """Return the low and the high corner of the tight box around all parts."""
    reach = torch.stack([part.solid.support(UNIT_AXES) for part in parts]).amax(0)
    return -reach[3:], reach[:3]


def moved(parts: tuple[Part, ...], x: float, y: float, z: float) -> tuple[Part, ...]:
    """Return all parts, moved together."""
    return tuple(replace(part, solid=part.solid.at(x, y, z)) for part in parts)


def stretched(parts: tuple[Part, ...], x: float, y: float, z: float) -> tuple[Part, ...]:
    """Return all parts, stretched about the origin along the world axes."""
    return tuple(replace(part, solid=part.solid.stretched(x, y, z)) for part in parts)


def known_primitives() -> tuple[str, ...]:
    """Return the names of the objects that consist of one solid."""
    return tuple(PRIMITIVES)


def known_objects() -> tuple[str, ...]:
    """Return the names of the composed objects."""
    return tuple(COMPOSED)


def thing(name: str) -> Thing:
    """Return the object of that name, a key of PRIMITIVES or COMPOSED."""
    if name in PRIMITIVES:
        return _thing(OPEN, "white", 1.0, (MAIN, PRIMITIVES[name]))
    return COMPOSED[name]()


def _thing(main: str, accent: str, natural: float, *groups: Group, **room: Any) -> Thing:
    """Return the object of these groups. The order of parts of one kind decides the last bits."""
    parts = []
    for colour, *solids in groups:
        coat = colour if isinstance(colour, Coat) else Coat(colour, ACCENT)
        parts += [Part(solid, coat) for solid in solids]
    return Thing(tuple(parts), main, accent, natural, **room)


def _lighthouse() -> Thing:
    base, height, low, high = 0.12, 1.55, 0.40, 0.25
    bands = 5

    def radius(z: float) -> float:
        return low + (high - low) * (z - base) / height

    tower = []
    for i in range(bands):
        bottom, top = base + height * i / bands, base + height * (i + 1) / bands
        slab = frustum(radius(bottom), radius(top), top - bottom).at(z=(bottom + top) / 2)
        tower.append((ACCENT if i % 2 else MAIN, slab))
    deck = base + height
    rail = [cylinder(0.016, 0.16).at(0.35).turned("z", 45.0 * i).at(z=deck + 0.12) for i in range(8)]
    bars = [cylinder(0.02, 0.30).at(0.17).turned("z", 60.0 * i).at(z=deck + 0.20) for i in range(6)]
    windows = [
        box(0.08, 0.09, 0.13).at(radius(z) - 0.02, 0, z).turned("z", angle)
        for z, angle in ((0.90, 0.0), (1.36, 0.0), (0.72, 180.0), (1.20, 180.0), (1.05, 90.0), (1.05, -90.0))
    ]
    return _thing(
        "red",
        "white",
        1.8,
        *tower,
        ("grey", ellipsoid(0.72, 0.70, 0.20)),
        (
            "charcoal",
            ellipsoid(0.26, 0.22, 0.20).at(0.42, 0.40, 0.05),
            ellipsoid(0.24, 0.27, 0.17).at(-0.42, -0.36, 0.06),
            ellipsoid(0.20, 0.20, 0.15).at(0.40, -0.46, 0.03),
            cylinder(0.37, 0.06).at(z=deck + 0.03),
            torus(0.35, 0.018).at(z=deck + 0.19),
            ball(0.045).at(z=deck + 0.60),
        ),
        ("yellow", cylinder(0.17, 0.30).at(z=deck + 0.20)),
        (MAIN, cone(0.27, 0.24).at(z=deck + 0.46)),
        ("charcoal", *rail, *bars),
        (
            "brown",
            box(0.10, 0.17, 0.26).at(0.37, 0, base + 0.17),
            cylinder(0.085, 0.10).turned("y", 90).at(0.37, 0, base + 0.30),
        ),
        ("navy", *windows),
    )


def _snowman() -> Thing:
    head = 1.42
    eyes = [ball(0.045).at(0.235, y, head + 0.10) for y in (-0.10, 0.10)]
    buttons = [ball(0.045).at(x, 0, z) for x, z in ((0.35, 1.14), (0.36, 0.98), (0.46, 0.65))]
    arms = [capsule(0.03, 0.62).turned("x", -58 * side).at(0, 0.56 * side, 1.18) for side in (-1, 1)]
    hands = [capsule(0.022, 0.20).turned("x", -10 * side).at(0, 0.72 * side, 1.34) for side in (-1, 1)]
    return _thing(
        "white",
        "red",
        1.0,
        (MAIN, ball(0.50).at(z=0.46), ball(0.37).at(z=1.03), ball(0.27).at(z=head)),
        ("orange", cone(0.07, 0.34).turned("y", 90).at(0.40, 0, head)),
        (
            "black",
            *eyes,
            *buttons,
            cylinder(0.31, 0.045).at(z=head + 0.215),
            cylinder(0.20, 0.30).at(z=head + 0.37),
        ),
        (
            ACCENT,
            cylinder(0.207, 0.07).at(z=head + 0.275),
            torus(0.25, 0.065).at(z=1.225),
            box(0.07, 0.12, 0.30).turned("y", -8).at(0.37, 0.16, 1.06),
        ),
        ("brown", *arms, *hands),
    )


def _chair() -> Thing:
    legs = [box(0.10, 0.10, 0.62).at(x, y, 0.31) for x in (-0.34, 0.34) for y in (-0.34, 0.34)]
    posts = [box(0.09, 0.09, 0.86).at(-0.345, y, 1.10) for y in (-0.34, 0.34)]
    slats = [box(0.06, 0.62, 0.13).at(-0.345, 0, z) for z in (0.98, 1.20, 1.43)]
    rungs = [box(0.06, 0.60, 0.06).at(x, 0, 0.24) for x in (-0.34, 0.34)]
    return _thing(
        "orange",
        "brown",
        0.9,
        (MAIN, box(0.84, 0.86, 0.11).at(0.01, 0, 0.66)),
        (ACCENT, *legs, *posts),
        (MAIN, *slats),
        (ACCENT, *rungs),
        seat=0.715,
        shelter=(0.25, 0.60),
    )


def _table() -> Thing:
    legs = [box(0.13, 0.13, 0.80).at(x, y, 0.40) for x in (-0.50, 0.50) for y in (-0.80, 0.80)]
    aprons = [box(0.06, 1.55, 0.15).at(x, 0, 0.72) for x in (-0.50, 0.50)]
    ends = [box(0.95, 0.06, 0.15).at(0, y, 0.72) for y in (-0.80, 0.80)]
    top = (MAIN, box(1.30, 1.95, 0.10).at(z=0.84))
    rest = (ACCENT, *legs, *aprons, *ends)
    return _thing("beige", "brown", 1.4, top, rest, shelter=(0.42, 0.63))


def _mug() -> Thing:
    handle = arc(0.27, 0.065, 112).turned("y", 90).at(0, 0.44, 0.52)
    return _thing(
        "blue",
        "white",
        0.45,
        (MAIN, tube(0.45, 0.38, 0.98).at(z=0.50), cylinder(0.44, 0.10).at(z=0.06), handle),
        ("brown", cylinder(0.385, 0.05).at(z=0.80)),
        (ACCENT, torus(0.415, 0.045).at(z=0.99)),
        seat=1.0,
    )


def _rocket() -> Thing:
    fins = [box(0.40, 0.06, 0.50).at(0.40, 0, 0.34).turned("z", 45 + 90 * i) for i in range(4)]
    tips = [capsule(0.045, 0.66).at(0.60, 0, 0.30).turned("z", 45 + 90 * i) for i in range(4)]
    return _thing(
        "white",
        "red",
        1.6,
        (MAIN, cylinder(0.33, 1.10).at(z=0.80), frustum(0.33, 0.21, 0.36).at(z=1.53)),
        (
            ACCENT,
            cone(0.21, 0.44).at(z=1.93),
            cylinder(0.338, 0.07).at(z=1.34),
            cylinder(0.338, 0.07).at(z=0.45),
            torus(0.115, 0.03).turned("y", 90).at(0.325, 0, 1.05),
            torus(0.085, 0.025).turned("y", 90).at(0.327, 0, 0.70),
            *fins,
            *tips,
        ),
        ("charcoal", frustum(0.28, 0.20, 0.20).at(z=0.16)),
        ("orange", cone(0.19, 0.38).turned("y", 180).at(z=-0.13)),
        (
            "cyan",
            ellipsoid(0.04, 0.105, 0.105).at(0.32, 0, 1.05),
            ellipsoid(0.04, 0.08, 0.08).at(0.32, 0, 0.70),
        ),
    )


def _house() -> Thing:
    sides = [(x, y, 0.0) for x, y in ((0.61, -0.42), (0.61, 0.42), (-0.61, -0.36), (-0.61, 0.36))]
    windows = [
        (colour, solid.turned("z", turn).at(x, y, 0.45))
        for x, y, turn in (*sides, (0.0, 0.76, 90.0), (0.0, -0.76, 90.0))
        for colour, solid in (
            ("white", box(0.05, 0.34, 0.34)),
            ("navy", box(0.07, 0.27, 0.27)),
            ("white", box(0.085, 0.27, 0.03)),
            ("white", box(0.085, 0.03, 0.27)),
        )
    ]
    loft = gable(1.50, 1.50, 0.62).stretched(0.8, 1.0, 1.0).turned("z", 90).stretched(1, 1.25, 1)
    return _thing(
        "cream",
        "red",
        1.7,
        (MAIN, box(1.20, 1.50, 0.86).at(z=0.43), loft.at(z=1.16)),
        (ACCENT, gable(1.72, 1.52, 0.68).turned("z", 90).at(z=1.20)),
        ("maroon", box(0.22, 0.22, 0.62).at(-0.28, 0.45, 1.43)),
        ("charcoal", box(0.27, 0.27, 0.07).at(-0.28, 0.45, 1.75)),
        ("brown", box(0.06, 0.28, 0.52).at(0.61, 0, 0.26)),
        ("gold", ball(0.025).at(0.65, 0.09, 0.26)),
        ("grey", box(0.26, 0.40, 0.06).at(0.68, 0, 0.03)),
        *windows,
    )


def _tree() -> Thing:
    leaves = [
        ball(radius).at(x, y, z)
        for x, y, z, radius in (
            (0.0, 0.0, 1.42, 0.50),
            (0.34, 0.16, 1.16, 0.36),
            (-0.30, 0.30, 1.20, 0.36),
            (-0.12, -0.40, 1.16, 0.36),
            (0.24, -0.26, 1.30, 0.34),
        )
    ]
    fruits = [
        ball(0.06).at(x, y, z)
        for x, y, z in (
            (0.66, 0.28, 1.16),
            (0.42, -0.05, 1.62),
            (0.55, -0.36, 1.34),
            (-0.30, 0.62, 1.30),
            (-0.50, 0.16, 1.42),
            (-0.10, -0.74, 1.22),
            (-0.36, -0.50, 1.32),
        )
    ]
    roots = [capsule(0.06, 0.34).turned("y", 62).at(0.17).turned("z", a).at(z=0.07) for a in (20, 140, 260)]
    return _thing(
        "green",
        "red",
        1.6,
        (MAIN, *leaves),
        (
            "brown",
            frustum(0.20, 0.12, 1.05).at(z=0.52),
            capsule(0.055, 0.60).turned("x", -40).at(0, 0.20, 0.86),
            capsule(0.05, 0.55).turned("x", 42).at(0, -0.19, 0.84),
            *roots,
        ),
        (ACCENT, *fruits),
    )


def _pine() -> Thing:
    tiers = [(0.62, 0.62, 0.62), (0.50, 0.56, 0.98), (0.38, 0.50, 1.30), (0.25, 0.42, 1.60)]
    return _thing(
        "green",
        "yellow",
        1.6,
        (MAIN, *(cone(radius, height).at(z=z) for radius, height, z in tiers)),
        ("brown", cylinder(0.11, 0.44).at(z=0.20)),
        (ACCENT, star(0.14, 0.06, 0.05).at(z=1.90)),
    )


def _hammer() -> Thing:
    return _thing(
        "grey",
        "brown",
        0.8,
        (ACCENT, capsule(0.075, 1.50).at(z=0.75)),
        ("charcoal", cylinder(0.09, 0.42).at(z=0.22)),
        (
            MAIN,
            box(0.24, 0.44, 0.26).at(z=1.42),
            cylinder(0.10, 0.24).turned("x", 90).at(0, -0.30, 1.42),
            cylinder(0.145, 0.14).turned("x", 90).at(0, -0.44, 1.42),
            pyramid(0.20, 0.22, 0.46).turned("x", -90).at(0, 0.44, 1.42),
        ),
    )


def _mushroom() -> Thing:
    # The cap is a ball, stretched and shifted, sitting over a flat disc of gills.
    return _thing(
        "red",
        "cream",
        0.7,
        (ACCENT, frustum(0.21, 0.16, 0.82).at(z=0.38), ellipsoid(0.27, 0.27, 0.13).at(z=0.06)),
        ("beige", frustum(0.20, 0.54, 0.10).at(z=0.72)),
        (MAIN, ellipsoid(0.60, 0.60, 0.09).at(z=0.82), ellipsoid(0.56, 0.56, 0.42).at(z=0.86)),
        ("white", frustum(0.30, 0.17, 0.10).at(z=0.60)),
    )


def _car() -> Thing:
    wheels = [
        (colour, cylinder(radius, width).turned("x", 90).at(x, 0.40 * side, 0.20))
        for x in (-0.55, 0.55)
        for side in (-1, 1)
        for colour, radius, width in (("black", 0.20, 0.16), ("silver", 0.10, 0.18))
    ]
    return _thing(
        "red",
        "white",
        1.2,
        (MAIN, box(1.80, 0.84, 0.34).at(z=0.38)),
        ("navy", frustum(0.62, 0.42, 0.44).stretched(y=0.66).at(-0.10, 0, 0.74)),
        (ACCENT, cylinder(0.44, 0.07).stretched(y=0.68).at(-0.10, 0, 0.96)),
        *wheels,
        ("yellow", *(ellipsoid(0.05, 0.09, 0.07).at(0.90, y, 0.44) for y in (-0.28, 0.28))),
        ("maroon", *(box(0.05, 0.16, 0.09).at(-0.90, y, 0.44) for y in (-0.28, 0.28))),
        ("charcoal", box(0.06, 0.34, 0.10).at(0.89, 0, 0.36)),
        ("silver", *(box(0.08, 0.88, 0.09).at(x, 0, 0.26) for x in (-0.89, 0.89))),
    )


def _robot() -> Thing:
    limbs = []
    for side in (-1, 1):
        limbs += [
            (
                MAIN,
                box(0.18, 0.16, 0.52).at(0, 0.52 * side, 0.84),
                box(0.20, 0.20, 0.46).at(0, 0.19 * side, 0.26),
            ),
            (
                "charcoal",
                cylinder(0.10, 0.30).turned("x", 90).at(0, 0.40 * side, 1.02),
                box(0.36, 0.25, 0.12).at(0.05, 0.19 * side, 0.06),
            ),
            (ACCENT, ball(0.12).at(0, 0.52 * side, 0.52)),
            ("yellow", cylinder(0.075, 0.06).turned("y", 90).at(0.24, 0.13 * side, 1.46)),
            ("charcoal", cylinder(0.06, 0.08).turned("x", 90).at(0, 0.33 * side, 1.42)),
        ]
    buttons = zip(("red", "yellow", "green"), (-0.11, 0.0, 0.11), strict=True)
    return _thing(
        "silver",
        "red",
        1.2,
        (MAIN, box(0.46, 0.70, 0.66).at(z=0.80), box(0.46, 0.58, 0.46).at(z=1.42)),
        (ACCENT, box(0.04, 0.40, 0.32).at(0.23, 0, 0.86)),
        *((colour, ball(0.05).at(0.25, y, 0.92)) for colour, y in buttons),
        (
            "charcoal",
            cylinder(0.10, 0.14).at(z=1.16),
            box(0.05, 0.32, 0.07).at(0.225, 0, 1.30),
            cylinder(0.02, 0.22).at(z=1.74),
        ),
        (ACCENT, ball(0.06).at(z=1.87)),
        *limbs,
    )


def _lamp() -> Thing:
    return _thing(
        "yellow",
        "blue",
        0.9,
        (ACCENT, cylinder(0.36, 0.08).at(z=0.04), ellipsoid(0.20, 0.20, 0.30).at(z=0.34)),
        ("gold", cylinder(0.045, 0.60).at(z=0.80), ball(0.06).at(z=1.64)),
        (MAIN, frustum(0.58, 0.34, 0.60).at(z=1.28)),
        ("white", torus(0.575, 0.025).at(z=0.99), torus(0.345, 0.025).at(z=1.57)),
    )


def _boat() -> Thing:
    return _thing(
        "blue",
        "white",
        1.3,
        (
            MAIN,
            box(1.10, 0.62, 0.34).at(-0.15, 0, 0.27),
            pyramid(0.34, 0.62, 0.62).turned("y", 90).at(0.70, 0, 0.27),
        ),
        (
            ACCENT,
            box(1.14, 0.66, 0.06).at(-0.15, 0, 0.46),
            pyramid(1.00, 0.05, 1.25).at(-0.10, 0, 1.28),
            pyramid(0.62, 0.04, 0.95).at(0.42, 0, 1.10),
        ),
        ("brown", cylinder(0.045, 1.70).at(0.10, 0, 1.15), box(0.36, 0.34, 0.20).at(-0.42, 0, 0.56)),
        ("red", box(0.26, 0.03, 0.14).at(-0.03, 0, 1.93)),
    )


def _castle() -> Thing:
    towers = []
    for x in (-0.60, 0.60):
        for y in (-0.60, 0.60):
            towers += [
                (MAIN, cylinder(0.22, 1.05).at(x, y, 0.52)),
                ("grey", cylinder(0.26, 0.10).at(x, y, 1.06)),
                (ACCENT, cone(0.29, 0.46).at(x, y, 1.33)),
                ("charcoal", box(0.06, 0.07, 0.16).at(x + (0.20 if x > 0 else -0.20), y, 0.74)),
            ]
    edges = [(a, b) for a in (-0.60, 0.60) for b in (-0.26, 0.0, 0.26)]
    merlons = [box(0.12, 0.13, 0.13).at(x, y, 0.74) for x, y in (*edges, *((b, a) for a, b in edges))]
    return _thing(
        "beige",
        "blue",
        1.8,
        (MAIN, box(1.30, 1.30, 0.68).at(z=0.34), box(0.56, 0.56, 1.00).at(z=0.90)),
        (ACCENT, pyramid(0.70, 0.70, 0.56).at(z=1.67)),
        (
            "brown",
            box(0.06, 0.34, 0.34).at(0.64, 0, 0.17),
            cylinder(0.17, 0.06).turned("y", 90).at(0.64, 0, 0.34),
        ),
        ("charcoal", *(box(0.06, 0.10, 0.18).at(x, 0, 1.14) for x in (-0.27, 0.27))),
        (MAIN, *merlons),
        *towers,
    )


def _cactus() -> Thing:
    arms = []
    for side, z in ((-1, 0.72), (1, 0.94)):
        arms += [
            capsule(0.10, 0.44).turned("x", 90).at(0, 0.30 * side, z),
            capsule(0.10, 0.52).at(0, 0.46 * side, z + 0.18),
        ]
    return _thing(
        "green",
        "orange",
        0.8,
        (MAIN, capsule(0.20, 1.30).at(z=0.92), *arms),
        ("pink", ellipsoid(0.08, 0.08, 0.05).at(z=1.57)),
        (ACCENT, frustum(0.26, 0.36, 0.40).at(z=0.20), tube(0.41, 0.30, 0.10).at(z=0.40)),
        ("brown", cylinder(0.33, 0.02).at(z=0.41)),
    )


def _flower() -> Thing:
    petals = [
        ellipsoid(0.06, 0.17, 0.24).at(0, 0, 0.33).turned("x", 45.0 * i).at(0.02, 0, 1.30) for i in range(8)
    ]
    return _thing(
        "pink",
        "yellow",
        0.7,
        (MAIN, *petals),
        (ACCENT, ellipsoid(0.13, 0.20, 0.20).at(0.03, 0, 1.30)),
        (
            "green",
            cylinder(0.04, 1.25).at(-0.03, 0, 0.66),
            ellipsoid(0.05, 0.30, 0.12).turned("x", 35).at(-0.03, 0.27, 0.52),
            ellipsoid(0.05, 0.30, 0.12).turned("x", -35).at(-0.03, -0.27, 0.40),
        ),
        ("brown", ellipsoid(0.30, 0.30, 0.10).at(-0.03, 0, 0.05)),
    )


def _windmill() -> Thing:
    blades = [
        (colour, blade.turned("x", 45.0 + 90.0 * i).at(0, 0, 1.30))
        for i in range(4)
        for colour, blade in (
            ("brown", box(0.04, 0.05, 0.95).at(0.47, 0, 0.48)),
            (ACCENT, box(0.03, 0.20, 0.66).at(0.47, 0.12, 0.60)),
        )
    ]
    windows = [box(0.10, 0.14, 0.16).at(0.385, 0, 0.70).turned("z", a) for a in (90, 180, 270)]
    return _thing(
        "cream",
        "red",
        1.7,
        (MAIN, frustum(0.46, 0.30, 1.25).at(z=0.62)),
        ("brown", cone(0.38, 0.42).at(z=1.46), box(0.10, 0.20, 0.36).at(0.42, 0, 0.20)),
        ("charcoal", cylinder(0.06, 0.34).turned("y", 90).at(0.36, 0, 1.30), ball(0.08).at(0.52, 0, 1.30)),
        ("navy", box(0.08, 0.14, 0.16).at(0.36, 0, 0.78), *windows),
        *blades,
    )


def _cake() -> Thing:
    cherries = [ball(0.075).at(0.44).turned("z", 45.0 * i).at(z=0.56) for i in range(8)]
    candles = [cylinder(0.035, 0.26).at(0.15).turned("z", 120.0 * i).at(z=0.95) for i in range(3)]
    flames = [ellipsoid(0.035, 0.035, 0.06).at(0.15).turned("z", 120.0 * i).at(z=1.13) for i in range(3)]
    icing = ((0.585, 0.05, 0.09), (0.565, 0.05, 0.50), (0.315, 0.04, 0.83), (0.33, 0.04, 0.54))
    return _thing(
        "pink",
        "red",
        0.8,
        ("silver", cylinder(0.78, 0.05).at(z=0.025)),
        (MAIN, cylinder(0.60, 0.46).at(z=0.28), cylinder(0.34, 0.34).at(z=0.67)),
        ("white", *(torus(ring, pipe).at(z=z) for ring, pipe, z in icing)),
        (ACCENT, *cherries),
        ("cyan", *candles),
        ("yellow", *flames),
    )


def _icecream() -> Thing:
    waffle = cone(0.36, 1.10).turned("x", 180).at(z=0.55)
    return _thing(
        "pink",
        "cream",
        0.7,
        (Coat("beige", "brown", "checkered"), waffle),
        (MAIN, ball(0.38).at(z=1.22), torus(0.35, 0.07).at(z=1.10)),
        (ACCENT, ball(0.29).at(z=1.68)),
        ("red", ball(0.09).at(z=2.00)),
    )


def _candle() -> Thing:
    return _thing(
        "cream",
        "gold",
        0.5,
        (
            MAIN,
            cylinder(0.26, 1.00).at(z=0.62),
            capsule(0.06, 0.36).at(0.24, 0.06, 0.98),
            capsule(0.05, 0.50).at(-0.16, 0.19, 0.90),
            capsule(0.05, 0.30).at(0.02, -0.255, 1.00),
            torus(0.235, 0.04).at(z=1.12),
        ),
        ("black", cylinder(0.02, 0.16).at(z=1.18)),
        ("orange", ellipsoid(0.10, 0.10, 0.16).at(z=1.36), cone(0.082, 0.22).at(z=1.52)),
        (
            ACCENT,
            frustum(0.40, 0.54, 0.12).at(z=0.08),
            torus(0.50, 0.04).at(z=0.14),
            torus(0.13, 0.035).turned("x", 90).at(0.64, 0, 0.12),
        ),
    )


def _planet() -> Thing:
    return _thing(
        "orange",
        "cream",
        1.2,
        (Coat(MAIN, ACCENT, "striped"), ball(0.55)),
        ("beige", tube(0.92, 0.70, 0.03).turned("x", 22)),
        ("brown", tube(1.05, 0.96, 0.03).turned("x", 22)),
    )


def _donut() -> Thing:
    sprinkles = []
    colours = ("yellow", "cyan", "red", "green", "white")
    for i in range(20):
        turn, tilt = 18.0 * i, (-34.0, 8.0, 38.0)[i % 3]
        seed = capsule(0.028, 0.13).turned("y", 90).turned("z", 47.0 * i).at(z=0.335).turned("y", tilt)
        sprinkles.append((colours[i % 5], seed.at(0.62).turned("z", turn).at(z=0.05)))
    dough, icing = torus(0.62, 0.33), torus(0.62, 0.325).at(z=0.05)
    return _thing("pink", "white", 0.6, ("beige", dough), (MAIN, icing), *sprinkles)


PRIMITIVES: dict[str, Solid] = {
    "sphere": ball(1.0),
    "cube": box(1.2, 1.2, 1.2),
    "box": box(1.0, 1.6, 0.8),
    "torus": torus(0.70, 0.28).turned("y", 50),
    "cylinder": cylinder(0.55, 1.4),
    "cone": cone(0.7, 1.5),
    "capsule": capsule(0.42, 1.8),
    "pyramid": pyramid(1.4, 1.4, 1.3),
    "disc": cylinder(0.9, 0.22),
    "ring": tube(0.9, 0.62, 0.26),
    "ellipsoid": ellipsoid(0.6, 0.95, 0.6),
    "tetrahedron": tetrahedron(1.0),
    "octahedron": octahedron(0.7, 0.7, 1.0),
    "prism": gable(1.6, 1.2, 1.05),
    "tube": tube(0.55, 0.40, 1.4),
    "star": star(1.0, 0.42, 0.36),
    "arch": arc(0.75, 0.24, 90).turned("x", 90).turned("z", 90),
}

COMPOSED: dict[str, Callable[[], Thing]] = {
    "lighthouse": _lighthouse,
    "snowman": _snowman,
    "chair": _chair,
    "table": _table,
    "mug": _mug,
    "rocket": _rocket,
    "house": _house,
    "tree": _tree,
    "pine": _pine,
    "hammer": _hammer,
    "mushroom": _mushroom,
    "car": _car,
    "robot": _robot,
    "lamp": _lamp,
    "boat": _boat,
    "castle": _castle,
    "cactus": _cactus,
    "flower": _flower,
    "windmill": _windmill,
    "cake": _cake,
    "icecream": _icecream,
    "candle": _candle,
    "planet": _planet,
    "donut": _donut,
}

ALIASES: dict[str, str] = {
    "ball": "sphere",
    "globe": "sphere",
    "orb": "sphere",
    "dice": "cube",
    "block": "box",
    "brick": "box",
    "cuboid": "box",
    "pill": "capsule",
    "disk": "disc",
    "coin": "disc",
    "plate": "disc",
    "hoop": "ring",
    "egg": "ellipsoid",
    "diamond": "octahedron",
    "gem": "octahedron",
    "wedge": "prism",
    "pipe": "tube",
    "cup": "mug",
    "spaceship": "rocket",
    "home": "house",
    "cottage": "house",
    "fir": "pine",
    "toadstool": "mushroom",
    "ship": "boat",
    "sailboat": "boat",
    "tower": "lighthouse",
    "stool": "chair",
    "desk": "table",
    "doughnut": "donut",
}
