"""Normals point out of the surface, towards the camera, in the axes of normal maps."""

import torch

from cadam3d.core.cameras import turntable
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.mesh.normals import facing_normals, unit_normals
from cadam3d.core.rendering import Subject
from cadam3d.exporter.images import ImagesExporter
from cadam3d.exporter.pictures import paint
from cadam3d.rasterizer.base import render_fn
from cadam3d.rasterizer.reference import ReferenceRasterizer

RADIUS = 0.6


def sphere(count=400) -> Gaussians:
    """Return flat discs on a sphere; the shortest axis of each is its third one and points inwards."""
    index = torch.arange(count) + 0.5
    z, turn = 1 - 2 * index / count, index * 2.399963
    flat = (1 - z**2).sqrt()
    normals = torch.stack([flat * turn.cos(), flat * turn.sin(), z], dim=1)
    # The rotation from -z to the normal has the axis (-z) x n and the angle between them.
    quats = torch.stack([1 - z, normals[:, 1], -normals[:, 0], torch.zeros(count)], dim=1)
    return Gaussians(
        means=RADIUS * normals,
        log_scales=torch.tensor([0.06, 0.06, 0.01]).log().expand(count, 3).clone(),
        quats=quats,
        opacity_logits=torch.full((count,), 3.0),
        sh=torch.zeros(count, 4, 3),
    )


def test_the_normals_of_a_sphere_point_outwards_where_the_camera_sees_it():
    gaussians = sphere()
    camera = turntable(1, elevation_deg=30.0, distance=3.0, fov_y_deg=40.0, size=8)
    in_camera = gaussians.means / RADIUS @ camera.world_to_camera[0, :3, :3].T
    outwards = in_camera * torch.tensor([1.0, -1.0, -1.0])
    faces = ((camera.positions - gaussians.means) * gaussians.means).sum(dim=1) > 0
    found = facing_normals(gaussians, camera)
    torch.testing.assert_close(found[faces], outwards[faces], atol=1e-4, rtol=0)
    torch.testing.assert_close(found[~faces], -outwards[~faces], atol=1e-4, rtol=0)


def test_a_picture_of_a_sphere_is_blue_in_the_middle_red_on_the_right_and_green_above():
    gaussians, rasterizer = sphere(), ReferenceRasterizer()
    cameras = turntable(2, elevation_deg=0.0, distance=3.0, fov_y_deg=40.0, size=48)
    subject = Subject(gaussians, render_fn(rasterizer, lambda: gaussians))
    settings = ImagesExporter(
        views=2,
        elevations_deg=[0.0],
        kinds=["normal"],
        distance=3.0,
        fov_y_deg=40.0,
        size=48,
        background="transparent",
    )
    [pictures] = paint(subject, cameras, settings, ["normal"])
    y, x = torch.meshgrid(torch.arange(48) - 23.5, torch.arange(48) - 23.5, indexing="ij")
    radius = 24 * RADIUS / (9 - RADIUS**2) ** 0.5 / torch.tan(torch.deg2rad(torch.tensor(20.0)))
    inside = (x**2 + y**2).sqrt() < 0.8 * radius
    expected = torch.stack([x / radius, -y / radius, (1 - (x**2 + y**2) / radius**2).clamp_min(0).sqrt()], -1)
    for picture in pictures:
        normals = picture[..., :3] * 2 - 1
        # The expectation is that of a camera far away, so it is not exact.
        assert (normals - expected)[inside].abs().mean() < 0.15
        assert (normals * expected).sum(dim=-1)[inside].min() > 0.9
        assert picture[0, 0, 3] == 0


def test_a_normal_has_length_one_however_faint_its_pixel_is():
    color = torch.tensor([[[0.5, 0.5, 1.0], [1.0, 0.5, 0.9], [0.0, 0.0, 0.0]]])
    alpha = torch.tensor([[0.9, 0.01, 0.0]])
    normals = unit_normals(color * alpha[..., None], alpha) * 2 - 1
    torch.testing.assert_close(normals.norm(dim=-1), torch.ones(1, 3))
    assert normals[0, 2].tolist() == [0, 0, 1]
