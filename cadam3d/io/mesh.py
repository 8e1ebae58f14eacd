"""Files of triangle meshes: glb, obj and ply with vertex colours or a texture, and stl without colours.

The first three are written so that other programs show the colours of our renders. glTF multiplies colours
with light and defines vertex colours as linear (glTF 2.0, sec. 3.9.2), so the material of a glb is unlit
(``KHR_materials_unlit``) and its vertex colours are converted from sRGB, as 16-bit numbers, which keeps dark
colours apart. A texture is sRGB in every format. Vertex colours of obj (``v x y z r g b``) and ply (``uchar
red green blue``) are sRGB by convention. An stl is for printers, whose programs take its unit for a
millimetre, so a world unit becomes 50 of them, and the unit ball is 100 mm wide.
"""

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import numpy as np
import torch
from jaxtyping import Float, Int, UInt8

from cadam3d import __version__
from cadam3d.core.mesh.surface import Surface
from cadam3d.io.atomic import replacing
from cadam3d.io.frames import points_to_file
from cadam3d.io.gltf import linear, write_gltf
from cadam3d.io.ply_tables import header_text
from cadam3d.io.reading import unusable

FORMATS = ("glb", "obj", "ply", "stl")
MILLIMETRES = 50.0  # of a world unit in an stl
# Constants of glTF for the sampling of textures.
LINEAR, CLAMP = 9729, 33071
NAME = "cadam3d"
UNLIT = "KHR_materials_unlit"


@dataclass(frozen=True)
class Texture:
    """A picture for a surface; vertices are repeated where the picture is cut."""

    vertices: Int[np.ndarray, "t"]  # vertex of the surface for each vertex of the textured mesh
    faces: Int[np.ndarray, "f 3"]  # of the textured mesh
    uv: Float[np.ndarray, "t 2"]  # in [0, 1], from the lower left corner of the picture
    picture: UInt8[np.ndarray, "h w 3"]  # sRGB


def write_glb(path: Path, surface: Surface, *, up: str, texture: Texture | None = None) -> None:
    """Write one binary glTF file with an unlit material, atomically.

    glTF defines ``+y`` as up; another ``up`` turns the numbers and not the definition. Raises ``UserError``
    if the file cannot be written.
    """
    positions, normals, colors = _corners_in_file(surface, up, texture)
    attributes = {"POSITION": positions, "NORMAL": normals}
    shading: dict[str, object] = {"baseColorFactor": [1, 1, 1, 1], "metallicFactor": 0, "roughnessFactor": 1}
    material = {"name": NAME, "pbrMetallicRoughness": shading, "extensions": {UNLIT: {}}}
    entries: dict[str, object] = {"extensionsUsed": [UNLIT], "materials": [material]}
    if texture is None:
        # Four numbers instead of three, because every element has to begin at a multiple of four bytes.
        rgba = np.concatenate([linear(colors), np.ones((len(colors), 1))], axis=1)
        attributes["COLOR_0"] = np.rint(rgba * 65535).astype("<u2")
    else:
        # glTF measures v from the upper edge.
        flipped = np.stack([texture.uv[:, 0], 1 - texture.uv[:, 1]], axis=1)
        attributes["TEXCOORD_0"] = flipped.astype("<f4")
        shading["baseColorTexture"] = {"index": 0}
        entries["textures"] = [{"sampler": 0, "source": 0}]
        entries["samplers"] = [{"magFilter": LINEAR, "minFilter": LINEAR, "wrapS": CLAMP, "wrapT": CLAMP}]
    write_gltf(
        path,
        NAME,
        attributes,
        {"material": 0},
        indices=(texture or surface).faces.reshape(-1, 1).astype("<u4"),
        picture=b"" if texture is None else _png(texture),
        **entries,
    )


def write_mesh_ply(path: Path, surface: Surface, *, up: str) -> None:
    """Write a binary ply with normals and vertex colours, atomically.

    Raises ``UserError`` if the file cannot be written.
    """
    positions, normals, colors = _corners_in_file(surface, up, None)
    vertex = np.zeros(len(positions), dtype=[("place", "<f4", 6), ("rgb", "u1", 3)])
    vertex["place"] = np.concatenate([positions, normals], axis=1)
    vertex["rgb"] = np.rint(colors * 255)
    face = np.zeros(len(surface.faces), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    face["count"], face["corners"] = 3, surface.faces
    columns = [f"float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")]
    columns += [f"uchar {name}" for name in ("red", "green", "blue")]
    elements = {"vertex": (len(vertex), columns), "face": (len(face), ["list uchar int vertex_indices"])}
    with replacing(path) as temporary:
        temporary.write_bytes(header_text(None, elements) + vertex.tobytes() + face.tobytes())


def write_stl(path: Path, surface: Surface, *, up: str) -> None:
    """Write a binary stl in millimetres, atomically. Raises ``UserError`` if the file cannot be written."""
    corners = MILLIMETRES * _corners_in_file(surface, up, None)[0][surface.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    records = np.zeros(
        len(corners), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("zero", "<u2")]
    )
    records["normal"], records["corners"] = normals / np.maximum(lengths, 1e-30), corners
    head = f"{NAME} {__version__}".encode("ascii").ljust(80) + struct.pack("<I", len(records))
    with replacing(path) as temporary:
        temporary.write_bytes(head + records.tobytes())


def write_obj(path: Path, surface: Surface, *, up: str, texture: Texture | None = None) -> list[Path]:
    """Write an obj file, for a texture also its material and picture, and return the paths.

    The files have the name of ``path`` with the suffixes ``.obj``, ``.mtl`` and ``.png``. Each one appears
    whole or not at all, and the obj comes last, so that it never refers to something that is missing. Raises
    ``UserError`` if a file cannot be written.
    """
    positions, normals, colors = _corners_in_file(surface, up, texture)
    head, corner, files = [f"# {NAME} {__version__}"], "{0}//{0}", [path]
    if texture is None:
        lines = _rows("v", np.concatenate([positions, colors], axis=1)) + _rows("vn", normals)
    else:
        material, picture = path.with_suffix(".mtl"), path.with_suffix(".png")
        files += [material, picture]
        with replacing(picture) as temporary:
            temporary.write_bytes(_png(texture))
        # Colour from the picture alone: white diffuse, no ambient and no highlight (illumination model 1).
        shading = [f"newmtl {NAME}", "Ka 0 0 0", "Kd 1 1 1", "Ks 0 0 0", "illum 1", f"map_Kd {picture.name}"]
        with replacing(material) as temporary:
            temporary.write_text("\n".join(shading) + "\n", encoding="utf-8")
        head += [f"mtllib {material.name}", f"usemtl {NAME}"]
        corner = "{0}/{0}/{0}"
        lines = _rows("v", positions) + _rows("vn", normals) + _rows("vt", texture.uv)
    corners = ((texture or surface).faces + 1).tolist()
    lines += ["f " + " ".join(corner.format(number) for number in face) for face in corners]
    with replacing(path) as temporary:
        temporary.write_text("\n".join([*head, *lines]) + "\n", encoding="utf-8")
    return files


def read_mesh(path: Path) -> Any:
    """Return the mesh in a file of any of the formats, as trimesh describes it.

    Vertices at the same place count as one, because a texture repeats them. Raises ``UserError`` if the file
    cannot be read.
    """
    import trimesh  # slow to import

    # Every format has its own parser, with its own exceptions.
    try:
        mesh = trimesh.load_mesh(path, process=False)
        if len(mesh.faces) == 0:
            raise ValueError("it has no triangles")
    except Exception as error:
        raise unusable(path, f"expected a mesh, got a file that cannot be read ({error!r})") from error
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    return mesh


def _corners_in_file(surface: Surface, up: str, texture: Texture | None) -> list[Float[np.ndarray, "w 3"]]:
    """Return positions and normals of the vertices in the axes of a file, and their colours."""
    rows = np.arange(len(surface.vertices)) if texture is None else texture.vertices
    turned = [
        points_to_file(torch.from_numpy(vectors[rows]), up).numpy().astype(np.float32)
        for vectors in (surface.vertices, surface.normals)
    ]
    return [*turned, surface.colors[rows]]


def _png(texture: Texture) -> bytes:
    return imageio.imwrite("<bytes>", texture.picture, extension=".png")


def _rows(word: str, values: Float[np.ndarray, "r c"]) -> list[str]:
    """Return one line of an obj file for each row."""
    row = f"{word} " + " ".join(["%.6g"] * values.shape[1])
    return [row % tuple(numbers) for numbers in values.tolist()]
