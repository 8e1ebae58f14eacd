"""TurntableExporter: one turn, with every picture in its place."""

import imageio.v3 as imageio
import numpy as np
import pytest
import torch

from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.render import RenderOutput
from cadam3d.exporter.turntable import TurntableExporter

SETTINGS = {
    "views": 9,
    "elevation_deg": 10.0,
    "distance": 3.0,
    "fov_y_deg": 40.0,
    "size": 32,
    "fps": 10,
    "background": [0.5, 0.5, 0.5],
    "beside": "depth",
}


def no_gaussians() -> Gaussians:
    return Gaussians(
        torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0, 4), torch.zeros(0), torch.zeros(0, 1, 3)
    )


class Recorder:
    """A renderer that paints each view in the shade of its azimuth, with a near square in its middle."""

    def __init__(self) -> None:
        self.cameras = []

    def __call__(self, cameras, background):
        self.cameras.append(cameras)
        views, size = len(cameras), cameras.height
        shade = (cameras.azimuth_deg % 360 / 360)[:, None, None, None].expand(views, size, size, 3)
        inside = torch.zeros(views, size, size)
        inside[:, 8:-8, 8:-8] = 1
        empty = torch.zeros(views, 0)
        return RenderOutput(shade, inside, 2.0 * inside, empty[..., None].expand(views, 0, 2), empty)


def export(folder, **changes):
    render = Recorder()
    TurntableExporter(**{**SETTINGS, **changes}).export(no_gaussians(), render, folder)
    return imageio.imread(folder / "turntable.mp4").astype(float) / 255, render


def test_the_video_shows_one_turn_in_order_from_the_front(tmp_path):
    frames, render = export(tmp_path)
    assert frames.shape == (9, 32, 64, 3)
    shades = frames[:, :, :32].mean(axis=(1, 2, 3))
    assert np.abs(shades - np.arange(9) / 9).max() < 0.03
    azimuths = torch.cat([cameras.azimuth_deg for cameras in render.cameras]) % 360
    torch.testing.assert_close(azimuths, torch.arange(9) * 40.0)


def test_long_videos_are_rendered_a_few_views_at_a_time(tmp_path):
    _, render = export(tmp_path, views=30, size=16)
    assert max(len(cameras) for cameras in render.cameras) <= 4


def test_depth_is_beside_colour_and_black_where_nothing_is_visible(tmp_path):
    frames, _ = export(tmp_path)
    beside = frames[0, :, 32:]
    assert beside[:4].max() < 0.05
    assert beside[16, 16, 0] > 0.8  # nearest possible: the yellow end of the colour map
    assert beside[16, 16, 2] < 0.4


def test_alpha_can_be_beside_colour(tmp_path):
    frames, _ = export(tmp_path, beside="alpha")
    assert frames[0, 16, 48].min() > 0.95
    assert frames[0, 2, 34].max() < 0.05


def test_colour_can_be_alone(tmp_path):
    frames, _ = export(tmp_path, beside="none")
    assert frames.shape == (9, 32, 32, 3)


def test_odd_sizes_are_padded_not_refused(tmp_path):
    frames, _ = export(tmp_path, beside="none", size=33)
    assert frames.shape == (9, 34, 34, 3)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("views", 0),
        ("elevation_deg", 91.0),
        ("distance", 0.0),
        ("fov_y_deg", 180.0),
        ("size", 0),
        ("fps", 0),
        ("background", [1.0, 1.0]),
        ("background", [0.0, 0.0, 2.0]),
        ("beside", "normals"),
    ],
)
def test_wrong_values_name_their_key(key, value):
    with pytest.raises(UserError, match=rf"exporter\.turntable\.{key}"):
        TurntableExporter(**{**SETTINGS, key: value})
