"""The objects that come with the package, and the script that makes them."""

import json
import sys
import zipfile
from collections import Counter
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[2] / "scripts"))

import make_objects

from cadam3d.prior.shapes.objects import known_objects

FOLDER = make_objects.WORLD_FOLDER
ROWS = json.loads((FOLDER / "catalog.json").read_text())
SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvn 0 0 1\n"


def parts_of(glb: bytes) -> list[trimesh.Trimesh]:
    return list(trimesh.load_scene(BytesIO(glb), file_type="glb", process=False).geometry.values())


def test_the_catalogue_names_each_file_once_and_fills_each_field():
    assert sorted(row["file"] for row in ROWS) == sorted(path.name for path in FOLDER.glob("*.glb"))
    keys = ["id", "file", "name", "tags", "licence", "author", "up"]
    assert all(list(row) == keys and all(row.values()) for row in ROWS)
    assert {(row["licence"], row["up"]) for row in ROWS} == {("CC0-1.0", "+y")}
    for key in ("id", "name"):
        assert len({row[key] for row in ROWS}) == len(ROWS)


def test_the_objects_are_few_and_small():
    assert 24 <= len(ROWS) <= 32
    assert sum(path.stat().st_size for path in FOLDER.iterdir()) <= 6e6


def test_no_name_is_that_of_a_shape_and_some_tags_have_several_objects():
    assert not {row["name"] for row in ROWS} & set(known_objects())
    tags = Counter(tag for row in ROWS for tag in row["tags"])
    assert tags["lantern"] >= 3 <= tags["chair"]


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row["name"])
def test_every_object_has_faces_normals_and_textures_in_range(row):
    parts = parts_of((FOLDER / row["file"]).read_bytes())
    assert sum(len(part.faces) for part in parts) > 500
    for part in parts:
        assert np.isfinite(part.vertices).all()
        assert (part.area_faces > 0).all()
        assert np.allclose(np.linalg.norm(part.vertex_normals, axis=1), 1, atol=1e-3)
        assert part.visual.uv.shape == (len(part.vertices), 2)
        assert max(part.visual.material.baseColorTexture.size) <= make_objects.PRINT
        assert (np.ptp(part.vertices, axis=0) > 0).sum() >= 2


def a_library(folder: Path, obj: str, image: Image.Image | None = None, **entry: str) -> make_objects.Model:
    """Return the only model of a library that is written for the test."""
    texture = BytesIO()
    (image or Image.new("RGB", (4, 4))).save(texture, format="png")
    entry = {"id": "A#b", "name": "Thing", "tags": "Blend Swap, Toy", "category": "Caf\\u00e9"} | entry
    entry |= {"model": "/a/b/b.obj", "creator": "Ada"}
    materials = "newmtl red\nKd 1 0 0\nnewmtl blue\nKd 0 0 1\nnewmtl map\nKd 0 0 0\nmap_Kd map.png\n"
    with zipfile.ZipFile(folder / "BlendSwap-CC-0.sh3f", "w") as archive:
        archive.writestr("a/b/b.obj", "mtllib b.mtl\n" + obj)
        archive.writestr("a/b/b.mtl", materials)
        archive.writestr("a/b/map.png", texture.getvalue())
        archive.writestr("a/b/LICENSE.txt", "Released under Creative Commons Attribution 3.0")
        archive.writestr(
            make_objects.ENTRIES, "".join(f"{key}#1={value}\r\n" for key, value in entry.items())
        )
    [model] = make_objects.read_library(folder, "BlendSwap-CC-0")
    return model


def test_an_entry_keeps_its_words_and_the_licence_beside_the_model_wins(tmp_path):
    model = a_library(tmp_path, SQUARE)
    assert (model.name, model.tags, model.author, model.licence) == (
        "thing",
        ("toy", "café"),
        "Ada",
        "CC-BY-3.0",
    )


def test_plain_colours_share_one_texture_with_exact_pixels(tmp_path):
    obj = SQUARE + "usemtl red\nf 1//1 2//1 3//1\nusemtl blue\nf 1//1 3//1 4//1\n"
    [part] = parts_of(make_objects.to_glb(a_library(tmp_path, obj)))
    pixels = np.array(part.visual.material.baseColorTexture)[0]
    assert np.allclose(np.unique(part.visual.uv[:, 0]), (0.25, 0.75))
    colors = pixels[(part.visual.uv[:, 0] * len(pixels)).astype(int)]
    lower = part.triangles_center[:, 0] > part.triangles_center[:, 1]
    assert (colors[part.faces[lower]] == (255, 0, 0)).all()
    assert (colors[part.faces[~lower]] == (0, 0, 255)).all()
    assert lower.sum() == 1


def test_faces_of_no_area_are_left_out_and_normals_of_no_length_become_those_of_the_faces(tmp_path):
    obj = SQUARE + "vn 0 0 0\nusemtl red\nf 1//2 2//2 3//2\nf 1//1 2//1 1//1\n"
    [part] = parts_of(make_objects.to_glb(a_library(tmp_path, obj)))
    assert len(part.faces) == 1
    assert np.allclose(part.vertex_normals, (0, 0, 1))


@pytest.mark.parametrize(("alpha", "mode"), [(255, "OPAQUE"), (0, "MASK")])
def test_a_texture_is_shrunk_and_one_with_holes_is_a_mask_of_one_colour(tmp_path, alpha, mode):
    obj = SQUARE + "vt 0 0\nusemtl map\nf 1/1/1 2/1/1 3/1/1\n"
    image = Image.new("RGBA", (1024, 8), (0, 254, 0, 255))
    image.paste((0, 254, 0, 255) if alpha else (255, 0, 0, alpha), (0, 0, 512, 8))
    [part] = parts_of(make_objects.to_glb(a_library(tmp_path, obj, image)))
    texture = part.visual.material.baseColorTexture
    assert (part.visual.material.alphaMode, texture.size) == (mode, (512, 4))
    assert np.allclose(np.array(texture)[..., :3], (0, 254, 0), atol=2)


def test_the_rotation_of_the_library_and_then_the_turn_of_the_choice_are_applied(tmp_path):
    """The library puts x to the top; a turn of 90 degrees then brings the side at -x to the front."""
    obj = SQUARE + "usemtl red\nf 1//1 2//1 3//1\n"
    model = a_library(tmp_path, obj, modelRotation="0 -1 0 1 0 0 0 0 1")
    [chosen] = make_objects.chosen([model], {"A#b": make_objects.Choice("thing", "toy", turn_deg=90)})
    [part] = parts_of(make_objects.to_glb(chosen))
    assert np.allclose(sorted(part.vertices.tolist()), [(0, 0, 0), (0, 1, 0), (0, 1, 1)], atol=1e-6)
    assert np.allclose(part.vertex_normals, (1, 0, 0), atol=1e-6)


def test_a_concave_polygon_keeps_its_area(tmp_path):
    """A comb, whose fan from the first corner would cover its gaps."""
    outline = [(0, 0), (5, 0), (5, 2), (4, 2), (4, 1), (3, 1), (3, 2), (2, 2), (2, 1), (1, 1), (1, 2), (0, 2)]
    lines = [f"v {x} {y} 0\n" for x, y in outline]
    obj = "".join(lines) + "usemtl red\nf " + " ".join(str(i + 1) for i in range(len(outline))) + "\n"
    [part] = parts_of(make_objects.to_glb(a_library(tmp_path, obj)))
    assert part.area == pytest.approx(8)


@pytest.mark.skipif(not make_objects.SOURCE.is_dir(), reason="needs Debian's package sweethome3d-furniture")
def test_the_script_makes_an_object_of_the_package_again():
    models = make_objects.read_library(make_objects.SOURCE, "BlendSwap-CC-0")
    [model] = [each for each in make_objects.chosen(models, make_objects.WORLD) if each.name == "mailbox"]
    for made, kept in zip(
        parts_of(make_objects.to_glb(model)), parts_of((FOLDER / model.file).read_bytes()), strict=True
    ):
        assert np.array_equal(made.faces, kept.faces)
        assert np.allclose(made.vertices, kept.vertices, atol=1e-6)


def test_a_folder_without_the_libraries_is_answered_with_the_package(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["make_objects.py", "--source", str(tmp_path)])
    with pytest.raises(SystemExit, match="lacks the furniture"):
        make_objects.main()
