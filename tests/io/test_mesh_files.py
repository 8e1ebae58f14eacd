"""Files of meshes: the same surface in every format and frame, with the colours that programs expect."""

import io
import json
import struct

import numpy as np
import pytest
import trimesh
from PIL import Image

from cadam3d.core.errors import UserError
from cadam3d.core.mesh.surface import Surface, vertex_normals
from cadam3d.io.frames import AXES
from cadam3d.io.gltf import linear
from cadam3d.io.mesh import Texture, read_mesh, write_glb, write_mesh_ply, write_obj

VERTICES = np.array([[0.6, 0, 0], [0, 0.5, 0], [0, 0, 0.7], [-0.1, -0.2, -0.3]])
FACES = np.array([[0, 1, 2], [0, 2, 3], [1, 0, 3], [2, 1, 3]])
COLORS = np.array([[1.0, 0.0, 0.5], [0.2, 0.02, 0.8], [0.0, 1.0, 0.25], [0.5, 0.5, 0.5]])


def surface() -> Surface:
    return Surface(VERTICES, FACES, vertex_normals(VERTICES, FACES), COLORS)


def texture() -> Texture:
    """Return a texture in which every triangle is a chart of its own, in one corner of the picture."""
    rows = FACES.reshape(-1)
    corner = np.array([[0.1, 0.1], [0.4, 0.1], [0.1, 0.4]])
    offsets = np.array([[0.0, 0.0], [0.5, 0.0], [0.0, 0.5], [0.5, 0.5]])
    uv = (offsets[:, None] + corner).reshape(-1, 2)
    picture = np.zeros((8, 8, 3), dtype=np.uint8)
    picture[4:, :4] = (200, 30, 30)  # lower left: small u and v
    return Texture(rows, np.arange(12).reshape(4, 3), uv, picture)


def write(path, up="+y", **changes):
    if path.suffix == ".ply":
        write_mesh_ply(path, surface(), up=up)
    elif path.suffix == ".obj":
        return write_obj(path, surface(), up=up, **changes)
    else:
        write_glb(path, surface(), up=up, **changes)
    return [path]


def chunks(path):
    """Return the JSON and the binary chunk of a glb, after checks of its structure."""
    content = path.read_bytes()
    magic, version, size = struct.unpack_from("<4sII", content)
    assert (magic, version, size) == (b"glTF", 2, len(content))
    length, kind = struct.unpack_from("<I4s", content, 12)
    assert kind == b"JSON"
    assert length % 4 == 0
    document = json.loads(content[20 : 20 + length])
    binary, kind = struct.unpack_from("<I4s", content, 20 + length)
    assert kind == b"BIN\0"
    assert binary == document["buffers"][0]["byteLength"] == len(content) - 28 - length
    return document, content[28 + length :]


def array(path, name):
    document, binary = chunks(path)
    accessor = document["accessors"][document["meshes"][0]["primitives"][0]["attributes"][name]]
    view = document["bufferViews"][accessor["bufferView"]]
    width = {"VEC2": 2, "VEC3": 3, "VEC4": 4}[accessor["type"]]
    dtype = {5126: "<f4", 5123: "<u2"}[accessor["componentType"]]
    assert view["byteOffset"] % 4 == 0
    found = np.frombuffer(binary, dtype, accessor["count"] * width, view["byteOffset"])
    return found.reshape(-1, width), accessor


@pytest.mark.parametrize("up", AXES)
@pytest.mark.parametrize("suffix", [".glb", ".obj", ".ply"])
def test_trimesh_reads_the_same_triangles_in_the_axes_of_the_file(tmp_path, suffix, up):
    path = tmp_path / f"m{suffix}"
    assert write(path, up) == [path]
    mesh = trimesh.load_mesh(path, process=False)
    np.testing.assert_array_equal(mesh.faces, FACES)
    np.testing.assert_allclose(mesh.vertices, VERTICES @ np.array(AXES[up]).T, atol=1e-6)
    assert mesh.is_watertight
    assert mesh.volume > 0  # counterclockwise seen from outside, so that nothing is mirrored
    assert (len(read_mesh(path).faces), read_mesh(path).is_watertight) == (4, True)
    wanted = trimesh.Trimesh(VERTICES, FACES, process=False).volume
    assert read_mesh(path).volume == pytest.approx(wanted, rel=1e-5)


@pytest.mark.parametrize("suffix", [".obj", ".ply"])
def test_colours_of_obj_and_ply_are_those_of_the_surface(tmp_path, suffix):
    write(tmp_path / f"m{suffix}")
    colors = trimesh.load_mesh(tmp_path / f"m{suffix}", process=False).visual.vertex_colors
    np.testing.assert_allclose(colors[:, :3], COLORS * 255, atol=0.51)


def test_a_glb_is_unlit_and_its_vertex_colours_are_linear(tmp_path):
    write(tmp_path / "m.glb")
    document, _ = chunks(tmp_path / "m.glb")
    [material] = document["materials"]
    assert material["extensions"] == {"KHR_materials_unlit": {}}
    assert document["extensionsUsed"] == ["KHR_materials_unlit"]
    assert material["pbrMetallicRoughness"]["metallicFactor"] == 0
    rgba, accessor = array(tmp_path / "m.glb", "COLOR_0")
    assert accessor["normalized"] is True
    expected = np.where(COLORS <= 0.04045, COLORS / 12.92, ((COLORS + 0.055) / 1.055) ** 2.4)
    np.testing.assert_allclose(rgba[:, :3] / 65535, expected, atol=1e-5)
    assert (rgba[:, 3] == 65535).all()


def test_accessors_of_a_glb_have_bounds_and_unit_normals(tmp_path):
    write(tmp_path / "m.glb")
    positions, accessor = array(tmp_path / "m.glb", "POSITION")
    np.testing.assert_array_equal(np.float32(accessor["min"]), positions.min(0))
    np.testing.assert_array_equal(np.float32(accessor["max"]), positions.max(0))
    normals, _ = array(tmp_path / "m.glb", "NORMAL")
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-6)


def test_the_texture_of_a_glb_is_inside_and_the_right_way_up(tmp_path):
    write(tmp_path / "m.glb", texture=texture())
    document, binary = chunks(tmp_path / "m.glb")
    view = document["bufferViews"][document["images"][0]["bufferView"]]
    png = binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
    np.testing.assert_array_equal(np.array(Image.open(io.BytesIO(png))), texture().picture)
    uv, _ = array(tmp_path / "m.glb", "TEXCOORD_0")
    pixel = texture().picture[int(uv[0, 1] * 8), int(uv[0, 0] * 8)]  # glTF counts v from the upper edge
    assert pixel.tolist() == [200, 30, 30]
    assert read_mesh(tmp_path / "m.glb").is_watertight  # although its vertices are repeated


def test_an_obj_with_a_texture_has_three_files_that_refer_to_each_other(tmp_path):
    paths = write(tmp_path / "m.obj", texture=texture())
    assert paths == [tmp_path / "m.obj", tmp_path / "m.mtl", tmp_path / "m.png"]
    mesh = trimesh.load_mesh(tmp_path / "m.obj", process=False)
    assert mesh.visual.kind == "texture"
    color = mesh.visual.to_color().vertex_colors[0]
    assert color[:3].tolist() == [200, 30, 30]
    assert read_mesh(tmp_path / "m.obj").is_watertight


def test_linear_light_has_the_fixed_points_and_the_slope_of_srgb():
    np.testing.assert_allclose(linear(np.array([[0.0, 1.0, 0.5]])), [[0.0, 1.0, 0.21404]], atol=1e-5)
    assert linear(np.array([[0.01] * 3]))[0, 0] == pytest.approx(0.01 / 12.92)


def test_a_folder_in_place_of_the_file_is_one_message_and_leaves_nothing(tmp_path):
    (tmp_path / "m.glb").mkdir()
    with pytest.raises(UserError, match="cannot be written"):
        write(tmp_path / "m.glb")
    assert [path.name for path in tmp_path.iterdir()] == ["m.glb"]


@pytest.mark.parametrize("suffix", [".glb", ".obj", ".ply"])
def test_a_file_that_is_no_mesh_is_one_message(tmp_path, suffix):
    (tmp_path / f"m{suffix}").write_bytes(b"nothing of this kind")
    with pytest.raises(UserError, match="expected a mesh"):
        read_mesh(tmp_path / f"m{suffix}")
