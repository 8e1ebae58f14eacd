"""Laws of the mesh initializer."""

import json
import os

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.mesh.surface import Surface
from cadam3d.core.sh import SH_C0
from cadam3d.initializer.mesh import Mesh
from cadam3d.io.mesh import Texture, write_glb, write_mesh_ply, write_obj
from cadam3d.io.mesh_file import read_mesh

CPU = torch.device("cpu")
GREY = [0.5, 0.5, 0.5]


def build(path, seed: int = 0, **changes) -> Gaussians:
    usual = {
        "path": str(path),
        "up": "z",
        "turn_deg": 0,
        "radius": 0.9,
        "factor": None,
        "lift": 0.0,
        "count": 2000,
        "scale": 0.02,
        "scale_law": "mean",
        "opacity": 0.1,
        "sh_degree": 0,
        "color": GREY,
    }
    return Mesh(**{**usual, **changes}).build("anything", torch.Generator().manual_seed(seed), CPU)


def rgb(made: Gaussians) -> torch.Tensor:
    return 0.5 + SH_C0 * made.sh[:, 0]


def white(picture):
    """The material of a picture that is shown as it is; trimesh would write a grey factor otherwise."""
    return trimesh.visual.material.PBRMaterial(baseColorTexture=picture, baseColorFactor=[255] * 4)


def save(mesh: trimesh.Trimesh, path):
    mesh.export(path)
    return path


@pytest.mark.parametrize("suffix", ["ply", "obj", "stl", "glb", "off"])
def test_points_are_on_the_surface_scaled_to_the_radius(tmp_path, suffix):
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=7.0).apply_translation([3, 4, 5])
    made = build(save(sphere, tmp_path / f"sphere.{suffix}"))
    assert len(made) == 2000
    torch.testing.assert_close(made.means.norm(dim=-1), torch.full((2000,), 0.9), atol=5e-3, rtol=0)


def test_the_surface_is_covered_evenly_however_it_is_cut_into_triangles(tmp_path):
    box = trimesh.creation.box(extents=(2, 2, 2))
    fine = box.subdivide(np.flatnonzero(box.face_normals[:, 0] > 0.5))  # one side cut into more triangles
    means = build(save(fine, tmp_path / "box.ply"), count=20_000).means
    half = 0.9 / 3**0.5
    for axis in range(3):
        for sign in (-1, 1):
            on_side = (sign * means[:, axis] - half).abs() < 1e-4
            assert float(on_side.float().mean()) == pytest.approx(1 / 6, abs=0.01)
            other = means[on_side][:, [i for i in range(3) if i != axis]]
            torch.testing.assert_close(other.var(dim=0), torch.full((2,), half**2 / 3), atol=0.01, rtol=0)


def test_a_file_with_y_up_is_upright_and_faces_the_front(tmp_path):
    # The mesh is tall in y, and its front is towards +z.
    corners = np.array([[0, 0, 0], [0.1, 0, 0], [0, 3.0, 0], [0, 0, 2.0]])
    mesh = trimesh.Trimesh(corners, [[0, 1, 2], [0, 1, 3], [0, 2, 3]], process=False)
    path = save(mesh, tmp_path / "mark.ply")
    extent = {up: build(path, up=up, count=5000).means for up in ("y", "z")}
    size = {up: means.amax(dim=0) - means.amin(dim=0) for up, means in extent.items()}
    assert size["z"].argsort().tolist() == [0, 2, 1]  # as in the file
    # The y of the file is the z of the world, and its z is x.
    assert size["y"].argsort().tolist() == [1, 0, 2]
    # The top is at the back, where the file has z = 0.
    top = extent["y"][extent["y"][:, 2].argmax()]
    assert top[0] < 0


def test_a_turn_moves_another_side_to_the_front(tmp_path):
    # The triangle is long towards -y, the front of Blender's objects.
    corners = np.array([[0, 0, 0], [0, -3.0, 0], [0, 0, 1]])
    path = save(trimesh.Trimesh(corners, [[0, 1, 2]], process=False), tmp_path / "mark.ply")
    means = build(path, turn_deg=90).means
    torch.testing.assert_close(means[:, 1], torch.zeros(2000), atol=1e-5, rtol=0)
    # The tip is above the point where the long side begins.
    assert means[means[:, 2].argmax(), 0] < means[:, 0].mean()


def test_without_a_radius_position_and_size_are_those_of_the_file(tmp_path):
    mesh = trimesh.creation.box(extents=(0.2, 0.2, 0.2)).apply_translation([0.1, 0.5, 0])
    means = build(save(mesh, tmp_path / "box.ply"), radius=None).means
    torch.testing.assert_close(means.amin(dim=0), torch.tensor([0.0, 0.4, -0.1]), atol=0.01, rtol=0)
    torch.testing.assert_close(means.amax(dim=0), torch.tensor([0.2, 0.6, 0.1]), atol=0.01, rtol=0)
    twice = build(tmp_path / "box.ply", radius=None, factor=2.0, lift=0.3).means
    torch.testing.assert_close(twice, 2 * means + torch.tensor([0.0, 0.0, 0.3]))


def test_vertex_colors_are_interpolated(tmp_path):
    box = trimesh.creation.box(extents=(2, 2, 2))
    colors = np.full((8, 4), 255, dtype=np.uint8)
    colors[:, 0] = np.where(box.vertices[:, 2] > 0, 255, 0)
    colors[:, 1:3] = 0
    box.visual.vertex_colors = colors
    made = build(save(box, tmp_path / "box.ply"))
    height = made.means[:, 2] / (0.9 / 3**0.5)
    torch.testing.assert_close(rgb(made)[:, 0], (height + 1) / 2, atol=0.01, rtol=0)
    assert rgb(made)[:, 1:].abs().max() < 1e-3


def test_face_colors_end_at_the_border_of_the_face(tmp_path):
    box = trimesh.creation.box(extents=(2, 2, 2))
    colors = np.zeros((12, 4), dtype=np.uint8)
    colors[:, 2], colors[:, 3] = np.where(box.face_normals[:, 2] > 0.5, 255, 0), 255
    box.visual.face_colors = colors
    made = build(save(box, tmp_path / "box.ply"))
    is_top = made.means[:, 2] > 0.9 / 3**0.5 - 1e-6
    assert torch.equal(rgb(made)[:, 2] > 0.5, is_top)
    assert is_top.any()


def test_textures_are_read_at_each_point(tmp_path):
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=float)
    texture = Image.new("RGB", (64, 64), (255, 0, 0))
    texture.paste((0, 0, 255), (32, 0, 64, 64))  # left half red, right half blue
    visual = trimesh.visual.TextureVisuals(uv=square[:, :2], material=white(texture))
    mesh = trimesh.Trimesh(square, [[0, 1, 2], [0, 2, 3]], visual=visual, process=False)
    made = build(save(mesh, tmp_path / "square.glb"))
    away = made.means[:, 0].abs()
    inner = (away > 0.05) & (away < 0.6)  # pictures repeat, so the outermost texels mix
    is_blue = rgb(made)[:, 2] > 0.5
    assert torch.equal(is_blue[inner], made.means[inner, 0] > 0)
    assert is_blue.any()
    assert not is_blue.all()


def test_a_mesh_that_we_exported_has_its_colors(tmp_path):
    """The material must not hide the colours of the vertices, which are linear in a glb."""
    sphere = trimesh.creation.icosphere(subdivisions=3)
    colors = 0.5 + 0.45 * sphere.vertices
    surface = Surface(sphere.vertices, sphere.faces, sphere.vertices, colors)
    write_glb(tmp_path / "m.glb", surface, up="+y")
    write_obj(tmp_path / "m.obj", surface, up="+y")
    write_mesh_ply(tmp_path / "m.ply", surface, up="+y")
    for path in sorted(tmp_path.iterdir()):
        made = build(path, up="y", radius=1.0)
        expected = 0.5 + 0.45 * made.means
        torch.testing.assert_close(rgb(made), expected, atol=0.02, rtol=0, msg=path.name)


def test_a_texture_that_we_exported_has_its_colors(tmp_path):
    square = np.array([[0.0, 0, 0], [0, 1, 0], [0, 1, 1], [0, 0, 1]])
    faces, picture = np.array([[0, 1, 2], [0, 2, 3]]), np.full((8, 8, 3), (200, 30, 90), dtype=np.uint8)
    surface = Surface(square, faces, np.tile([1.0, 0, 0], (4, 1)), np.zeros((4, 3)))
    write_glb(
        tmp_path / "m.glb",
        surface,
        up="+y",
        texture=Texture(np.arange(4), faces, square[:, 1:], picture),
    )
    expected = torch.tensor([[200, 30, 90]]).expand(2000, 3) / 255
    torch.testing.assert_close(rgb(build(tmp_path / "m.glb", up="y")), expected)


@pytest.mark.parametrize(("cutoff", "factor", "solid"), [(None, 255, 2), (0.2, 255, 3), (0.5, 140, 1)])
def test_holes_are_where_alpha_times_that_of_the_material_is_below_the_cutoff(
    tmp_path, cutoff, factor, solid
):
    picture = Image.new("RGBA", (4, 1))
    for column, alpha in enumerate((0, 64, 192, 255)):
        picture.putpixel((column, 0), (255, 255, 255, alpha))
    material = trimesh.visual.material.PBRMaterial(
        baseColorTexture=picture,
        baseColorFactor=[255, 255, 255, factor],
        alphaMode="MASK",
        alphaCutoff=cutoff,
    )
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    visual = trimesh.visual.TextureVisuals(uv=square[:, :2], material=material)
    mesh = trimesh.Trimesh(square, [[0, 1, 2], [0, 2, 3]], visual=visual, process=False)
    read = read_mesh(str(save(mesh, tmp_path / "m.glb")), "prior.path")
    assert (read.textures.texels[:4, 3] >= 128).sum() == solid


def test_the_material_of_a_glb_multiplies_the_colors_of_its_vertices(tmp_path):
    picture = Image.new("RGB", (4, 4), (188, 255, 255))  # half of the light in red
    material = trimesh.visual.material.PBRMaterial(
        baseColorFactor=[255, 128, 255, 255], baseColorTexture=picture
    )
    visual = trimesh.visual.TextureVisuals(uv=np.full((8, 2), 0.5), material=material)
    visual.vertex_attributes["color"] = np.tile(np.uint8([128, 255, 255, 255]), (8, 1))
    box = trimesh.creation.box()
    mesh = trimesh.Trimesh(box.vertices, box.faces, visual=visual, process=False)
    made = rgb(build(save(mesh, tmp_path / "m.glb"), count=50))
    expected = torch.tensor([[137, 188, 255]]).expand(50, 3) / 255
    torch.testing.assert_close(made, expected, atol=0.01, rtol=0)


QUAD = "v 0 0 0{0}\nv 1 0 0{0}\nv 1 1 0{0}\nv 0 1 0{0}\n"


def test_an_obj_may_have_colors_in_vertices_materials_or_textures(tmp_path):
    Image.new("RGB", (4, 4), (0, 0, 255)).save(tmp_path / "blue.png")
    (tmp_path / "all.mtl").write_text("newmtl plain\nKd 0 1 0\nnewmtl image\nKd 1 1 1\nmap_Kd blue.png\n")
    files = {
        "vertices": QUAD.format(" 1 0 0") + "f 1 2 3 4\n",
        "material": "mtllib all.mtl\nusemtl plain\n" + QUAD.format("") + "f 1 2 3 4\n",
        "texture": "mtllib all.mtl\nusemtl image\n" + QUAD.format("") + "vt 0.5 0.5\nf 1/1 2/1 3/1 4/1\n",
    }
    for (name, text), color in zip(files.items(), torch.eye(3), strict=True):
        (tmp_path / f"{name}.obj").write_text(text)
        made = rgb(build(tmp_path / f"{name}.obj", count=50))
        torch.testing.assert_close(made, color.expand(50, 3), msg=name)


def test_every_part_of_a_scene_keeps_its_kind_of_colors(tmp_path):
    red, plain = trimesh.creation.box(), trimesh.creation.box()
    red.visual.vertex_colors = [255, 0, 0, 255]
    textured = []
    for color in ((0, 0, 255), (0, 255, 0)):
        box = trimesh.creation.box()
        material = white(Image.new("RGB", (4, 4), color))
        visual = trimesh.visual.TextureVisuals(uv=np.full((8, 2), 0.5), material=material)
        textured.append(trimesh.Trimesh(box.vertices, box.faces, visual=visual, process=False))
    parts = [red, plain, *textured]
    for place, part in enumerate(parts):
        part.apply_translation([3 * place, 0, 0])
    trimesh.Scene(parts).export(tmp_path / "mixed.glb")
    made = build(tmp_path / "mixed.glb", color=[0.2, 0.4, 0.6], radius=None)
    column = (made.means[:, 0] / 3).round().long()
    wanted = torch.tensor([[1.0, 0, 0], [0.2, 0.4, 0.6], [0, 0, 1], [0, 1, 0]])
    torch.testing.assert_close(rgb(made), wanted[column])
    assert column.bincount().min() > 400


def test_parts_are_placed_as_in_the_scene(tmp_path):
    scene = trimesh.Scene()
    scene.add_geometry(trimesh.creation.box())
    scene.add_geometry(
        trimesh.creation.box(), transform=trimesh.transformations.translation_matrix([0, 0, 9])
    )
    scene.export(tmp_path / "tower.glb")
    height = build(tmp_path / "tower.glb", radius=None).means[:, 2]
    assert float(height.min()) == pytest.approx(-0.5, abs=0.01)
    assert float(height.max()) == pytest.approx(9.5, abs=0.01)
    assert float((height > 5).float().mean()) == pytest.approx(0.5, abs=0.05)


@pytest.mark.parametrize("name", ["broken.glb", "unknown.format"])
def test_a_file_that_cannot_be_read_is_reported(tmp_path, name):
    (tmp_path / name).write_bytes(b"not a mesh")
    with pytest.raises(UserError, match=r"initializer\.path: (.* cannot be read \(|expected a \.glb, )"):
        build(tmp_path / name)


@pytest.mark.parametrize("kind", ["points", "flat"])
def test_a_file_without_a_surface_is_reported(tmp_path, kind):
    if kind == "points":
        trimesh.PointCloud(np.eye(3)).export(tmp_path / "it.ply")
    else:
        line = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0]], dtype=float)
        trimesh.Trimesh(line, [[0, 1, 2]], process=False).export(tmp_path / "it.ply")
    with pytest.raises(UserError, match=r"expected a mesh with triangles, got .*, which has no surface"):
        build(tmp_path / "it.ply")


def textured_quad(folder, map_kd: str = "map_Kd skin.png", mtllib: str = "a.mtl"):
    """Write a square as an obj with texture coordinates and a red material, and return its path."""
    corners = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
    (folder / "a.mtl").write_text(f"newmtl skin\nKd 1 0 0\n{map_kd}\n")
    (folder / "a.obj").write_text(f"mtllib {mtllib}\n{corners}usemtl skin\nf 1/1 2/2 3/3\nf 1/1 3/3 4/4\n")
    return folder / "a.obj"


@pytest.mark.parametrize("picture", [None, b"", b"no picture", b"\x89PNG\r\n\x1a\n" + b"\0" * 20])
def test_an_obj_without_its_texture_has_the_color_of_its_material_and_a_note_says_so(
    tmp_path, capsys, picture
):
    if picture is not None:
        (tmp_path / "skin.png").write_bytes(picture)
    made = build(textured_quad(tmp_path), count=50)
    torch.testing.assert_close(rgb(made), torch.tensor([1.0, 0.0, 0.0]).expand(50, 3), atol=1e-5, rtol=0)
    assert capsys.readouterr().err.count("Note: a.obj has a texture that cannot be read") == 1


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes")
@pytest.mark.parametrize("place", ["map_Kd", "mtllib", "gltf buffer"])
def test_a_named_pipe_in_place_of_a_file_does_not_hang(tmp_path, place):
    os.mkfifo(tmp_path / "pipe")
    if place == "map_Kd":
        assert len(build(textured_quad(tmp_path, map_kd="map_Kd pipe"), count=5)) == 5
    elif place == "mtllib":
        assert len(build(textured_quad(tmp_path, mtllib="pipe"), count=5)) == 5
    else:
        path = tmp_path / "a.gltf"
        trimesh.creation.box().export(path)
        document = json.loads(path.read_text())
        document["buffers"][0]["uri"] = "pipe"
        path.write_text(json.dumps(document))
        with pytest.raises(UserError, match="cannot be read"):
            build(path)


def test_a_mesh_reads_no_file_outside_of_its_folder(tmp_path, capsys):
    (tmp_path / "inside").mkdir()
    Image.new("RGB", (4, 4), (0, 0, 255)).save(tmp_path / "skin.png")
    made = build(textured_quad(tmp_path / "inside", map_kd="map_Kd ../skin.png"), count=20)
    torch.testing.assert_close(rgb(made), torch.tensor([1.0, 0.0, 0.0]).expand(20, 3), atol=1e-5, rtol=0)
    assert "a texture that cannot be read" in capsys.readouterr().err
