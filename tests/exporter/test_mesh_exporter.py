"""MeshExporter: its files, its formats and its textures."""

import json
import math
import sys

import numpy as np
import pytest
import torch
import trimesh

from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.sh import rgb_to_sh0
from cadam3d.exporter.mesh import MeshExporter
from cadam3d.io.mesh import read_mesh

SETTINGS = {
    "format": "glb",
    "up": "+y",
    "resolution": 24,
    "level": 0.3,
    "smallest_part": 0.002,
    "triangles": 2000,
    "texture": None,
    "textured_triangles": 10_000,
}
BELOW, ABOVE = (0.1, 0.2, 0.9), (0.9, 0.1, 0.1)


def two_coloured_ball() -> Gaussians:
    """Return a ball, red above z = 0 and blue below."""
    means = torch.nn.functional.normalize(
        torch.randn(800, 3, generator=torch.Generator().manual_seed(0)), dim=1
    )
    rgb = torch.where(means[:, 2:] > 0, torch.tensor(ABOVE), torch.tensor(BELOW))
    return Gaussians(
        means=0.5 * means,
        log_scales=torch.full((800, 3), math.log(0.04)),
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(800, 4),
        opacity_logits=torch.full((800,), 3.0),
        sh=rgb_to_sh0(rgb)[:, None],
    )


def never_renders(cameras, background):
    raise AssertionError("a mesh needs no picture")


def export(folder, **changes):
    return MeshExporter(**{**SETTINGS, **changes}).export(two_coloured_ball(), never_renders, folder)


@pytest.mark.parametrize("format", ["glb", "obj", "ply"])
def test_every_format_is_one_upright_watertight_file(tmp_path, format):
    [path] = export(tmp_path, format=format)
    assert path == tmp_path / f"asset_mesh.{format}"
    facts = read_mesh(path)
    assert facts.is_watertight
    assert facts.body_count == 1
    assert len(facts.faces) <= 2000
    mesh = trimesh.load_mesh(path, process=False)
    if format != "glb":  # trimesh does not read the colours of a glb that has a material
        top = mesh.visual.vertex_colors[mesh.vertices[:, 1].argmax()].astype(float)
        assert top[0] > 2 * top[2]  # red is above, so +y is up


def test_a_fuzzy_asset_is_smoothed_with_a_note_and_a_clean_one_without(tmp_path, capsys):
    export(tmp_path)
    assert capsys.readouterr().err == ""
    ball = two_coloured_ball()
    draw = torch.Generator().manual_seed(0)
    fuzzy = ball.index(torch.arange(800).repeat(8))
    fuzzy.means = fuzzy.means + 0.05 * torch.randn(fuzzy.means.shape, generator=draw)
    fuzzy.log_scales = torch.full_like(fuzzy.log_scales, math.log(0.012))
    MeshExporter(**SETTINGS | {"resolution": 64}).export(fuzzy, never_renders, tmp_path)
    assert "exporter.mesh: the asset is fuzzy, and smoothing removes " in capsys.readouterr().err


def test_the_same_asset_gives_the_same_bytes(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    [first], [second] = export(tmp_path / "a"), export(tmp_path / "b")
    assert first.read_bytes() == second.read_bytes()


def test_a_texture_has_the_colours_of_the_surface_and_no_empty_texels(tmp_path):
    pytest.importorskip("xatlas")
    paths = export(tmp_path, format="obj", triangles=400, texture=64)
    assert [path.name for path in paths] == ["asset_mesh.obj", "asset_mesh.mtl", "asset_mesh.png"]
    mesh = trimesh.load_mesh(paths[0], process=False)
    colors = mesh.visual.to_color().vertex_colors[:, :3].astype(float)
    red, blue = 255 * np.array(ABOVE), 255 * np.array(BELOW)
    above, below = mesh.vertices[:, 1] > 0.15, mesh.vertices[:, 1] < -0.15
    assert np.abs(colors[above] - red).max() < 30
    assert np.abs(colors[below] - blue).max() < 30
    picture = np.asarray(mesh.visual.material.image.convert("RGB"))
    assert picture.shape == (64, 64, 3)
    assert picture.max(axis=2).min() > 0


def test_a_glb_with_a_texture_is_one_file(tmp_path):
    pytest.importorskip("xatlas")
    [path] = export(tmp_path, triangles=400, texture=64)
    assert read_mesh(path).is_watertight
    document = json.loads(path.read_bytes()[20:].split(b"\0", 1)[0].rpartition(b"}")[0] + b"}")
    assert "COLOR_0" not in document["meshes"][0]["primitives"][0]["attributes"]


def test_a_texture_needs_fewer_triangles_for_the_same_colours(tmp_path):
    pytest.importorskip("xatlas")
    for folder in ("colors", "texture"):
        (tmp_path / folder).mkdir()
    [fine] = export(tmp_path / "colors", format="ply", resolution=48, triangles=None)
    textured, *_ = export(tmp_path / "texture", format="obj", texture=128, textured_triangles=300)
    assert len(read_mesh(textured).faces) <= 300
    many, few = (trimesh.load_mesh(path, process=False) for path in (fine, textured))
    points, faces = trimesh.sample.sample_surface(few, 2000, seed=0)
    weights = trimesh.triangles.points_to_barycentric(few.triangles[faces], points)
    uv = (weights[..., None] * few.visual.uv[few.faces[faces]]).sum(axis=1)
    nearest = many.kdtree.query(points)[1]
    found = few.visual.material.to_color(uv)[:, :3].astype(float)
    error = np.abs(found - many.visual.vertex_colors[nearest, :3])
    assert error.mean() < 6  # of 255


def test_a_texture_without_xatlas_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "xatlas", None)
    with pytest.raises(UserError, match=r"needs xatlas\. Try: pip install '\.\[texture\]'"):
        MeshExporter(**{**SETTINGS, "texture": 64})


def test_a_ply_has_no_texture():
    with pytest.raises(UserError, match=r"\.texture: expected null, because ply"):
        MeshExporter(**{**SETTINGS, "format": "ply", "texture": 512})


def test_an_stl_stands_on_the_bed_of_a_printer_in_millimetres(tmp_path):
    [path] = export(tmp_path, format="stl", up=None)
    mesh = read_mesh(path)
    assert mesh.is_watertight
    assert np.abs(mesh.extents - 100 * 0.5).max() < 15  # a ball of radius 0.5 and its blur
    assert "without colours" in MeshExporter(**{**SETTINGS, "format": "stl"}).losses(3)
    # The head of a tall cone is at +z.
    cone = two_coloured_ball()
    cone.means[:, :2] *= (0.5 - cone.means[:, 2:]).clamp_min(0.05)
    MeshExporter(**{**SETTINGS, "format": "stl", "up": None}).export(cone, never_renders, tmp_path)
    corners = trimesh.load_mesh(path).vertices
    top, bottom = (
        np.ptp(corners[half][:, :2], axis=0).max() for half in (corners[:, 2] > 10, corners[:, 2] < -10)
    )
    assert top < 0.8 * bottom
