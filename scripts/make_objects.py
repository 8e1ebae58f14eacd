"""Make the objects that come with the package (cadam3d/prior/objects/world) from Sweet Home 3D's furniture.

    python scripts/make_objects.py                  # the objects of WORLD, which are all CC0
    python scripts/make_objects.py --tuning FOLDER  # the objects of TUNING, on which settings are chosen
    python scripts/make_objects.py --all FOLDER     # the 820 objects of all five libraries

A folder has a glb file for each object and a catalog.json with their names, tags, authors and licences. The
models are in Debian's package sweethome3d-furniture. In a glb, y is up and the front is towards +z. It has
one primitive for each texture, and one for all plain colours, which are the pixels of a texture of their own.
Textures are JPEG, or PNG with a mask where they have holes. Glass becomes opaque.
"""

import argparse
import io
import json
import re
import sys
import zipfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float
from PIL import Image
from trimesh.resolvers import ZipResolver
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

SOURCE = Path("/usr/share/sweethome3d/furniture")
WORLD_FOLDER = Path(__file__).parent.parent / "cadam3d/prior/objects/world"
ENTRIES = "PluginFurnitureCatalog.properties"
PRINT = 512  # pixels that a texture has at most where it can be read; 256 elsewhere

# The licence of each library, and the author that it names for all its objects, if it does.
LIBRARIES: dict[str, tuple[str, str | None]] = {
    "BlendSwap-CC-0": ("CC0-1.0", None),
    "BlendSwap-CC-BY": ("CC-BY-3.0", None),
    "KatorLegaz": ("CC-BY-3.0-US", "Andrew Kator & Jennifer Legaz"),
    "Reallusion": ("CC-BY-3.0-US", "Reallusion (http://www.reallusion.com)"),
    "Scopia": ("CC-BY-3.0", "Scopia Visual Interfaces Systems, s.l. (http://www.scopia.es)"),
}


@dataclass(frozen=True)
class Choice:
    """How an object is named here, and what is changed in it."""

    name: str
    tags: str  # separated by commas
    turn_deg: float = 0  # about the vertical axis, which brings the front to +z
    pixels: int = 256  # limit of the width and height of textures


# From easy to hard: plain shapes and surfaces, many colours, print, thin parts, holes, and fur at the end.
WORLD: dict[str, Choice] = {
    "Blend Swap CC-0#basketball": Choice("basketball", "sport, toy", pixels=PRINT),
    "Blend Swap CC-0#barrel": Choice("barrel", "storage, wood"),
    "Blend Swap CC-0#crate": Choice("crate", "storage, wood"),
    "Blend Swap CC-0#hotDog": Choice("hot dog", "food, snack"),
    "Blend Swap CC-0#woodToy": Choice("wooden puppet", "puppet, toy, wood"),
    "Blend Swap CC-0#tableWithTablecloth": Choice("tablecloth", "cloth, picnic"),
    "Blend Swap CC-0#horse2": Choice("horse", "animal"),
    "Blend Swap CC-0#chicken": Choice("chicken", "animal, bird, hen", pixels=PRINT),
    "Blend Swap CC-0#cupcake": Choice("cupcake", "food, dessert, muffin"),
    "Blend Swap CC-0#mofx_mailbox": Choice("mailbox", "letterbox, outdoor"),
    "Blend Swap CC-0#forkLift": Choice("forklift", "vehicle, machine", turn_deg=90),
    "Blend Swap CC-0#motorbike": Choice("spring rider", "playground, outdoor, motorbike", turn_deg=-90),
    "Blend Swap CC-0#stoneLantern": Choice("pagoda lantern", "lantern, stone, garden"),
    "Blend Swap CC-0#lantern": Choice("stone lantern", "lantern, stone, garden"),
    "Blend Swap CC-0#outdoorLamp": Choice("hanging lantern", "lantern, outdoor"),
    "Blend Swap CC-0#JapaneseLantern": Choice("paper lantern", "lantern, decoration", pixels=PRINT),
    "Blend Swap CC-0#tetrapak": Choice("milk carton", "milk, carton, drink", pixels=PRINT),
    "Blend Swap CC-0#kalender": Choice("calendar", "office, paper", pixels=PRINT),
    "Blend Swap CC-0#emergencySign": Choice("exit sign", "sign", pixels=PRINT),
    "Blend Swap CC-0#fireExtinguisher": Choice("fire extinguisher", "extinguisher", pixels=PRINT),
    "Blend Swap CC-0#littlePlant": Choice("potted plant", "plant, leaves"),
    "Blend Swap CC-0#chair2": Choice("banquet chair", "chair, seat"),
    "Blend Swap CC-0#osakaChair": Choice("dining chair", "chair, seat, wood"),
    "Blend Swap CC-0#deckChair": Choice("deck chair", "chair, seat, beach"),
    "Blend Swap CC-0#umbrella": Choice("beach umbrella", "umbrella, parasol, beach"),
    "Blend Swap CC-0#seesaw": Choice("seesaw", "playground, outdoor"),
    "Blend Swap CC-0#childSwing": Choice("swing", "playground, outdoor"),
    "Blend Swap CC-0#childHut": Choice("slide", "playground, outdoor, hut"),
    "Blend Swap CC-0#silla2": Choice("bar stool", "seat"),
    "Blend Swap CC-0#antiqueChair": Choice("cane chair", "chair, seat, antique"),
    "Blend Swap CC-0#teddyBear": Choice("teddy bear", "bear, toy, plush"),
}

# Objects outside WORLD that are like those in it.
TUNING: dict[str, Choice] = {
    "Blend Swap CC-0#table_football": Choice("football table", "game"),
    "Blend Swap CC-BY#bulldog": Choice("bulldog", "animal, dog"),
    "Blend Swap CC-BY#hamburger": Choice("hamburger", "food"),
    "Blend Swap CC-BY#kitchenScale": Choice("kitchen scale", "scale", pixels=PRINT),
    "Blend Swap CC-BY#plaidChair": Choice("plaid chair", "chair, seat"),
    "Scopia#dart_game": Choice("dartboard", "game", pixels=PRINT),
    "Scopia#bonsai-tree": Choice("bonsai", "plant"),
    "Scopia#baby_high_chair": Choice("high chair", "chair, seat"),
}


@dataclass(frozen=True)
class Model:
    """An object of a library."""

    archive: zipfile.ZipFile
    path: PurePosixPath  # of its OBJ file in the archive
    rotation: Float[np.ndarray, "3 3"]  # puts it upright, its front towards +z
    pixels: int  # limit of the width and height of textures
    file: str  # path of the glb in the folder
    id: str  # such as "Blend Swap CC-0#teddyBear"
    name: str
    tags: tuple[str, ...]
    licence: str  # SPDX identifier
    author: str


def main() -> None:
    """Write the objects that the command line asks for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--source", type=Path, default=SOURCE, help="folder of the .sh3f files")
    parser.add_argument("--tuning", type=Path, metavar="FOLDER", help="write the objects of TUNING")
    parser.add_argument("--all", type=Path, metavar="FOLDER", help="write the objects of all libraries")
    args = parser.parse_args()
    if not all((args.source / f"{library}.sh3f").is_file() for library in LIBRARIES):
        package = "sweethome3d-furniture"
        unpack = f"apt-get download {package} && dpkg-deb -x {package}_*.deb furniture"
        sys.exit(
            f"{args.source} lacks the furniture. Install Debian's {package}, or without root: "
            f"{unpack}, then --source furniture{SOURCE}"
        )
    models = [model for library in LIBRARIES for model in read_library(args.source, library)]
    if args.all:
        write_folder(args.all, models)
    elif args.tuning:
        write_folder(args.tuning, chosen(models, TUNING))
    else:
        write_folder(WORLD_FOLDER, chosen(models, WORLD))


def chosen(models: Iterable[Model], choices: dict[str, Choice]) -> list[Model]:
    """Return the chosen models, named and turned as the choices say."""
    by_id = {model.id: model for model in models}
    return [
        replace(
            by_id[id],
            name=choice.name,
            tags=words(choice.tags),
            file=f"{choice.name.replace(' ', '_')}.glb",
            rotation=turned(choice.turn_deg) @ by_id[id].rotation,
            pixels=choice.pixels,
        )
        for id, choice in choices.items()
    ]


def read_library(source: Path, library: str) -> Iterator[Model]:
    """Yield the models of a library in the order of its catalogue."""
    licence, author = LIBRARIES[library]
    archive = zipfile.ZipFile(source / f"{library}.sh3f")
    for entry in read_entries(archive.read(ENTRIES).decode("latin-1")):
        path = PurePosixPath(entry["model"].lstrip("/"))
        yield Model(
            archive=archive,
            path=path,
            rotation=np.array(entry.get("modelRotation", "1 0 0 0 1 0 0 0 1").split(), float).reshape(3, 3),
            pixels=PRINT,
            file=f"{library}/{path.stem}.glb",
            id=entry["id"],
            name=entry["name"].lower(),
            tags=words(f"{entry['tags']},{entry['category']}".lower().replace("blend swap", "")),
            licence=own_licence(archive, path.parent) or licence,
            author=author or entry["creator"],
        )


def read_entries(text: str) -> Iterable[dict[str, str]]:
    """Return the entries of a catalogue, where the line "name#7=Bench" belongs to entry 7."""
    entries: dict[str, dict[str, str]] = {}
    for key, number, value in re.findall(r"^(\w+)#(\d+)=(.*)$", text, re.MULTILINE):
        decoded = re.sub(r"\\u(\w{4})", lambda code: chr(int(code[1], 16)), value)
        entries.setdefault(number, {})[key] = decoded.strip()
    return entries.values()


def own_licence(archive: zipfile.ZipFile, folder: PurePosixPath) -> str | None:
    """Return what the licence file beside a model says, or None; two models of the CC0 library are CC-BY."""
    for name in archive.namelist():
        if name.startswith(f"{folder}/") and "licens" in name.lower():
            found = re.search(rb"Creative Commons (Zero|Attribution)", archive.read(name))
            return {b"Zero": "CC0-1.0", b"Attribution": "CC-BY-3.0"}[found[1]] if found else None
    return None


def words(text: str) -> tuple[str, ...]:
    """Return the words between commas, each once."""
    return tuple(dict.fromkeys(word.strip() for word in text.split(",") if word.strip()))


def turned(angle_deg: float) -> Float[np.ndarray, "3 3"]:
    """Return the rotation about the vertical axis y."""
    return trimesh.transformations.rotation_matrix(np.radians(angle_deg), [0, 1, 0])[:3, :3].round(9)


def write_folder(folder: Path, models: list[Model]) -> None:
    """Write a glb file for each model, and the catalogue."""
    rows = []
    for model in models:
        path = folder / model.file
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(to_glb(model))
        keys = ("id", "file", "name", "tags", "licence", "author")
        rows.append(json.dumps({key: getattr(model, key) for key in keys} | {"up": "+y"}, ensure_ascii=False))
    text = "[\n" + ",\n".join(rows) + "\n]\n"
    (folder / "catalog.json").write_text(text, encoding="utf-8")
    size = sum((folder / model.file).stat().st_size for model in models)
    print(f"{folder}: {len(models)} objects, {size / 1e6:.2f} MB")


def to_glb(model: Model) -> bytes:
    """Return the model as glb, with few primitives and small textures."""
    folder = f"{model.path.parent}/"
    names = [name for name in model.archive.namelist() if name.startswith(folder)]
    files = {name: io.BytesIO(model.archive.read(name)) for name in names}
    resolver = ZipResolver(files, folder)
    obj = io.StringIO(split_polygons(files[str(model.path)].read().decode("latin-1")))
    loaded = trimesh.load_scene(obj, file_type="obj", resolver=resolver, process=False)
    scene = trimesh.Scene()
    for number, mesh in enumerate(primitives(list(loaded.geometry.values()), model)):
        scene.add_geometry(mesh, geom_name=f"part{number}", node_name=f"part{number}")
    return scene.export(file_type="glb", include_normals=True)


def split_polygons(obj: str) -> str:
    """Return the OBJ with triangles for polygons of more than four corners, which trimesh takes as convex."""
    lines = re.findall(r"^v (.*)$", obj, re.MULTILINE)
    vertices = np.array([line.split()[:3] for line in lines], float)

    def split(face: re.Match[str]) -> str:
        corners = face[1].split()
        points = vertices[[int(corner.split("/")[0]) - 1 for corner in corners]]
        return "\n".join(f"f {corners[a]} {corners[b]} {corners[c]}" for a, b, c in ears(points))

    return re.sub(r"^f ((?:\S+ +){4,}\S+)\s*$", split, obj, flags=re.MULTILINE)


def ears(points: Float[np.ndarray, "n 3"]) -> Iterator[tuple[int, int, int]]:
    """Yield the triangles of a flat polygon, by cutting off corners in which there is no other corner."""
    normal = np.cross(points, np.roll(points, -1, axis=0)).sum(axis=0)
    left = list(range(len(points)))
    while len(left) > 3:
        corners = [(left[i - 1], left[i], left[(i + 1) % len(left)]) for i in range(len(left))]
        ear = next((each for each in corners if is_ear(points[list(each)], points[left], normal)), corners[0])
        yield ear
        left.remove(ear[1])
    yield left[0], left[1], left[2]


def is_ear(
    corner: Float[np.ndarray, "3 3"], points: Float[np.ndarray, "n 3"], normal: Float[np.ndarray, "3"]
) -> bool:
    """Return whether the corner is convex and no point is in its triangle."""
    sides = np.roll(corner, -1, axis=0) - corner
    inside = np.cross(sides[:, None], points - corner[:, None]) @ normal > 0
    return bool(np.cross(sides[0], sides[1]) @ normal > 0 and not inside.all(axis=0).any())


def primitives(parts: list[trimesh.Trimesh], model: Model) -> Iterator[trimesh.Trimesh]:
    """Yield a mesh for each texture of the parts, and one for all parts without texture."""
    textured: dict[bytes, list[trimesh.Trimesh]] = {}
    plain = []
    for part in parts:
        image = getattr(surface(part), "image", None)
        if image is None or part.visual.uv is None:
            plain.append(part)
        else:
            textured.setdefault(image.tobytes(), []).append(part)
    for group in textured.values():
        image = shrunk(surface(group[0]).image, model.pixels)
        yield joined(group, [part.visual.uv for part in group], image, model.rotation)
    if plain:
        colors = [surface(part).main_color[:3] for part in plain]
        palette, indices = np.unique(np.array(colors, np.uint8), axis=0, return_inverse=True)
        centres = np.stack([(indices.ravel() + 0.5) / len(palette), np.full(len(plain), 0.5)], axis=1)
        uvs = [np.tile(centre, (len(part.vertices), 1)) for centre, part in zip(centres, plain, strict=True)]
        yield joined(plain, uvs, Image.fromarray(palette[None]), model.rotation)


def surface(part: trimesh.Trimesh) -> Any:
    """Return the material, or for a part without one what gives it a default colour."""
    return getattr(part.visual, "material", part.visual)


def shrunk(image: Image.Image, pixels: int) -> Image.Image:
    """Return a JPEG, or an RGBA image if some pixels are more transparent than opaque."""
    image = image.convert("RGBA")
    has_holes = image.getchannel("A").getextrema()[0] < 128
    image.thumbnail((pixels, pixels), Image.Resampling.LANCZOS)
    if has_holes:
        # Filters must not mix the colour of holes into their edges.
        rgba = np.array(image)
        is_solid = rgba[..., 3] >= 128
        rgba[~is_solid, :3] = rgba[is_solid, :3].mean(axis=0)
        return Image.fromarray(rgba)
    image = image.convert("RGB")
    image.format = "JPEG"  # trimesh writes this format
    return image


def joined(
    parts: list[trimesh.Trimesh],
    uvs: list[Float[np.ndarray, "n 2"]],
    image: Image.Image,
    rotation: Float[np.ndarray, "3 3"],
) -> trimesh.Trimesh:
    """Return the parts as one rotated mesh with one texture, without faces of no area."""
    corners = np.concatenate(
        [
            np.hstack([part.vertices @ rotation.T, part.vertex_normals @ rotation.T, uv])[part.faces]
            for part, uv in zip(parts, uvs, strict=True)
        ]
    ).astype(np.float32)
    face_normals, has_area = trimesh.triangles.normals(corners[..., :3])
    corners = corners[has_area]
    # A few models have normals of length zero.
    has_normal = np.linalg.norm(corners[..., 3:6], axis=2, keepdims=True) > 0.5
    corners[..., 3:6] = np.where(has_normal, corners[..., 3:6], face_normals[:, None])
    rows, indices = np.unique(corners.reshape(-1, 8), axis=0, return_inverse=True)
    material = PBRMaterial(
        baseColorTexture=image,
        alphaMode="MASK" if image.mode == "RGBA" else "OPAQUE",
        metallicFactor=0.0,
        roughnessFactor=1.0,
        doubleSided=True,
    )
    return trimesh.Trimesh(
        vertices=rows[:, :3],
        faces=indices.reshape(-1, 3),
        vertex_normals=rows[:, 3:6],
        visual=TextureVisuals(uv=rows[:, 6:], material=material),
        process=False,
    )


if __name__ == "__main__":
    main()
