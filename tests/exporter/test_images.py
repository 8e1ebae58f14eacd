"""ImagesExporter: the pictures are the renders, in order, and named after their angles."""

import imageio.v3 as imageio
import numpy as np
import torch

from cadam3d.core.gaussians import Gaussians
from cadam3d.core.rendering import RenderOutput
from cadam3d.exporter.images import ImagesExporter

VALUES = {"views": 4, "elevations_deg": [0.0, 30.0], "distance": 3.0, "fov_y_deg": 40.0, "size": 6}
VALUES |= {"background": [1.0, 0.5, 0.0], "kinds": ["rgb"]}
EMPTY = Gaussians(
    means=torch.zeros(0, 3),
    log_scales=torch.zeros(0, 3),
    quats=torch.zeros(0, 4),
    opacity_logits=torch.zeros(0),
    sh=torch.zeros(0, 1, 3),
)


def render_angles(cameras, background):
    """Return pictures with the azimuth in red, the elevation in green and the background in blue."""
    views = len(cameras)
    colors = torch.stack(
        [cameras.azimuth_deg % 360 / 360, cameras.elevation_deg / 90, background[:, 2]], dim=1
    )
    rgb = colors[:, None, None].expand(views, cameras.height, cameras.width, 3)
    flat = torch.zeros(views, cameras.height, cameras.width)
    return RenderOutput(rgb, flat, flat, torch.zeros(views, 0, 2), torch.zeros(views, 0))


def test_each_file_shows_the_view_in_its_name(tmp_path):
    paths = ImagesExporter(**VALUES).export(EMPTY, render_angles, tmp_path)
    assert [path.name for path in paths[:2]] == ["000_az000_el+00.png", "001_az090_el+00.png"]
    assert len(paths) == 8
    for path in paths:
        _, azimuth, elevation = path.stem.split("_")
        pixel = imageio.imread(path)[3, 3]
        expected = [round(int(azimuth[2:]) / 360 * 255), round(int(elevation[2:]) / 90 * 255), 0]
        np.testing.assert_allclose(pixel, expected, atol=1)


def test_names_sort_in_the_order_of_the_views(tmp_path):
    paths = ImagesExporter(**VALUES).export(EMPTY, render_angles, tmp_path)
    assert sorted(paths) == paths
