"""Programs: in which axes other programs show our files upright.

No format of Gaussians states its axes, except glTF, so this is a matter of measurement or of what a program
documents about itself. This module is the only place with such facts. ``docs/exporting.md`` prints them, and
``configs/for/`` chooses the exporter and its axes for the programs that have a ``target``.
"""

from collections.abc import Mapping
from dataclasses import dataclass

# How a program shows a file.
UPRIGHT, UPSIDE_DOWN, ON_ITS_SIDE = "upright", "upside down", "on its side"
GLTF = "glTF 2.0, section 3.4: +Y is up"
# Pairs of up axes that are half a turn apart.
OPPOSITE = {("-y", "+y"), ("+y", "-y")}


@dataclass(frozen=True, kw_only=True)
class Program:
    """A program that shows our files."""

    name: str
    version: str  # the measured one, or the month in which its documentation was read
    # The up axis with which a file is upright, by the name of the exporter. Formats that the program does not
    # read, or whose axes in it are not known, are missing.
    upright: Mapping[str, str]
    is_measured: bool  # else documented by the program itself
    source: str
    target: str  # the option of for= that writes for this program


# Measured means that the program has drawn an object without symmetry, in Node or in headless Chromium, and
# that the picture equals our own render from the same camera. ``tests/programs/`` repeats this for all of
# them except viser.
PROGRAMS: tuple[Program, ...] = (
    Program(
        name="SuperSplat",
        version="splat-transform 3.7.0",
        upright=dict.fromkeys(("ply", "compressed_ply", "splat", "spz", "sog", "ksplat"), "-y"),
        is_measured=True,
        source="github.com/playcanvas/supersplat/issues/451: PLY files are turned by 180 degrees about z",
        target="supersplat",
    ),
    Program(
        name="viser",
        version="1.1.1",
        upright={"ply": "-y"},
        is_measured=True,
        source="add_gaussian_splats with default settings",
        target="viser",
    ),
    Program(
        name="Spark",
        version="2.2.0",
        upright=dict.fromkeys(("ply", "compressed_ply", "splat", "spz", "sog", "ksplat"), "+y"),
        is_measured=True,
        source="SplatMesh shows the numbers of the file unchanged, in the +y up world of three.js",
        target="spark",
    ),
    Program(
        name="three.js",
        version="r187",
        upright=dict.fromkeys(("ply", "splat", "spz", "ksplat", "glb", "mesh"), "+y"),
        is_measured=True,
        source="addons of the core",
        target="three",
    ),
    Program(
        name="Babylon.js",
        version="9.28.0",
        # In its usual left-handed scenes. In a right-handed one, only glb is not mirrored.
        upright={"ply": "-y", "compressed_ply": "-y", "splat": "-y", "glb": "+y", "mesh": "+y"},
        is_measured=True,
        source="AppendSceneAsync with default settings; the mesh: " + GLTF,
        target="babylon",
    ),
    Program(
        name="PlayCanvas",
        version="engine 2.23.3",
        # The engine shows the numbers of a file unchanged; only SuperSplat turns them.
        upright={"ply": "+y", "compressed_ply": "+y", "sog": "+y", "glb": "+y", "mesh": "+y"},
        is_measured=True,
        source="assets of the types gsplat and container; the mesh: " + GLTF,
        target="playcanvas",
    ),
    Program(
        name="Omniverse",
        version="November 2026",
        upright={"ply": "+y"},
        is_measured=False,
        source="docs.omniverse.nvidia.com/extensions/latest/ext_gsplat-converter: up axis Y, no rotation",
        target="omniverse",
    ),
    Program(
        name="Blender",
        version="November 2026",
        upright={"mesh": "+y"},
        is_measured=False,
        source="docs.blender.org/manual/en/latest/addons/import_export/scene_gltf2.html; " + GLTF,
        target="blender",
    ),
)


def shown_as(exporter: str, up: str) -> dict[str, list[Program]]:
    """Return the programs that read a file of ``exporter``, by how they show it if its up axis is ``up``.

    The keys are ``UPRIGHT``, ``UPSIDE_DOWN`` and ``ON_ITS_SIDE``.
    """
    ways: dict[str, list[Program]] = {UPRIGHT: [], UPSIDE_DOWN: [], ON_ITS_SIDE: []}
    for program in PROGRAMS:
        wanted = program.upright.get(exporter)
        if wanted == up:
            ways[UPRIGHT].append(program)
        elif (wanted, up) in OPPOSITE:
            ways[UPSIDE_DOWN].append(program)
        elif wanted is not None:
            ways[ON_ITS_SIDE].append(program)
    return ways
