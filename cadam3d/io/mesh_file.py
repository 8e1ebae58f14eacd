"""Reading meshes with textures: glb, glTF, OBJ with MTL, PLY, STL, OFF, and zip files with one of them."""

import logging
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from jaxtyping import Float
from PIL import Image
from trimesh.resolvers import FilePathResolver, Resolver

from cadam3d.core.console import say
from cadam3d.core.errors import UserError
from cadam3d.core.mesh.textured import TexturedMesh, Textures
from cadam3d.io.frames import points_to_world
from cadam3d.io.gltf import linear, srgb
from cadam3d.io.reading import read_bytes
from cadam3d.io.run_folder import found_file

# Other formats of trimesh may refer to files elsewhere, or run other programs.
SUFFIXES = (".glb", ".gltf", ".obj", ".off", ".ply", ".stl")
# Vertex colours are linear in these files, and textures are sRGB (glTF 2.0, sec. 3.9.2). Other
# formats have sRGB colours only.
LINEAR_SUFFIXES = (".glb", ".gltf")
LARGEST_FILE = 1 << 30  # bytes of a mesh, a material, a buffer or a picture; in a zip file of all together
LARGEST_PICTURE = 1 << 26  # pixels of a picture that is read
FINEST = 1024  # pixels per side of a picture that is kept
# Linear colours of vertices, among the attributes of a part.
VERTEX_LIGHT = "vertex light"


def read_mesh(
    path: str, key: str, *, up: str = "+z", plain: Sequence[float] = (0.5, 0.5, 0.5)
) -> TexturedMesh:
    """Return the surfaces of the file that the setting ``key`` names, at their places in the scene.

    ``up`` is the up axis of the file, and the RGB colour ``plain`` is that of parts without colours. Nothing
    is moved or scaled. Raises ``UserError`` if the file is missing, cannot be read or has no surface.
    """
    file = found_file(path, key)
    nearby = _ZippedFiles(file) if file.suffix.lower() == ".zip" else _NearbyFiles(str(file))
    # Every format has its own parser, with its own exceptions.
    try:
        parts = _parts(file, nearby)
        found = {id(image) for part in parts if (image := _image_of(part.visual)) is not None}
        mesh = _joined(parts, up, plain)
    except Exception as error:
        raise UserError(
            f"{key}: expected a file with a mesh ({', '.join(SUFFIXES)}, or one of them in a .zip), "
            f"got {path!r}, which cannot be read ({str(error) or type(error).__name__})."
        ) from error
    asked = {name for name in nearby.asked if not name.lower().endswith((".mtl", ".bin"))}
    if len(found) < len(asked):
        reason = "has a texture that cannot be read, so it has the colour of its material there"
        say(f"Note: {file.name} {reason}", logging.WARNING)
    if not bool(mesh.vertices.isfinite().all()) or sum(float(part.area) for part in parts) <= 0:
        raise UserError(f"{key}: expected a mesh with triangles, got {path!r}, which has no surface.")
    return mesh


class _NearbyFiles(FilePathResolver):
    """Reads the files that a mesh names, if they are regular files in its folder, and remembers the names."""

    def __init__(self, source: str) -> None:
        super().__init__(source)
        self.asked: list[str] = []

    def get(self, name: str) -> bytes:
        """Return the content of the file ``name``. Raises ``UserError`` if it cannot be read."""
        self.asked.append(name)
        return read_bytes(self.absolute(name), largest=LARGEST_FILE)

    def namespaced(self, namespace: str) -> "_NearbyFiles":
        return _NearbyFiles(str(Path(self.parent, namespace)))


class _ZippedFiles(Resolver):
    """Reads the files of a zip file, whose names are relative to the first mesh in it."""

    def __init__(self, path: Path) -> None:
        self.archive = zipfile.ZipFile(path)
        self.asked: list[str] = []
        if sum(entry.file_size for entry in self.archive.infolist()) > LARGEST_FILE:
            raise ValueError(f"it holds more than {LARGEST_FILE:,} bytes")
        self.mesh = min(
            (name for name in self.archive.namelist() if Path(name).suffix.lower() in SUFFIXES),
            default="",
        )

    def get(self, name: str) -> bytes:
        self.asked.append(name)
        with self.archive.open((Path(self.mesh).parent / name).as_posix()) as file:
            return file.read(LARGEST_FILE)

    def keys(self) -> list[str]:
        return self.archive.namelist()

    def write(self, name: str, data: Any) -> None:
        raise NotImplementedError

    def namespaced(self, namespace: str) -> "_ZippedFiles":
        raise NotImplementedError


def _parts(path: Path, nearby: "_NearbyFiles | _ZippedFiles") -> list[trimesh.Trimesh]:
    """Return the surfaces of a file, each at its place in the scene and with its own colours."""
    suffix = path.suffix.lower()
    if isinstance(nearby, _ZippedFiles):
        suffix = Path(nearby.mesh).suffix.lower()
        content = trimesh.util.wrap_as_stream(nearby.get(Path(nearby.mesh).name))
        scene = trimesh.load_scene(content, file_type=suffix[1:], resolver=nearby)
    else:
        if suffix not in SUFFIXES:
            raise ValueError("another kind of file")
        scene = trimesh.load_scene(path, resolver=nearby)
    if suffix in LINEAR_SUFFIXES:
        for geometry in scene.geometry.values():
            _keep_vertex_light(geometry)
    return [part for part in scene.dump() if isinstance(part, trimesh.Trimesh) and len(part.faces)]


def _keep_vertex_light(geometry: Any) -> None:
    """Store the vertex colours of a mesh from a glTF file where a copy of the mesh keeps them.

    trimesh drops the vertex colours of a mesh with a material when it copies the mesh.
    """
    if not isinstance(geometry, trimesh.Trimesh):
        return
    visual: Any = geometry.visual
    colors = visual.vertex_colors if visual.kind == "vertex" else None
    if visual.kind == "texture":
        colors = visual.vertex_attributes.get("color")
    if colors is None or len(colors) != len(geometry.vertices):
        return
    most = np.iinfo(colors.dtype).max if colors.dtype.kind in "ui" else 1.0
    light = np.asarray(colors, dtype=np.float64)[:, :3] / most
    geometry.vertex_attributes[VERTEX_LIGHT] = light.clip(0, 1)


def _joined(parts: Sequence[trimesh.Trimesh], up: str, plain: Sequence[float]) -> TexturedMesh:
    """Return all parts as one mesh in world axes."""
    if not parts:
        parts = [trimesh.Trimesh(np.zeros((1, 3)), np.zeros((1, 3), dtype=int), process=False)]
    rows: list[tuple[Any, ...]] = []
    first = 0
    for number, part in enumerate(parts):
        faces, vertices = np.asarray(part.faces), np.asarray(part.vertices)
        visual: Any = part.visual
        if visual.kind == "face":
            vertices, faces = vertices[faces.reshape(-1)], np.arange(faces.size).reshape(-1, 3)
        uv = getattr(visual, "uv", None)
        uv = np.zeros((len(vertices), 2)) if uv is None else np.asarray(uv)[:, :2]
        rows.append((vertices, faces + first, uv, _tint(part, plain), np.full(len(faces), number)))
        first += len(vertices)
    vertices, faces, uv, tint, picture = (
        torch.from_numpy(np.concatenate(column)) for column in zip(*rows, strict=True)
    )
    return TexturedMesh(
        vertices=points_to_world(vertices.float(), up),
        faces=faces.long(),
        uv=uv.nan_to_num().float(),
        tint=tint.float(),
        picture=picture,
        textures=Textures.of([_picture(part) for part in parts]),
    )


def _tint(part: trimesh.Trimesh, plain: Sequence[float]) -> Float[np.ndarray, "n 3"]:
    """Return the sRGB colours of the vertices in [0, 1], which multiply the picture of the part.

    Gamma is nearly a power, so that the product of colours is that of the light.
    """
    visual: Any = part.visual
    light = part.vertex_attributes.get(VERTEX_LIGHT)
    if light is not None:
        return srgb(light)
    if visual.kind == "vertex":
        return np.asarray(visual.vertex_colors)[:, :3] / 255
    if visual.kind == "face":
        return np.repeat(np.asarray(visual.face_colors)[:, :3] / 255, 3, axis=0)
    return np.tile([1.0, 1.0, 1.0] if visual.kind == "texture" else list(plain), (len(part.vertices), 1))


def _picture(part: trimesh.Trimesh) -> np.ndarray:
    """Return the picture of a part as RGBA; one pixel if it has none. Holes are where alpha is below 1/2."""
    visual: Any = part.visual
    if visual.kind != "texture":
        return np.full((1, 1, 4), 255, np.uint8)
    material, image = visual.material, _image_of(visual)
    mode = getattr(material, "alphaMode", None) or ("MASK" if hasattr(material, "image") else "OPAQUE")
    factor = getattr(material, "baseColorFactor", None)
    factor = np.ones(4) if factor is None else np.asarray(factor) / 255
    cutoff = getattr(material, "alphaCutoff", None)
    solid = factor[3] * 0.5 / max(0.5 if cutoff is None else cutoff, 0.01)
    if image is None or visual.uv is None:
        is_linear = hasattr(material, "baseColorFactor")
        flat = 255 * srgb(factor[:3]) if is_linear else np.asarray(material.main_color)[:3]
        alpha = 255 if mode == "OPAQUE" else min(255, round(255 * solid))
        return np.array([[[*flat.round(), alpha]]], dtype=np.uint8)
    image.thumbnail((FINEST, FINEST))
    rgba = np.array(image.convert("RGBA"))
    rgba[..., 3] = 255 if mode == "OPAQUE" else (rgba[..., 3] * solid).clip(max=255).round()
    if (factor < 1).any():
        rgba[..., :3] = (255 * srgb(linear(rgba[..., :3] / 255) * factor[:3])).round()
    return rgba


def _image_of(visual: Any) -> Image.Image | None:
    """Return the picture of a part, or None if it has none that can be decoded."""
    material = getattr(visual, "material", None)
    image = getattr(material, "image", None) or getattr(material, "baseColorTexture", None)
    if image is None:
        return None
    if image.width * image.height > LARGEST_PICTURE:
        raise ValueError(f"a picture has {image.width} x {image.height} pixels")
    try:
        image.load()
    except (OSError, SyntaxError):  # what Pillow raises for a damaged picture
        return None
    return image
