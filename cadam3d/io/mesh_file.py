"""Reading meshes with textures: glb, glTF, OBJ with MTL, PLY, STL, OFF, and zip files with one of them.

A file may come from a stranger, so what it describes is bounded by its size before it is read.
"""

import json
import logging
import posixpath
import warnings
import zipfile
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import unquote

import numpy as np
import torch
import trimesh
from jaxtyping import Float
from PIL import Image
from trimesh.resolvers import FilePathResolver

from cadam3d.core.console import say
from cadam3d.core.errors import UserError
from cadam3d.core.mesh.textured import MESH_SUFFIXES, TexturedMesh, Textures
from cadam3d.io.frames import points_to_world
from cadam3d.io.gltf import leading_document, linear, srgb
from cadam3d.io.reading import read_bytes
from cadam3d.io.run_folder import found_file

# Vertex colours are linear in these files, and textures are sRGB (glTF 2.0, sec. 3.9.2). Other
# formats have sRGB colours only.
LINEAR_SUFFIXES = (".glb", ".gltf")
NO_PICTURES = (".mtl", ".bin")
LARGEST_FILE = 1 << 30  # bytes of a mesh, a material, a buffer or a picture
# What a file describes may be so many times as large as the file, and this more: the bytes of a zip file, and
# the rows of all arrays of a glTF file, which can use an array many times.
MOST_EXPANSION = 20
SPARE_BYTES = 1 << 26
SPARE_ROWS = 1 << 20
LARGEST_PICTURE = 1 << 26  # pixels of a picture that is read
FINEST = 1024  # pixels per side of a picture that is kept
MOST_PIXELS = 1 << 27  # of all pictures that are kept
FARTHEST = 1e100  # units of the file
LONGEST = 200  # characters of a text from the file in a message


def read_mesh(
    path: str, key: str, *, up: str = "+z", plain: Sequence[float] = (0.5, 0.5, 0.5)
) -> TexturedMesh:
    """Return the surfaces of the file that the setting ``key`` names, at their places in the scene.

    ``up`` is the up axis of the file, and the RGB colour ``plain`` is that of parts without colours. Nothing
    is moved or scaled, and positions are in float64. A note says which textures cannot be read. Raises
    ``UserError`` if the file is missing, cannot be read or has no surface.
    """
    file = found_file(path, key)
    # Every format has its own parser, with its own exceptions.
    try:
        with _quiet():
            source = _Zipped(file) if file.suffix.lower() == ".zip" else _Nearby(file)
            document = _document(source) if source.suffix in LINEAR_SUFFIXES else {}
            mesh = _joined(_parts(source), source, up, plain)
            area = _area(mesh)
            notes = [*source.notes, *_lost_textures(source, document)]
    except Exception as error:
        reason = " ".join(str(error).split())[:LONGEST] or type(error).__name__
        raise UserError(
            f"{key}: expected a file with a mesh ({', '.join(MESH_SUFFIXES)}, or one of them in a .zip), "
            f"got {path!r}, which cannot be read ({reason})."
        ) from error
    if not area > 0:
        needed = ", ".join(map(str, document.get("extensionsRequired", ())))[:LONGEST]
        lack = "which has no surface" + (f" that can be read without {needed}" if needed else "")
        raise UserError(f"{key}: expected a mesh with triangles, got {path!r}, {lack}.")
    for note in notes:
        say(f"Note: {file.name} {note}", logging.WARNING)
    return mesh


class _Source(ABC):
    """The file of a mesh and those that it names; it is what trimesh calls a resolver."""

    suffix: str  # of the mesh
    content: bytes  # of the mesh

    def __init__(self) -> None:
        self.files: dict[str, bytes] = {}
        self.lost: set[str] = set()  # names of files that cannot be read
        self.notes: list[str] = []
        self.pictures: dict[int, np.ndarray | None] = {}  # by the identity of the image

    @abstractmethod
    def read(self, name: str) -> bytes:
        """Return the content of a file whose name is relative to the mesh. Raises if it cannot be read."""

    def get(self, name: str) -> bytes:
        """Return the content of the file ``name``, as materials, buffers and pictures are named in a mesh."""
        if name not in self.files:
            self.lost.add(name)
            self.files[name] = self._read_as_named(name.strip().replace("\\", "/"))
            if not name.lower().endswith(NO_PICTURES):
                Image.open(BytesIO(self.files[name]))
            self.lost.remove(name)
        return self.files[name]

    def __getitem__(self, name: str) -> bytes:
        return self.get(name)

    def picture(self, image: Image.Image) -> np.ndarray | None:
        """Return the pixels of an image of trimesh as RGBA, or None if it cannot be decoded."""
        if id(image) not in self.pictures:
            self.pictures[id(image)] = _decoded(image)
        return self.pictures[id(image)]

    def _read_as_named(self, name: str) -> bytes:
        # The names of glTF are addresses, in which a blank is %20, but not every program knows that.
        try:
            return self.read(name)
        except (UserError, KeyError):
            return self.read(unquote(name))


class _Nearby(_Source):
    """A mesh file, and regular files in its folder."""

    def __init__(self, file: Path) -> None:
        super().__init__()
        self.suffix, self.folder = file.suffix.lower(), FilePathResolver(str(file))
        if self.suffix not in MESH_SUFFIXES:
            raise ValueError("another kind of file")
        self.content = read_bytes(file, largest=LARGEST_FILE)

    def read(self, name: str) -> bytes:
        """Return the content of a file. Raises ``UserError``, or ``ValueError`` outside of the folder."""
        return read_bytes(self.folder.absolute(name), largest=LARGEST_FILE)


class _Zipped(_Source):
    """The first mesh of a zip file, and the other files in it. Nothing is written to the disk."""

    def __init__(self, file: Path) -> None:
        super().__init__()
        self.archive = zipfile.ZipFile(file)
        most = MOST_EXPANSION * file.stat().st_size + SPARE_BYTES
        if (total := sum(entry.file_size for entry in self.archive.infolist())) > most:
            raise ValueError(f"it unpacks to {total:,} bytes, and {most:,} are plausible for its size")
        names = sorted(filter(_is_mesh, self.archive.namelist()))
        if not names:
            raise ValueError("there is no mesh in it")
        if len(names) > 1:
            self.notes = [f"has {len(names)} meshes, of which {names[0][:LONGEST]} is read"]
        self.folder, self.suffix = posixpath.dirname(names[0]), PurePosixPath(names[0]).suffix.lower()
        self.content = self.archive.read(names[0])

    def read(self, name: str) -> bytes:
        """Return the content of a file. Raises ``KeyError`` if there is none."""
        return self.archive.read(posixpath.normpath(posixpath.join(self.folder, name)))


def _is_mesh(name: str) -> bool:
    """Return whether a name in a zip file is that of a mesh. macOS adds hidden files with such names."""
    path = PurePosixPath(name)
    return path.suffix.lower() in MESH_SUFFIXES and not path.name.startswith(".")


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep the warnings of NumPy, Pillow and trimesh back, which would be lines between our own."""
    log = logging.getLogger("trimesh")
    level = log.level
    log.setLevel(logging.CRITICAL)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        log.setLevel(level)


def _document(source: _Source) -> Any:
    """Return the JSON document of a glTF file. Raises ``ValueError`` if it describes too many rows."""
    content = source.content
    document = leading_document(content)[0] if source.suffix == ".glb" else json.loads(content)
    uris = [buffer.get("uri", "data:") for buffer in document.get("buffers", ())]
    size = len(content) + sum(len(source.get(uri)) for uri in uris if not uri.startswith("data:"))
    counts = [accessor["count"] for accessor in document.get("accessors", ())]
    uses = Counter(node.get("mesh") for node in document.get("nodes", ()))
    rows = sum(counts)
    for number, mesh in enumerate(document.get("meshes", ())):
        arrays = [
            index
            for primitive in mesh["primitives"]
            for index in (primitive["attributes"].get("POSITION"), primitive.get("indices"))
            if index is not None
        ]
        rows += max(1, uses[number]) * sum(counts[index] for index in arrays)
    if rows > (most := MOST_EXPANSION * size + SPARE_ROWS) or min(counts, default=0) < 0:
        raise ValueError(f"it describes {rows:,} rows, and {most:,} are plausible for its size")
    return document


def _parts(source: _Source) -> list[tuple[trimesh.Trimesh, Float[np.ndarray, "4 4"]]]:
    """Return the surfaces of a file, each with its place in the scene; one may be at several places."""
    content = trimesh.util.wrap_as_stream(source.content)
    resolver: Any = source
    scene = trimesh.load_scene(content, file_type=source.suffix[1:], resolver=resolver, process=False)
    for part in scene.geometry.values():
        faces = part.faces if isinstance(part, trimesh.Trimesh) else np.zeros((0, 3), int)
        if len(faces) and not 0 <= faces.min() <= faces.max() < len(part.vertices):
            raise ValueError("a triangle has a corner that does not exist")
    placed = (scene.graph[node] for node in scene.graph.nodes_geometry)
    parts = [(scene.geometry[name], matrix) for matrix, name in placed]
    return [each for each in parts if isinstance(each[0], trimesh.Trimesh) and len(each[0].faces)]


def _joined(
    parts: Sequence[tuple[trimesh.Trimesh, Float[np.ndarray, "4 4"]]],
    source: _Source,
    up: str,
    plain: Sequence[float],
) -> TexturedMesh:
    """Return all parts as one mesh in world axes."""
    if not parts:
        parts = [(trimesh.Trimesh(np.zeros((1, 3)), np.zeros((1, 3), dtype=int), process=False), np.eye(4))]
    rows: list[tuple[Any, ...]] = []
    looks: dict[Any, int] = {}
    pictures: list[np.ndarray] = []
    first = 0
    for part, matrix in parts:
        vertices, faces, uv = np.asarray(part.vertices), np.asarray(part.faces), _uv(part)
        tint = _tint(part, source.suffix in LINEAR_SUFFIXES, plain)
        visual: Any = part.visual
        if visual.kind == "face":
            vertices, uv = vertices[faces.reshape(-1)], uv[faces.reshape(-1)]
            faces = np.arange(faces.size).reshape(-1, 3)
        # A mirrored part is turned inside out.
        faces = faces[:, ::-1] if np.linalg.det(matrix[:3, :3]) < 0 else faces
        vertices = vertices @ matrix[:3, :3].T + matrix[:3, 3]
        look = _look(visual)
        if look not in looks:
            looks[look] = len(pictures)
            pictures.append(_picture(visual, source))
        rows.append((vertices, faces + first, uv, tint, np.full(len(faces), looks[look])))
        first += len(vertices)
    if sum(picture.shape[0] * picture.shape[1] for picture in pictures) > MOST_PIXELS:
        raise ValueError(f"its pictures have more than {MOST_PIXELS:,} pixels")
    vertices, faces, uv, tint, picture = (
        torch.from_numpy(np.concatenate(column)) for column in zip(*rows, strict=True)
    )
    return TexturedMesh(
        vertices=points_to_world(vertices, up),
        faces=faces.long(),
        uv=uv.float(),
        tint=tint.float(),
        picture=picture,
        textures=Textures.of(pictures),
    )


def _area(mesh: TexturedMesh) -> float:
    """Return the area of all triangles. Raises ``ValueError`` if a corner is not finite."""
    if not bool((mesh.corners.abs() < FARTHEST).all()):
        raise ValueError("a corner is not finite")
    edges = mesh.corners[:, 1:] - mesh.corners[:, :1]
    return float(torch.linalg.cross(edges[:, 0], edges[:, 1]).norm(dim=1).sum()) / 2


def _lost_textures(source: _Source, document: Any) -> list[str]:
    """Return a note if a texture or a file of materials cannot be read."""
    found = sum(picture is not None for picture in source.pictures.values())
    if source.suffix in LINEAR_SUFFIXES:
        is_complete = found >= len(_base_pictures(document))
    else:
        is_complete = not source.lost and found == len(source.pictures)
    names = f" ({', '.join(sorted(source.lost))})"[:LONGEST] if source.lost else ""
    reason = f"has a texture that cannot be read{names}, so it has the colour of its material there"
    return [] if is_complete else [reason]


def _base_pictures(document: Any) -> set[str]:
    """Return the pictures of the base colours that a glTF file uses."""
    used = {part.get("material") for mesh in document.get("meshes", ()) for part in mesh["primitives"]}
    materials = [document["materials"][number] for number in used if number is not None]
    bases = [material.get("pbrMetallicRoughness", {}).get("baseColorTexture") for material in materials]
    textures = [document["textures"][base["index"]] for base in bases if base]
    return {str(texture.get("source", texture.get("extensions"))) for texture in textures}


def _uv(part: trimesh.Trimesh) -> Float[np.ndarray, "n 2"]:
    """Return texture coordinates, which are 0 where the file has none or has no plausible ones."""
    uv = getattr(part.visual, "uv", None)
    uv = np.zeros((len(part.vertices), 2)) if uv is None else np.array(uv)[:, :2]
    uv[~(np.abs(uv) < 1e6)] = 0
    return uv


def _tint(part: trimesh.Trimesh, is_linear: bool, plain: Sequence[float]) -> Float[np.ndarray, "n 3"]:
    """Return the sRGB colours of the vertices in [0, 1], which multiply the picture of the part.

    Gamma is nearly a power, so that the product of colours is that of the light.
    """
    visual: Any = part.visual
    if visual.kind == "face":
        return np.repeat(np.asarray(visual.face_colors)[:, :3] / 255, 3, axis=0)
    colors = visual.vertex_colors if visual.kind == "vertex" else None
    if visual.kind == "texture" and is_linear:
        colors = visual.vertex_attributes.get("color")
    if colors is None or len(colors) != len(part.vertices):
        usual = [1.0, 1.0, 1.0] if visual.kind == "texture" else list(plain)
        return np.tile(usual, (len(part.vertices), 1))
    most = np.iinfo(colors.dtype).max if colors.dtype.kind in "ui" else 1.0
    rgb = (np.asarray(colors, dtype=np.float64)[:, :3] / most).clip(0, 1)
    return srgb(rgb) if is_linear else rgb


def _look(visual: Any) -> Any:
    """Return what is equal for parts with the same picture."""
    if visual.kind != "texture":
        return None
    image = None if visual.uv is None else _image_of(visual.material)
    names = ("baseColorFactor", "alphaMode", "alphaCutoff", "main_color")
    return id(image), *(str(getattr(visual.material, name, None)) for name in names)


def _picture(visual: Any, source: _Source) -> np.ndarray:
    """Return the picture of a part as RGBA; one pixel if it has none. Holes are where alpha is below 1/2."""
    if visual.kind != "texture":
        return np.full((1, 1, 4), 255, np.uint8)
    material, image = visual.material, _image_of(visual.material)
    mode = getattr(material, "alphaMode", None) or ("MASK" if hasattr(material, "image") else "OPAQUE")
    factor = getattr(material, "baseColorFactor", None)
    factor = np.ones(4) if factor is None else np.asarray(factor) / 255
    cutoff = getattr(material, "alphaCutoff", None)
    solid = factor[3] * 0.5 / max(0.5 if cutoff is None else cutoff, 0.01)
    rgba = None if image is None else source.picture(image)
    if rgba is None or visual.uv is None:
        is_linear = hasattr(material, "baseColorFactor")
        flat = 255 * srgb(factor[:3]) if is_linear else np.asarray(material.main_color)[:3]
        alpha = 255 if mode == "OPAQUE" else min(255, round(255 * solid))
        return np.array([[[*flat.round(), alpha]]], dtype=np.uint8)
    rgba = rgba.copy()
    rgba[..., 3] = 255 if mode == "OPAQUE" else (rgba[..., 3] * solid).clip(max=255).round()
    if (factor < 1).any():
        rgba[..., :3] = (255 * srgb(linear(rgba[..., :3] / 255) * factor[:3])).round()
    return rgba


def _image_of(material: Any) -> Image.Image | None:
    return getattr(material, "image", None) or getattr(material, "baseColorTexture", None)


def _decoded(image: Image.Image) -> np.ndarray | None:
    """Return the pixels of a picture as RGBA, made smaller if there are many; None if they cannot be read."""
    if image.width * image.height > LARGEST_PICTURE:
        return None
    # What Pillow raises depends on the format and on the damage.
    try:
        if image.mode not in ("L", "LA", "RGB", "RGBA"):
            image = image.convert("RGBA")
        image.thumbnail((FINEST, FINEST))
        return np.array(image.convert("RGBA"))
    except Exception:
        return None
