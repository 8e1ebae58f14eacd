"""Programs: in which axes other programs show our files upright, and what each format loses.

No format of Gaussians states its axes, except glTF, so this is a matter of measurement or of what a program
documents about itself. This module is the only place with such facts. ``docs/exporting.md`` prints them, and
``configs/for/`` chooses the exporter and its axes for the programs that have a ``target``.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

from cadam3d.io.run_folder import (
    ASSET,
    ASSET_COMPRESSED_PLY,
    ASSET_GLB,
    ASSET_KSPLAT,
    ASSET_MESH_GLB,
    ASSET_SOG,
    ASSET_SPLAT,
    ASSET_SPZ,
    VIEWER,
)

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


@dataclass(frozen=True, kw_only=True)
class Format:
    """Properties of the files of one exporter."""

    file: str  # the usual name
    max_degree: int | None = None  # largest SH degree that the format can hold; None = all
    loss: str = ""  # what is rounded or left out; "" if nothing is
    sh_loss: str = ""  # the same for SH degrees above 0, as a continuation of the sentence
    hint: str = ""  # printed with the file


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

FORMATS: Mapping[str, Format] = {
    "ply": Format(
        file=ASSET,
    ),
    "compressed_ply": Format(
        file=ASSET_COMPRESSED_PLY,
        loss="rounds positions, scales and rotations to 10 or 11 bits, colours and opacities to 8",
        sh_loss="view-dependent colours to 8",
    ),
    "splat": Format(file=ASSET_SPLAT, max_degree=0, loss="rounds colours, opacities and rotations to 8 bits"),
    "spz": Format(
        file=ASSET_SPZ,
        loss="rounds positions to 24 bits, rotations to 10, colours, opacities and scales to 8",
        sh_loss="view-dependent colours to 4 or 5",
    ),
    "glb": Format(
        file=ASSET_GLB,
        hint="needs a program that knows KHR_gaussian_splatting; for triangles type 'exporter=[mesh]'",
    ),
    "sog": Format(
        file=ASSET_SOG, loss="rounds positions to 16 bits, and the rest to code books of 256 values"
    ),
    "ksplat": Format(file=ASSET_KSPLAT, max_degree=2, loss="rounds colours and opacities to 8 bits"),
    "mesh": Format(
        file=ASSET_MESH_GLB,
        loss="a closed surface in place of Gaussians",
        sh_loss="without view-dependent colours",
    ),
    "html": Format(file=VIEWER, hint="opens in any browser, without a network"),
}
# The files of an exporter that is not part of cadam3d.
OTHER = Format(file="")


@dataclass(frozen=True, kw_only=True)
class Unknown:
    """A program that people ask for, with axes that are neither measured nor documented by the program."""

    reason: str  # why for= does not offer it
    words: tuple[str, ...]  # what to try


UNKNOWN: Mapping[str, Unknown] = {
    "cesium": Unknown(
        reason="CesiumJS documents Gaussians in 3D Tiles, not in a single file",
        words=("exporter=[glb]",),
    ),
    "comfyui": Unknown(
        reason="ComfyUI documents which formats it reads, but not their axes",
        words=("exporter=[ply]", "exporter.ply.up=+y"),
    ),
    "unity": Unknown(
        reason="packages for Unity differ in their axes, and some mirror the object",
        words=("exporter=[ply]", "exporter.ply.up=+y", "exporter.ply.pad_sh=3"),
    ),
    "unreal": Unknown(
        reason="Epic documents which formats it imports, but not their axes",
        words=("exporter=[ply]", "exporter.ply.up=-y"),
    ),
}


@dataclass(frozen=True)
class Verdict:
    """The known programs that read a file, grouped by how they show it."""

    upright: list[Program] = field(default_factory=list)
    upside_down: list[Program] = field(default_factory=list)
    on_its_side: list[Program] = field(default_factory=list)


def judge(exporter: str, up: str) -> Verdict:
    """Return how known programs show a file of ``exporter`` whose up axis is ``up``."""
    verdict = Verdict()
    for program in PROGRAMS:
        wanted = program.upright.get(exporter)
        if wanted == up:
            verdict.upright.append(program)
        elif (wanted, up) in OPPOSITE:
            verdict.upside_down.append(program)
        elif wanted is not None:
            verdict.on_its_side.append(program)
    return verdict


def loss_of(exporter: str, sh_degree: int) -> str:
    """Return what a file of ``exporter`` loses of Gaussians with SH degree ``sh_degree``; "" if nothing."""
    format_ = FORMATS.get(exporter, OTHER)
    return ", ".join(part for part in (format_.loss, format_.sh_loss if sh_degree else "") if part)


def hint_of(exporter: str) -> str:
    """Return what else to know about a file of ``exporter``; "" if nothing."""
    return FORMATS.get(exporter, OTHER).hint
