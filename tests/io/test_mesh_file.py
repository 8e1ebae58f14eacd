"""Mesh files: colours as the format defines them, and the files of strangers."""

import base64
import json
import subprocess
import sys
import zipfile
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from cadam3d.core.errors import UserError
from cadam3d.core.mesh.textured import TexturedMesh
from cadam3d.io.mesh_file import FINEST, read_mesh

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
OBJ = f"{TRIANGLE}f 1 2 3\n"
SKIN = f"mtllib a.mtl\n{TRIANGLE}vt 0 0\nvt 1 0\nvt 1 1\nusemtl skin\nf 1/1 2/2 3/3\n"
MTL = "newmtl skin\nKd 1 0 0\nmap_Kd skin.png\n"
PLY = (
    "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
)


def png(color="blue", size: tuple[int, int] = (4, 4), mode: str = "RGB") -> bytes:
    stream = BytesIO()
    Image.new(mode, size, color).save(stream, format="png")
    return stream.getvalue()


def zipped(files: dict[str, bytes | str]) -> bytes:
    stream = BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return stream.getvalue()


def data_uri(content: bytes) -> str:
    return "data:application/octet-stream;base64," + base64.b64encode(content).decode()


def gltf(**changes) -> bytes:
    """Return a file of one triangle with texture coordinates."""
    body = np.eye(3, dtype="<f4").tobytes() + np.arange(3, dtype="<u4").tobytes()
    accessors = [
        {"componentType": 5126, "count": 3, "type": "VEC3", "bufferView": 0},
        {"componentType": 5125, "count": 3, "type": "SCALAR", "bufferView": 1},
        {"componentType": 5126, "count": 3, "type": "VEC2", "bufferView": 0},
    ]
    views = [
        {"buffer": 0, "byteOffset": 0, "byteLength": 36},
        {"buffer": 0, "byteOffset": 36, "byteLength": 12},
    ]
    primitive = {"attributes": {"POSITION": 0, "TEXCOORD_0": 2}, "indices": 1, "material": 0}
    usual = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "materials": [{"pbrMetallicRoughness": {"baseColorFactor": [1, 0, 0, 1]}}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(body), "uri": data_uri(body)}],
    }
    return json.dumps(usual | changes).encode()


def with_picture(**image) -> bytes:
    base = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}
    return gltf(images=[image], textures=[{"source": 0}], materials=[base])


def read(folder: Path, name: str, content: bytes | str) -> TexturedMesh:
    (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    return read_mesh(str(folder / name), "truth.path")


def colors(mesh: TexturedMesh) -> list[float]:
    """Return the RGBA in the middle of the first face."""
    return mesh.colors(torch.tensor([0]), torch.full((1, 3), 1 / 3))[0].tolist()


# --- Colours -----------------------------------------------------------------------------------------------


def test_colors_of_a_factor_are_linear_and_become_srgb(tmp_path):
    flat = {"pbrMetallicRoughness": {"baseColorFactor": [0.2140, 1, 0, 1]}}
    mesh = read(tmp_path, "a.gltf", gltf(materials=[flat]))
    assert colors(mesh) == pytest.approx([0.5, 1, 0, 1], abs=0.01)


@pytest.mark.parametrize(("mode", "alpha"), [("OPAQUE", 1.0), ("MASK", 0.0), ("BLEND", 0.0)])
def test_alpha_cuts_holes_unless_the_material_is_opaque(tmp_path, mode, alpha):
    base = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}, "alphaMode": mode}
    image = {"uri": data_uri(png((0, 0, 255, 0), mode="RGBA"))}
    mesh = read(tmp_path, "a.gltf", gltf(images=[image], textures=[{"source": 0}], materials=[base]))
    assert colors(mesh)[3] == pytest.approx(alpha)
    assert mesh.textures.has_holes == (mode != "OPAQUE")


def test_vertex_colors_and_face_colors_are_those_of_the_file(tmp_path):
    box = trimesh.creation.box()
    box.visual.vertex_colors = np.tile([255, 0, 51, 255], (8, 1)).astype(np.uint8)
    box.export(tmp_path / "a.ply")
    assert colors(read_mesh(str(tmp_path / "a.ply"), "k")) == pytest.approx([1, 0, 0.2, 1])
    box.visual = trimesh.visual.ColorVisuals(face_colors=np.tile([0, 255, 51, 255], (12, 1)).astype(np.uint8))
    box.export(tmp_path / "b.ply")
    assert colors(read_mesh(str(tmp_path / "b.ply"), "k")) == pytest.approx([0, 1, 0.2, 1])


@pytest.mark.parametrize("mode", ["RGB", "L", "P", "1", "LA", "RGBA", "I;16", "CMYK"])
def test_pictures_of_every_kind_are_read(tmp_path, mode):
    suffix = "tif" if mode == "CMYK" else "png"
    image = Image.new("RGB", (4, 4), "white").convert("L" if mode == "I;16" else mode)
    if mode == "I;16":
        image = Image.fromarray(np.full((4, 4), 65535, np.uint16))
    image.save(tmp_path / f"skin.{suffix}")
    (tmp_path / "a.mtl").write_text(MTL.replace("png", suffix))
    assert colors(read(tmp_path, "a.obj", SKIN)) == pytest.approx([1, 1, 1, 1], abs=0.01)


@pytest.mark.parametrize(
    ("named", "file"),
    [
        ("maps\\skin.png", "model/maps/skin.png"),
        ("../maps/skin.png", "maps/skin.png"),
        ("my%20skin.png", "model/my skin.png"),
    ],
)
def test_a_zip_file_with_folders_has_its_texture(tmp_path, capsys, named, file):
    files = {"model/a.obj": SKIN, "model/a.mtl": MTL.replace("skin.png", named), file: png()}
    assert colors(read(tmp_path, "a.zip", zipped(files))) == pytest.approx([0, 0, 1, 1])
    assert not capsys.readouterr().err


def test_parts_share_a_picture_and_instances_are_turned_and_mirrored(tmp_path):
    matrices = [np.eye(4), np.diag([-1.0, 1, 1, 1])]
    nodes = [{"mesh": 0, "matrix": matrix.T.ravel().tolist()} for matrix in matrices] * 50
    base = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}
    content = gltf(
        images=[{"uri": data_uri(png())}],
        textures=[{"source": 0}],
        materials=[base],
        scenes=[{"nodes": list(range(100))}],
        nodes=nodes,
    )
    mesh = read(tmp_path, "a.gltf", content)
    assert len(mesh.faces) == 100
    assert len(mesh.textures.texels) == 16 + 4 + 1
    # A mirrored face has its front where the mirrored front is.
    edges = mesh.corners[:2, 1:] - mesh.corners[:2, :1]
    normals = torch.linalg.cross(edges[:, 0], edges[:, 1])
    torch.testing.assert_close(normals[1], normals[0] * normals.new_tensor([-1, 1, 1]))


def test_positions_far_from_the_origin_are_exact(tmp_path):
    mesh = read(tmp_path, "a.obj", "v 5000000 0 0\nv 5000000.25 0 0\nv 5000000 0.25 0\nf 1 2 3\n")
    assert (mesh.vertices[1] - mesh.vertices[0]).tolist() == [0.25, 0, 0]


# --- Strangers ---------------------------------------------------------------------------------------------


def few(**changes) -> bytes:
    """Return a file whose positions are described by other means than a buffer."""
    document = json.loads(gltf())
    document["accessors"][0] = {"componentType": 5126, "type": "VEC3", "bufferView": 0} | changes
    if changes.get("bufferView", 0) is None:
        del document["accessors"][0]["bufferView"]
    return json.dumps(document).encode()


ENCRYPTED = bytearray(zipped({"a.obj": OBJ}))
ENCRYPTED[6] |= 1
ENCRYPTED[ENCRYPTED.find(b"PK\1\2") + 8] |= 1
DAMAGED = bytearray(zipped({"a.obj": OBJ * 50}))
DAMAGED[45] ^= 255
REFUSED = {
    "index.obj": (OBJ.replace("3\n", "9\n"), "out of bounds"),
    "index.ply": (PLY.replace("3 0 1 2", "3 0 1 7"), "a corner that does not exist"),
    "negative.ply": (PLY.replace("3 0 1 2", "3 0 1 -2"), "a corner that does not exist"),
    "index.off": ("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n", "outside the range"),
    "index.gltf": (gltf(bufferViews=[json.loads(gltf())["bufferViews"][0]] * 2), "does not exist"),
    "huge.off": ("OFF\n1000000000 1000000000 0\n0 0 0\n", "reshape"),
    "huge.ply": (
        PLY.replace("ascii", "binary_little_endian").replace("vertex 3", "vertex 3000000000"),
        "length",
    ),
    "nan.obj": (OBJ.replace("v 1 0 0", "v nan 0 0"), "a corner is not finite"),
    "infinite.obj": (OBJ.replace("v 1 0 0", "v inf 0 0"), "a corner is not finite"),
    "far.obj": (OBJ.replace("v 1 0 0", "v 1e200 0 0"), "a corner is not finite"),
    "empty.obj": ("", "which has no surface"),
    "points.obj": (TRIANGLE, "which has no surface"),
    "line.obj": (OBJ.replace("v 0 1 0", "v 2 0 0"), "which has no surface"),
    "empty.glb": (b"", "cannot be read"),
    "zeros.glb": (bytes(100), "no glTF 2.0"),
    "deep.gltf": ('{"a":' + "[" * 100_000, "recursion"),
    "list.gltf": ("[]", "cannot be read"),
    "lines.gltf": ('{"\x1b[2J\n\n', "cannot be read"),
    "zeros.gltf": (few(bufferView=None, count=300_000_000), "rows"),
    "less.gltf": (few(count=-3), "cannot be read"),
    "outside.gltf": (gltf(buffers=[{"byteLength": 48, "uri": "../../etc/passwd"}]), "escapes"),
    "remote.gltf": (gltf(buffers=[{"byteLength": 48, "uri": "http://127.0.0.1:9/x"}]), "cannot be read"),
    "draco.gltf": (
        gltf(extensionsRequired=["KHR_draco_mesh_compression"], meshes=[]),
        "no surface that can be read without KHR_draco_mesh_compression",
    ),
    "a.blend": (b"BLENDER-v300", "another kind of file"),
    "no.zip": (b"no zip file", "not a zip file"),
    "none.zip": (zipped({"a.txt": OBJ}), "no mesh in it"),
    "damaged.zip": (bytes(DAMAGED), "cannot be read"),
    "encrypted.zip": (bytes(ENCRYPTED), "encrypted"),
    "bomb.zip": (zipped({"a.obj": OBJ, "b": bytes(200 << 20)}), "unpacks to 209,715,"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_file_without_a_readable_mesh_is_refused_in_one_line(name, tmp_path, capfd):
    content, reason = REFUSED[name]
    with pytest.raises(UserError) as raised:
        read(tmp_path, name, content)
    message = str(raised.value)
    assert message.startswith("truth.path: expected a ")
    assert f"got {str(tmp_path / name)!r}" in message
    assert reason.lower() in message.lower()
    assert "\n" not in message
    assert len(message) < 700
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("place", ["nodes", "primitives"])
def test_an_array_that_is_used_too_often_is_refused(place, tmp_path):
    """A file of one megabyte would otherwise need gigabytes."""
    document = json.loads(gltf())
    corners = 20_000
    body = np.zeros((corners, 3), "<f4").tobytes()
    document["buffers"].append({"byteLength": len(body), "uri": data_uri(body)})
    document["bufferViews"][0] = {"buffer": 1, "byteOffset": 0, "byteLength": len(body)}
    document["accessors"][0]["count"] = document["accessors"][2]["count"] = corners
    if place == "nodes":
        document["nodes"], document["scenes"] = [{"mesh": 0}] * 2000, [{"nodes": list(range(2000))}]
    else:
        document["meshes"][0]["primitives"] *= 2000
    with pytest.raises(UserError, match=r"it describes 40,\d+,\d+ rows"):
        read(tmp_path, "a.gltf", json.dumps(document))


NOTED = {
    "missing.obj": (SKIN, {"a.mtl": MTL}),
    "no_material.obj": (SKIN, {}),
    "huge.obj": (SKIN, {"a.mtl": MTL, "skin.png": png("white", (20_000, 20_000), "1")}),
    "large.obj": (SKIN, {"a.mtl": MTL, "skin.png": png(1, (11_000, 11_000), "1")}),
    "cut.obj": (SKIN, {"a.mtl": MTL, "skin.png": png("blue", (99, 99))[:-80]}),
    "outside.zip": (zipped({"a.obj": SKIN, "a.mtl": MTL.replace("skin", "../../../skin")}), {}),
    "embedded.gltf": (with_picture(uri=data_uri(b"no picture")), {}),
    "ktx.gltf": (with_picture(uri=data_uri(b"x"), mimeType="image/ktx2"), {}),
}


@pytest.mark.parametrize("name", NOTED)
def test_a_texture_that_cannot_be_read_is_one_note(name, tmp_path, capfd):
    content, files = NOTED[name]
    for each, text in files.items():
        (tmp_path / each).write_bytes(text if isinstance(text, bytes) else text.encode())
    assert len(read(tmp_path, name, content).faces) == 1
    said = capfd.readouterr().err
    assert said.startswith(f"Note: {name} has a texture that cannot be read")
    assert said.count("\n") == 1


def test_a_missing_normal_map_or_an_unused_material_is_no_note(tmp_path, capfd):
    used = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}, "normalTexture": {"index": 1}}
    images = [{"uri": data_uri(png())}, {"uri": "normal.png"}]
    textures = [{"source": 0}, {"source": 1}, {"source": 1}]
    unused = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 2}}}
    mesh = read(tmp_path, "a.gltf", gltf(images=images, textures=textures, materials=[used, unused]))
    assert colors(mesh) == pytest.approx([0, 0, 1, 1])
    assert not capfd.readouterr().err


def test_a_large_picture_is_kept_small(tmp_path):
    (tmp_path / "skin.png").write_bytes(png("blue", (4 * FINEST, FINEST)))
    (tmp_path / "a.mtl").write_text(MTL)
    mesh = read(tmp_path, "a.obj", SKIN)
    assert mesh.textures.levels[0, 0].tolist() == [0, FINEST, FINEST // 4]
    assert colors(mesh) == pytest.approx([0, 0, 1, 1])


def test_the_first_mesh_of_a_zip_file_is_read_and_hidden_files_do_not_count(tmp_path, capfd):
    hidden = {"__MACOSX/._a.obj": b"\0", "a.obj": OBJ}
    assert len(read(tmp_path, "mac.zip", zipped(hidden)).faces) == 1
    assert not capfd.readouterr().err
    assert len(read(tmp_path, "two.zip", zipped({"b.obj": OBJ * 2, "a.obj": OBJ})).faces) == 1
    assert capfd.readouterr().err == "Note: two.zip has 2 meshes, of which a.obj is read\n"


@pytest.mark.parametrize("name", ["../a.obj", "/etc/a.obj", "a\\..\\b.obj"])
def test_names_in_a_zip_file_never_lead_to_the_disk(tmp_path, name):
    (tmp_path / "in").mkdir()
    (tmp_path / "skin.png").write_bytes(png())
    mesh = read(tmp_path / "in", "a.zip", zipped({name: SKIN, "a.mtl": MTL}))
    assert colors(mesh)[2] < 1
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["a.zip", "in", "skin.png"]


def test_degenerate_triangles_and_open_meshes_are_read(tmp_path):
    mesh = read(tmp_path, "a.obj", OBJ + "v 5 5 5\nf 1 1 1\nf 1 2 2\nf 3 2 4\n")
    assert len(mesh.faces) == 4
    assert bool(mesh.normals.isfinite().all())


def test_texture_coordinates_that_are_no_numbers_give_finite_colors(tmp_path):
    (tmp_path / "a.mtl").write_text(MTL)
    (tmp_path / "skin.png").write_bytes(png())
    mesh = read(tmp_path, "a.obj", SKIN.replace("vt 0 0", "vt nan inf").replace("vt 1 0", "vt 1e300 -1e300"))
    assert colors(mesh) == pytest.approx([0, 0, 1, 1])


@pytest.mark.slow
def test_a_million_triangles_need_a_plausible_memory(tmp_path):
    trimesh.creation.icosphere(subdivisions=8).export(tmp_path / "a.glb")
    code = (
        "import resource, sys\nfrom cadam3d.prior.objects.scene import read_object\n"
        "assert len(read_object(sys.argv[1], 'truth.path', '+y').normals) == 1310720\n"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "a.glb")], capture_output=True, text=True, check=True
    )
    assert int(done.stdout) < 2_500_000  # kB
