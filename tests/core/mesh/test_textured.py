"""Laws of meshes with textures."""

import numpy as np
import pytest
import torch
import trimesh

from cadam3d.core.mesh.textured import TexturedMesh, Textures

COLORS = np.array([[[255, 0, 0, 255], [0, 255, 0, 255]], [[0, 0, 255, 255], [255, 255, 0, 51]]], np.uint8)


def checkerboard(size: int) -> np.ndarray:
    board = np.indices((size, size)).sum(0) % 2 * 255
    return np.repeat(board[..., None], 4, axis=2).astype(np.uint8)


def colors_at(uv, picture: np.ndarray = COLORS, level: int = 0) -> torch.Tensor:
    uv = torch.as_tensor(uv, dtype=torch.float64).reshape(-1, 2)
    zero = torch.zeros(len(uv), dtype=torch.long)
    return Textures.of([picture]).at(zero, uv, zero + level)


def textured(shape: trimesh.Trimesh, **changes) -> TexturedMesh:
    count = len(shape.vertices)
    usual = {
        "vertices": torch.tensor(np.array(shape.vertices)),
        "faces": torch.tensor(np.array(shape.faces)).long(),
        "uv": torch.zeros(count, 2),
        "tint": torch.ones(count, 3),
        "picture": torch.zeros(len(shape.faces), dtype=torch.long),
        "textures": Textures.of([np.full((1, 1, 4), 255, np.uint8)]),
    }
    return TexturedMesh(**{**usual, **changes})


@pytest.mark.parametrize("shift", [0.0, 1.0, -3.0])
def test_a_texel_is_where_uv_counts_from_the_lower_left_and_pictures_repeat(shift):
    corners = np.array([[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.75, 0.75]])
    found = colors_at(corners + shift)
    expected = torch.tensor(COLORS[[1, 1, 0, 0], [0, 1, 0, 1]]).double() / 255
    torch.testing.assert_close(found, expected)


def test_colors_between_texels_are_interpolated_also_across_the_border():
    middle, edge = colors_at([[0.5, 0.75], [0.0, 0.75]])
    torch.testing.assert_close(middle, torch.tensor([0.5, 0.5, 0, 1], dtype=torch.float64))
    torch.testing.assert_close(edge, middle)


@pytest.mark.parametrize("shape", [(8, 8), (16, 4), (1, 8), (4, 4)])
def test_halved_pictures_keep_the_mean(shape):
    rng = np.random.default_rng(0)
    picture = rng.integers(0, 256, (*shape, 4), dtype=np.uint8)
    textures = Textures.of([picture])
    assert textures.levels[0, -1, 1:].tolist() == [1, 1]
    for first, width, height in textures.levels[0].tolist():
        level = textures.texels[first : first + width * height].double()
        torch.testing.assert_close(level.mean(0).numpy(), picture.mean((0, 1)), atol=0.6, rtol=0)


def test_pictures_of_different_sizes_do_not_mix():
    red, board = np.full((1, 1, 4), (255, 0, 0, 255), np.uint8), checkerboard(16)
    textures = Textures.of([board, red, board])
    for level in range(9):
        found = textures.at(torch.tensor([1]), torch.tensor([[0.3, 0.9]]), torch.tensor([level]))
        torch.testing.assert_close(found, torch.tensor([[1.0, 0, 0, 1]]))


@pytest.mark.parametrize(("spacing", "contrast"), [(0.0, 1.0), (1 / 64, 1.0), (1.0, 0.0)])
def test_a_near_checkerboard_is_sharp_and_a_far_one_is_grey(spacing, contrast):
    square = trimesh.Trimesh(
        [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]], process=False
    )
    uv = torch.tensor([[0.0, 0], [1, 0], [1, 1], [0, 1]], dtype=torch.float64)
    mesh = textured(square, uv=uv, textures=Textures.of([checkerboard(64)]))
    weights = torch.rand(500, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    weights /= weights.sum(1, keepdim=True)
    colors = mesh.colors(torch.zeros(500, dtype=torch.long), weights, torch.full((500,), spacing).double())
    assert float(colors[:, 0].max() - colors[:, 0].min()) == pytest.approx(contrast, abs=0.1)
    assert float(colors[:, 0].mean()) == pytest.approx(0.5, abs=0.05)


def test_normals_of_a_sphere_point_outwards_and_are_smooth():
    sphere = trimesh.creation.icosphere(subdivisions=3)
    mesh = textured(sphere)
    assert float((mesh.normals * mesh.corners).sum(-1).min()) > 0.999
    torch.testing.assert_close(mesh.normals.norm(dim=-1), torch.ones(len(sphere.faces), 3).double())


@pytest.mark.parametrize("is_torn", [False, True])
def test_normals_of_a_cube_are_flat(is_torn):
    box = trimesh.creation.box()
    if is_torn:
        box.unmerge_vertices()
    flat = torch.tensor(np.array(box.face_normals))[:, None].expand(-1, 3, -1)
    torch.testing.assert_close(textured(box).normals, flat)


def test_normals_do_not_depend_on_whether_corners_are_shared():
    sphere = trimesh.creation.icosphere(subdivisions=2)
    whole = textured(sphere).normals
    sphere.unmerge_vertices()
    torch.testing.assert_close(textured(sphere).normals, whole)


def test_the_color_is_the_picture_times_the_interpolated_tint():
    triangle = trimesh.Trimesh(np.eye(3), [[0, 1, 2]], process=False)
    grey = Textures.of([np.full((1, 1, 4), (128, 128, 128, 255), np.uint8)])
    mesh = textured(triangle, tint=torch.eye(3), textures=grey)
    found = mesh.colors(torch.tensor([0]), torch.tensor([[0.5, 0.3, 0.2]]))
    torch.testing.assert_close(found, torch.tensor([[0.5, 0.3, 0.2, 255 / 128]]) * 128 / 255)


def test_a_triangle_without_area_has_finite_colors():
    line = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 1, 2], [0, 0, 0]], process=False)
    mesh = textured(line, uv=torch.eye(3)[:, :2], textures=Textures.of([checkerboard(8)]))
    found = mesh.colors(torch.tensor([0, 1]), torch.full((2, 3), 1 / 3), torch.ones(2))
    assert bool(found.isfinite().all())
    assert bool(mesh.normals.isfinite().all())
