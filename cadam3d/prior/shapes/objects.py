"""The objects of the world: primitives and composed objects, each made of a few painted solids.

Local coordinates have +z up and the front at +x; seen from the front, +y is to the right. Position and unit
of an object do not matter, since ``natural`` defines its size relative to others.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

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
from cadam3d.prior.shapes.vocabulary import PLAIN

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
        return Thing((Part(PRIMITIVES[name], Coat(MAIN, ACCENT)),), OPEN, "white")
    return COMPOSED[name]()


def _p(solid: Solid, first: str, second: str = ACCENT, pattern: str = PLAIN) -> Part:
    """Return a painted part; the name is short, since the objects below consist of hundreds of parts."""
    return Part(solid, Coat(first, second, pattern))


def _lighthouse() -> Thing:
    base, height, low, high = 0.12, 1.55, 0.40, 0.25
    bands = 5

    def radius(z: float) -> float:
        return low + (high - low) * (z - base) / height

    tower = []
    for i in range(bands):
        bottom, top = base + height * i / bands, base + height * (i + 1) / bands
        slab = frustum(radius(bottom), radius(top), top - bottom).at(z=(bottom + top) / 2)
        tower.append(_p(slab, MAIN if i % 2 == 0 else ACCENT))
    deck = base + height
    rocks = [
        _p(ellipsoid(0.72, 0.70, 0.20), "grey"),
        _p(ellipsoid(0.26, 0.22, 0.20).at(0.42, 0.40, 0.05), "charcoal"),
        _p(ellipsoid(0.24, 0.27, 0.17).at(-0.42, -0.36, 0.06), "charcoal"),
        _p(ellipsoid(0.20, 0.20, 0.15).at(0.40, -0.46, 0.03), "charcoal"),
    ]
    lantern = [
        _p(cylinder(0.37, 0.06).at(z=deck + 0.03), "charcoal"),
        _p(torus(0.35, 0.018).at(z=deck + 0.19), "charcoal"),
        _p(cylinder(0.17, 0.30).at(z=deck + 0.20), "yellow"),
        _p(cone(0.27, 0.24).at(z=deck + 0.46), MAIN),
        _p(ball(0.045).at(z=deck + 0.60), "charcoal"),
    ]
    rail = [
        _p(cylinder(0.016, 0.16).at(0.35).turned("z", 45.0 * i).at(z=deck + 0.12), "charcoal")
        for i in range(8)
    ]
    bars = [
        _p(cylinder(0.02, 0.30).at(0.17).turned("z", 60.0 * i).at(z=deck + 0.20), "charcoal")
        for i in range(6)
    ]
    door = [
        _p(box(0.10, 0.17, 0.26).at(0.37, 0, base + 0.17), "brown"),
        _p(cylinder(0.085, 0.10).turned("y", 90).at(0.37, 0, base + 0.30), "brown"),
    ]
    windows = [
        _p(box(0.08, 0.09, 0.13).at(radius(z) - 0.02, 0, z).turned("z", angle), "navy")
        for z, angle in ((0.90, 0.0), (1.36, 0.0), (0.72, 180.0), (1.20, 180.0), (1.05, 90.0), (1.05, -90.0))
    ]
    return Thing((*tower, *rocks, *lantern, *rail, *bars, *door, *windows), "red", "white", natural=1.8)


def _snowman() -> Thing:
    head = 1.42
    return Thing(
        (
            _p(ball(0.50).at(z=0.46), MAIN),
            _p(ball(0.37).at(z=1.03), MAIN),
            _p(ball(0.27).at(z=head), MAIN),
            _p(cone(0.07, 0.34).turned("y", 90).at(0.40, 0, head), "orange"),
            *(_p(ball(0.045).at(0.235, y, head + 0.10), "black") for y in (-0.10, 0.10)),
            *(_p(ball(0.045).at(x, 0, z), "black") for x, z in ((0.35, 1.14), (0.36, 0.98), (0.46, 0.65))),
            _p(cylinder(0.31, 0.045).at(z=head + 0.215), "black"),
            _p(cylinder(0.20, 0.30).at(z=head + 0.37), "black"),
            _p(cylinder(0.207, 0.07).at(z=head + 0.275), ACCENT),
            _p(torus(0.25, 0.065).at(z=1.225), ACCENT),
            _p(box(0.07, 0.12, 0.30).turned("y", -8).at(0.37, 0.16, 1.06), ACCENT),
            *(
                _p(capsule(0.03, 0.62).turned("x", -58 * side).at(0, 0.56 * side, 1.18), "brown")
                for side in (-1, 1)
            ),
            *(
                _p(capsule(0.022, 0.20).turned("x", -10 * side).at(0, 0.72 * side, 1.34), "brown")
                for side in (-1, 1)
            ),
        ),
        "white",
        "red",
    )


def _chair() -> Thing:
    legs = [_p(box(0.10, 0.10, 0.62).at(x, y, 0.31), ACCENT) for x in (-0.34, 0.34) for y in (-0.34, 0.34)]
    posts = [_p(box(0.09, 0.09, 0.86).at(-0.345, y, 1.10), ACCENT) for y in (-0.34, 0.34)]
    slats = [_p(box(0.06, 0.62, 0.13).at(-0.345, 0, z), MAIN) for z in (0.98, 1.20, 1.43)]
    rungs = [_p(box(0.06, 0.60, 0.06).at(x, 0, 0.24), ACCENT) for x in (-0.34, 0.34)]
    seat = _p(box(0.84, 0.86, 0.11).at(0.01, 0, 0.66), MAIN)
    return Thing(
        (seat, *legs, *posts, *slats, *rungs), "orange", "brown", 0.9, seat=0.715, shelter=(0.25, 0.60)
    )


def _table() -> Thing:
    legs = [_p(box(0.13, 0.13, 0.80).at(x, y, 0.40), ACCENT) for x in (-0.50, 0.50) for y in (-0.80, 0.80)]
    aprons = [_p(box(0.06, 1.55, 0.15).at(x, 0, 0.72), ACCENT) for x in (-0.50, 0.50)]
    ends = [_p(box(0.95, 0.06, 0.15).at(0, y, 0.72), ACCENT) for y in (-0.80, 0.80)]
    top = _p(box(1.30, 1.95, 0.10).at(z=0.84), MAIN)
    return Thing((top, *legs, *aprons, *ends), "beige", "brown", 1.4, shelter=(0.42, 0.63))


def _mug() -> Thing:
    return Thing(
        (
            _p(tube(0.45, 0.38, 0.98).at(z=0.50), MAIN),
            _p(cylinder(0.44, 0.10).at(z=0.06), MAIN),
            _p(cylinder(0.385, 0.05).at(z=0.80), "brown"),
            _p(torus(0.415, 0.045).at(z=0.99), ACCENT),
            _p(arc(0.27, 0.065, 112).turned("y", 90).at(0, 0.44, 0.52), MAIN),
        ),
        "blue",
        "white",
        0.45,
        seat=1.0,
    )


def _rocket() -> Thing:
    fins = [_p(box(0.40, 0.06, 0.50).at(0.40, 0, 0.34).turned("z", 45 + 90 * i), ACCENT) for i in range(4)]
    tips = [_p(capsule(0.045, 0.66).at(0.60, 0, 0.30).turned("z", 45 + 90 * i), ACCENT) for i in range(4)]
    return Thing(
        (
            _p(cylinder(0.33, 1.10).at(z=0.80), MAIN),
            _p(frustum(0.33, 0.21, 0.36).at(z=1.53), MAIN),
            _p(cone(0.21, 0.44).at(z=1.93), ACCENT),
            _p(cylinder(0.338, 0.07).at(z=1.34), ACCENT),
            _p(cylinder(0.338, 0.07).at(z=0.45), ACCENT),
            _p(frustum(0.28, 0.20, 0.20).at(z=0.16), "charcoal"),
            _p(cone(0.19, 0.38).turned("y", 180).at(z=-0.13), "orange"),
            _p(torus(0.115, 0.03).turned("y", 90).at(0.325, 0, 1.05), ACCENT),
            _p(ellipsoid(0.04, 0.105, 0.105).at(0.32, 0, 1.05), "cyan"),
            _p(torus(0.085, 0.025).turned("y", 90).at(0.327, 0, 0.70), ACCENT),
            _p(ellipsoid(0.04, 0.08, 0.08).at(0.32, 0, 0.70), "cyan"),
            *fins,
            *tips,
        ),
        "white",
        "red",
        1.6,
    )


def _house() -> Thing:
    def window(x: float, y: float, z: float, *, sideways: bool) -> list[Part]:
        turn = 90.0 if sideways else 0.0
        border = box(0.05, 0.34, 0.34).turned("z", turn).at(x, y, z)
        pane = box(0.07, 0.27, 0.27).turned("z", turn).at(x, y, z)
        bars = [box(0.085, 0.27, 0.03), box(0.085, 0.03, 0.27)]
        return [
            _p(border, "white"),
            _p(pane, "navy"),
            *(_p(bar.turned("z", turn).at(x, y, z), "white") for bar in bars),
        ]

    windows = [
        *window(0.61, -0.42, 0.45, sideways=False),
        *window(0.61, 0.42, 0.45, sideways=False),
        *window(-0.61, -0.36, 0.45, sideways=False),
        *window(-0.61, 0.36, 0.45, sideways=False),
        *window(0.0, 0.76, 0.45, sideways=True),
        *window(0.0, -0.76, 0.45, sideways=True),
    ]
    return Thing(
        (
            _p(box(1.20, 1.50, 0.86).at(z=0.43), MAIN),
            _p(
                gable(1.50, 1.50, 0.62)
                .stretched(0.8, 1.0, 1.0)
                .turned("z", 90)
                .stretched(1, 1.25, 1)
                .at(z=1.16),
                MAIN,
            ),
            _p(gable(1.72, 1.52, 0.68).turned("z", 90).at(z=1.20), ACCENT),
            _p(box(0.22, 0.22, 0.62).at(-0.28, 0.45, 1.43), "maroon"),
            _p(box(0.27, 0.27, 0.07).at(-0.28, 0.45, 1.75), "charcoal"),
            _p(box(0.06, 0.28, 0.52).at(0.61, 0, 0.26), "brown"),
            _p(ball(0.025).at(0.65, 0.09, 0.26), "gold"),
            _p(box(0.26, 0.40, 0.06).at(0.68, 0, 0.03), "grey"),
            *windows,
        ),
        "cream",
        "red",
        1.7,
    )


def _tree() -> Thing:
    blobs = [
        (0.0, 0.0, 1.42, 0.50),
        (0.34, 0.16, 1.16, 0.36),
        (-0.30, 0.30, 1.20, 0.36),
        (-0.12, -0.40, 1.16, 0.36),
        (0.24, -0.26, 1.30, 0.34),
    ]
    return Thing(
        (
            *(_p(ball(r).at(x, y, z), MAIN) for x, y, z, r in blobs),
            _p(frustum(0.20, 0.12, 1.05).at(z=0.52), "brown"),
            _p(capsule(0.055, 0.60).turned("x", -40).at(0, 0.20, 0.86), "brown"),
            _p(capsule(0.05, 0.55).turned("x", 42).at(0, -0.19, 0.84), "brown"),
            *(_p(capsule(0.06, 0.34).turned("y", 62).at(0.17).turned("z", a).at(z=0.07), "brown")
              for a in (20, 140, 260)),
            *(_p(ball(0.06).at(x, y, z), ACCENT) for x, y, z in
              ((0.66, 0.28, 1.16), (0.42, -0.05, 1.62), (0.55, -0.36, 1.34), (-0.30, 0.62, 1.30),
               (-0.50, 0.16, 1.42), (-0.10, -0.74, 1.22), (-0.36, -0.50, 1.32))),
        ),
        "green",
        "red",
        1.6,
    )  # fmt: skip


def _pine() -> Thing:
    tiers = [(0.62, 0.62, 0.62), (0.50, 0.56, 0.98), (0.38, 0.50, 1.30), (0.25, 0.42, 1.60)]
    return Thing(
        (
            *(_p(cone(r, h).at(z=z), MAIN) for r, h, z in tiers),
            _p(cylinder(0.11, 0.44).at(z=0.20), "brown"),
            _p(star(0.14, 0.06, 0.05).at(z=1.90), ACCENT),
        ),
        "green",
        "yellow",
        1.6,
    )


def _hammer() -> Thing:
    return Thing(
        (
            _p(capsule(0.075, 1.50).at(z=0.75), ACCENT),
            _p(cylinder(0.09, 0.42).at(z=0.22), "charcoal"),
            _p(box(0.24, 0.44, 0.26).at(z=1.42), MAIN),
            _p(cylinder(0.10, 0.24).turned("x", 90).at(0, -0.30, 1.42), MAIN),
            _p(cylinder(0.145, 0.14).turned("x", 90).at(0, -0.44, 1.42), MAIN),
            _p(pyramid(0.20, 0.22, 0.46).turned("x", -90).at(0, 0.44, 1.42), MAIN),
        ),
        "grey",
        "brown",
        0.8,
    )


def _mushroom() -> Thing:
    # The cap is a ball, stretched and shifted, sitting over a flat disc of gills.
    return Thing(
        (
            _p(frustum(0.21, 0.16, 0.82).at(z=0.38), ACCENT),
            _p(ellipsoid(0.27, 0.27, 0.13).at(z=0.06), ACCENT),
            _p(frustum(0.20, 0.54, 0.10).at(z=0.72), "beige"),
            _p(ellipsoid(0.60, 0.60, 0.09).at(z=0.82), MAIN),
            _p(ellipsoid(0.56, 0.56, 0.42).at(z=0.86), MAIN),
            _p(frustum(0.30, 0.17, 0.10).at(z=0.60), "white"),
        ),
        "red",
        "cream",
        0.7,
    )


def _car() -> Thing:
    wheels = []
    for x in (-0.55, 0.55):
        for side in (-1, 1):
            wheels += [
                _p(cylinder(0.20, 0.16).turned("x", 90).at(x, 0.40 * side, 0.20), "black"),
                _p(cylinder(0.10, 0.18).turned("x", 90).at(x, 0.40 * side, 0.20), "silver"),
            ]
    return Thing(
        (
            _p(box(1.80, 0.84, 0.34).at(z=0.38), MAIN),
            _p(frustum(0.62, 0.42, 0.44).stretched(y=0.66).at(-0.10, 0, 0.74), "navy"),
            _p(cylinder(0.44, 0.07).stretched(y=0.68).at(-0.10, 0, 0.96), ACCENT),
            *wheels,
            *(_p(ellipsoid(0.05, 0.09, 0.07).at(0.90, y, 0.44), "yellow") for y in (-0.28, 0.28)),
            *(_p(box(0.05, 0.16, 0.09).at(-0.90, y, 0.44), "maroon") for y in (-0.28, 0.28)),
            _p(box(0.06, 0.34, 0.10).at(0.89, 0, 0.36), "charcoal"),
            *(_p(box(0.08, 0.88, 0.09).at(x, 0, 0.26), "silver") for x in (-0.89, 0.89)),
        ),
        "red",
        "white",
        1.2,
    )


def _robot() -> Thing:
    limbs = []
    for side in (-1, 1):
        limbs += [
            _p(cylinder(0.10, 0.30).turned("x", 90).at(0, 0.40 * side, 1.02), "charcoal"),
            _p(box(0.18, 0.16, 0.52).at(0, 0.52 * side, 0.84), MAIN),
            _p(ball(0.12).at(0, 0.52 * side, 0.52), ACCENT),
            _p(box(0.20, 0.20, 0.46).at(0, 0.19 * side, 0.26), MAIN),
            _p(box(0.36, 0.25, 0.12).at(0.05, 0.19 * side, 0.06), "charcoal"),
            _p(cylinder(0.075, 0.06).turned("y", 90).at(0.24, 0.13 * side, 1.46), "yellow"),
            _p(cylinder(0.06, 0.08).turned("x", 90).at(0, 0.33 * side, 1.42), "charcoal"),
        ]
    return Thing(
        (
            _p(box(0.46, 0.70, 0.66).at(z=0.80), MAIN),
            _p(cylinder(0.10, 0.14).at(z=1.16), "charcoal"),
            _p(box(0.46, 0.58, 0.46).at(z=1.42), MAIN),
            _p(box(0.04, 0.40, 0.32).at(0.23, 0, 0.86), ACCENT),
            _p(ball(0.05).at(0.25, -0.11, 0.92), "red"),
            _p(ball(0.05).at(0.25, 0.0, 0.92), "yellow"),
            _p(ball(0.05).at(0.25, 0.11, 0.92), "green"),
            _p(box(0.05, 0.32, 0.07).at(0.225, 0, 1.30), "charcoal"),
            _p(cylinder(0.02, 0.22).at(z=1.74), "charcoal"),
            _p(ball(0.06).at(z=1.87), ACCENT),
            *limbs,
        ),
        "silver",
        "red",
        1.2,
    )


def _lamp() -> Thing:
    return Thing(
        (
            _p(cylinder(0.36, 0.08).at(z=0.04), ACCENT),
            _p(ellipsoid(0.20, 0.20, 0.30).at(z=0.34), ACCENT),
            _p(cylinder(0.045, 0.60).at(z=0.80), "gold"),
            _p(frustum(0.58, 0.34, 0.60).at(z=1.28), MAIN),
            _p(torus(0.575, 0.025).at(z=0.99), "white"),
            _p(torus(0.345, 0.025).at(z=1.57), "white"),
            _p(ball(0.06).at(z=1.64), "gold"),
        ),
        "yellow",
        "blue",
        0.9,
    )


def _boat() -> Thing:
    return Thing(
        (
            _p(box(1.10, 0.62, 0.34).at(-0.15, 0, 0.27), MAIN),
            _p(pyramid(0.34, 0.62, 0.62).turned("y", 90).at(0.70, 0, 0.27), MAIN),
            _p(box(1.14, 0.66, 0.06).at(-0.15, 0, 0.46), ACCENT),
            _p(cylinder(0.045, 1.70).at(0.10, 0, 1.15), "brown"),
            _p(pyramid(1.00, 0.05, 1.25).at(-0.10, 0, 1.28), ACCENT),
            _p(pyramid(0.62, 0.04, 0.95).at(0.42, 0, 1.10), ACCENT),
            _p(box(0.36, 0.34, 0.20).at(-0.42, 0, 0.56), "brown"),
            _p(box(0.26, 0.03, 0.14).at(-0.03, 0, 1.93), "red"),
        ),
        "blue",
        "white",
        1.3,
    )


def _castle() -> Thing:
    towers = []
    for x in (-0.60, 0.60):
        for y in (-0.60, 0.60):
            towers += [
                _p(cylinder(0.22, 1.05).at(x, y, 0.52), MAIN),
                _p(cylinder(0.26, 0.10).at(x, y, 1.06), "grey"),
                _p(cone(0.29, 0.46).at(x, y, 1.33), ACCENT),
                _p(box(0.06, 0.07, 0.16).at(x + (0.20 if x > 0 else -0.20), y, 0.74), "charcoal"),
            ]
    merlons = [
        _p(box(0.12, 0.13, 0.13).at(x, y, 0.74), MAIN)
        for x, y in (*((a, b) for a in (-0.60, 0.60) for b in (-0.26, 0.0, 0.26)),
                     *((b, a) for a in (-0.60, 0.60) for b in (-0.26, 0.0, 0.26)))
    ]  # fmt: skip
    return Thing(
        (
            _p(box(1.30, 1.30, 0.68).at(z=0.34), MAIN),
            _p(box(0.56, 0.56, 1.00).at(z=0.90), MAIN),
            _p(pyramid(0.70, 0.70, 0.56).at(z=1.67), ACCENT),
            _p(box(0.06, 0.34, 0.34).at(0.64, 0, 0.17), "brown"),
            _p(cylinder(0.17, 0.06).turned("y", 90).at(0.64, 0, 0.34), "brown"),
            *(_p(box(0.06, 0.10, 0.18).at(x, 0, 1.14), "charcoal") for x in (-0.27, 0.27)),
            *merlons,
            *towers,
        ),
        "beige",
        "blue",
        1.8,
    )


def _cactus() -> Thing:
    arms = []
    for side, z in ((-1, 0.72), (1, 0.94)):
        arms += [
            _p(capsule(0.10, 0.44).turned("x", 90).at(0, 0.30 * side, z), MAIN),
            _p(capsule(0.10, 0.52).at(0, 0.46 * side, z + 0.18), MAIN),
        ]
    return Thing(
        (
            _p(capsule(0.20, 1.30).at(z=0.92), MAIN),
            *arms,
            _p(ellipsoid(0.08, 0.08, 0.05).at(z=1.57), "pink"),
            _p(frustum(0.26, 0.36, 0.40).at(z=0.20), ACCENT),
            _p(tube(0.41, 0.30, 0.10).at(z=0.40), ACCENT),
            _p(cylinder(0.33, 0.02).at(z=0.41), "brown"),
        ),
        "green",
        "orange",
        0.8,
    )


def _flower() -> Thing:
    petals = [
        _p(ellipsoid(0.06, 0.17, 0.24).at(0, 0, 0.33).turned("x", 45.0 * i).at(0.02, 0, 1.30), MAIN)
        for i in range(8)
    ]
    return Thing(
        (
            *petals,
            _p(ellipsoid(0.13, 0.20, 0.20).at(0.03, 0, 1.30), ACCENT),
            _p(cylinder(0.04, 1.25).at(-0.03, 0, 0.66), "green"),
            _p(ellipsoid(0.05, 0.30, 0.12).turned("x", 35).at(-0.03, 0.27, 0.52), "green"),
            _p(ellipsoid(0.05, 0.30, 0.12).turned("x", -35).at(-0.03, -0.27, 0.40), "green"),
            _p(ellipsoid(0.30, 0.30, 0.10).at(-0.03, 0, 0.05), "brown"),
        ),
        "pink",
        "yellow",
        0.7,
    )


def _windmill() -> Thing:
    blades = []
    for i in range(4):
        turn = 45.0 + 90.0 * i
        blades += [
            _p(box(0.04, 0.05, 0.95).at(0.47, 0, 0.48).turned("x", turn).at(0, 0, 1.30), "brown"),
            _p(box(0.03, 0.20, 0.66).at(0.47, 0.12, 0.60).turned("x", turn).at(0, 0, 1.30), ACCENT),
        ]
    return Thing(
        (
            _p(frustum(0.46, 0.30, 1.25).at(z=0.62), MAIN),
            _p(cone(0.38, 0.42).at(z=1.46), "brown"),
            _p(cylinder(0.06, 0.34).turned("y", 90).at(0.36, 0, 1.30), "charcoal"),
            _p(ball(0.08).at(0.52, 0, 1.30), "charcoal"),
            _p(box(0.10, 0.20, 0.36).at(0.42, 0, 0.20), "brown"),
            _p(box(0.08, 0.14, 0.16).at(0.36, 0, 0.78), "navy"),
            *(_p(box(0.10, 0.14, 0.16).at(0.385, 0, 0.70).turned("z", a), "navy") for a in (90, 180, 270)),
            *blades,
        ),
        "cream",
        "red",
        1.7,
    )


def _cake() -> Thing:
    cherries = [_p(ball(0.075).at(0.44).turned("z", 45.0 * i).at(z=0.56), ACCENT) for i in range(8)]
    candles = [
        part
        for i in range(3)
        for part in (
            _p(cylinder(0.035, 0.26).at(0.15).turned("z", 120.0 * i).at(z=0.95), "cyan"),
            _p(ellipsoid(0.035, 0.035, 0.06).at(0.15).turned("z", 120.0 * i).at(z=1.13), "yellow"),
        )
    ]
    return Thing(
        (
            _p(cylinder(0.78, 0.05).at(z=0.025), "silver"),
            _p(cylinder(0.60, 0.46).at(z=0.28), MAIN),
            _p(torus(0.585, 0.05).at(z=0.09), "white"),
            _p(torus(0.565, 0.05).at(z=0.50), "white"),
            _p(cylinder(0.34, 0.34).at(z=0.67), MAIN),
            _p(torus(0.315, 0.04).at(z=0.83), "white"),
            _p(torus(0.33, 0.04).at(z=0.54), "white"),
            *cherries,
            *candles,
        ),
        "pink",
        "red",
        0.8,
    )


def _icecream() -> Thing:
    return Thing(
        (
            _p(cone(0.36, 1.10).turned("x", 180).at(z=0.55), "beige", "brown", "checkered"),
            _p(ball(0.38).at(z=1.22), MAIN),
            _p(torus(0.35, 0.07).at(z=1.10), MAIN),
            _p(ball(0.29).at(z=1.68), ACCENT),
            _p(ball(0.09).at(z=2.00), "red"),
        ),
        "pink",
        "cream",
        0.7,
    )


def _candle() -> Thing:
    return Thing(
        (
            _p(cylinder(0.26, 1.00).at(z=0.62), MAIN),
            _p(capsule(0.06, 0.36).at(0.24, 0.06, 0.98), MAIN),
            _p(capsule(0.05, 0.50).at(-0.16, 0.19, 0.90), MAIN),
            _p(capsule(0.05, 0.30).at(0.02, -0.255, 1.00), MAIN),
            _p(torus(0.235, 0.04).at(z=1.12), MAIN),
            _p(cylinder(0.02, 0.16).at(z=1.18), "black"),
            _p(ellipsoid(0.10, 0.10, 0.16).at(z=1.36), "orange"),
            _p(cone(0.082, 0.22).at(z=1.52), "orange"),
            _p(frustum(0.40, 0.54, 0.12).at(z=0.08), ACCENT),
            _p(torus(0.50, 0.04).at(z=0.14), ACCENT),
            _p(torus(0.13, 0.035).turned("x", 90).at(0.64, 0, 0.12), ACCENT),
        ),
        "cream",
        "gold",
        0.5,
    )


def _planet() -> Thing:
    return Thing(
        (
            _p(ball(0.55), MAIN, ACCENT, "striped"),
            _p(tube(0.92, 0.70, 0.03).turned("x", 22), "beige"),
            _p(tube(1.05, 0.96, 0.03).turned("x", 22), "brown"),
        ),
        "orange",
        "cream",
        1.2,
    )


def _donut() -> Thing:
    sprinkles = []
    colours = ("yellow", "cyan", "red", "green", "white")
    for i in range(20):
        turn, tilt = 18.0 * i, (-34.0, 8.0, 38.0)[i % 3]
        seed = capsule(0.028, 0.13).turned("y", 90).turned("z", 47.0 * i).at(z=0.335).turned("y", tilt)
        sprinkles.append(_p(seed.at(0.62).turned("z", turn).at(z=0.05), colours[i % 5]))
    return Thing((_p(torus(0.62, 0.33), "beige"), _p(torus(0.62, 0.325).at(z=0.05), MAIN), *sprinkles),
                 "pink", "white", 0.6)  # fmt: skip


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
}  # fmt: skip
