"""Programs: in which axes other programs show our files upright, and what each format loses.

No format of Gaussians states its axes, except glTF, so this is a matter of measurement or of what a program
documents about itself. This module is the only place with such facts. ``docs/exporting.md`` prints them, and
``configs/for/`` chooses the exporter and its axes for the programs that have a ``target``.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

from cadam3d.core.sh import MAX_DEGREE

GLTF = "glTF 2.0, section 3.4: +Y is up"
# Pairs of up axes that are half a turn apart.
OPPOSITE = {("-y", "+y"), ("+y", "-y")}


@dataclass(frozen=True, kw_only=True)
class Program:
    """A program that shows our files."""

    name: str
    version: str  # that was measured, or the month in which its documentation was read
    # The up axis with which a file is upright, by the name of the exporter. Formats that the program does not
    # read, or whose axes in it are not known, are missing.
    upright: Mapping[str, str]
    is_measured: bool  # else documented by the program itself
    source: str
    target: str = ""  # the option of for= that writes for this program


@dataclass(frozen=True, kw_only=True)
class Format:
    """What a file of one exporter holds, compared with the Gaussians in memory."""

    is_mesh: bool = False
    has_axes: bool = True  # whether other programs read the numbers of the file
    max_degree: int = MAX_DEGREE  # largest SH degree that the format can hold
    loss: str = ""  # numbers that are rounded or left out; "" for none
    hint: str = ""  # printed with the file


# Measured in headless Chromium or Node, with an asset that is not symmetric, against our own render from the
# same camera.
PROGRAMS: tuple[Program, ...] = (
    Program(
        name="SuperSplat",
        version="splat-transform 3.7.0",
        upright={"ply": "-y"},
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
        upright={"ply": "+y", "compressed_ply": "+y", "spz": "+y"},
        is_measured=True,
        source="SplatMesh shows the numbers of the file unchanged, in the +y up world of three.js",
        target="spark",
    ),
    Program(
        name="three.js",
        version="r187",
        upright={"ply": "+y", "spz": "+y", "glb": "+y", "mesh": "+y"},
        is_measured=True,
        source="addons of the core: GLTFLoader, PLYLoader and SPZLoader",
        target="three",
    ),
    Program(
        name="Babylon.js",
        version="November 2026",
        upright={"glb": "+y", "mesh": "+y"},
        is_measured=False,
        source="doc.babylonjs.com/features/featuresDeepDive/mesh/gaussianSplatting; " + GLTF,
        target="babylon",
    ),
    Program(
        name="PlayCanvas",
        version="November 2026",
        upright={"glb": "+y", "mesh": "+y"},
        is_measured=False,
        source="developer.playcanvas.com/user-manual/gaussian-splatting/formats/glb; " + GLTF,
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
    "ply": Format(),
    "compressed_ply": Format(loss="rounds positions, scales and rotations to 10 or 11 bits, colours to 8"),
    "splat": Format(max_degree=0, loss="rounds colours, opacities and rotations to 8 bits"),
    "spz": Format(loss="rounds positions to 24 bits, rotations to 10, the rest to 8 or fewer"),
    "glb": Format(hint="needs a reader of KHR_gaussian_splatting; triangles are exporter=[mesh]"),
    "sog": Format(loss="rounds positions to 16 bits, the rest to 8"),
    "ksplat": Format(loss="rounds positions, scales and rotations to 16 bits, colours to 8"),
    "mesh": Format(is_mesh=True, loss="a closed surface with one colour per vertex, nothing transparent"),
    "html": Format(has_axes=False, hint="opens in any browser, without a network"),
}


@dataclass(frozen=True, kw_only=True)
class Unknown:
    """A program that people ask for, but whose axes are neither measured nor documented by itself."""

    reason: str
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
        words=("exporter=[ply]", "exporter.ply.up=+y", f"exporter.ply.pad_sh={MAX_DEGREE}"),
    ),
    "unreal": Unknown(
        reason="Epic documents which formats it imports, but not their axes",
        words=("exporter=[ply]", "exporter.ply.up=-y"),
    ),
}


@dataclass(frozen=True)
class Verdict:
    """How known programs show a file."""

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


def losses(exporter: str, sh_degree: int) -> list[str]:
    """Return what a file of ``exporter`` loses of Gaussians with colours of degree ``sh_degree``."""
    format_ = FORMATS.get(exporter, Format())
    lost = [format_.loss] if format_.loss else []
    if sh_degree > format_.max_degree and not format_.is_mesh:
        lost.append("leaves out how colours change with the direction of view")
    return lost
