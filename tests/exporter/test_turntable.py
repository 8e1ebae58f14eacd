"""TurntableExporter: one turn, with every picture in its place."""

import imageio.v3 as imageio
import imageio_ffmpeg
import numpy as np
import pytest
import torch

from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.rendering import RenderOutput, Subject
from cadam3d.exporter.turntable import TurntableExporter

SETTINGS = {
    "views": 9,
    "turns": 1.0,
    "codec": "mp4",
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

    def __call__(self, cameras, background, shown=None):
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


@pytest.mark.parametrize(("codec", "side"), [("mp4", 34), ("webm", 34), ("gif", 33)])
def test_every_codec_writes_a_file_with_all_frames(tmp_path, codec, side):
    render = Recorder()
    settings = {**SETTINGS, "codec": codec, "beside": "none", "size": 33}
    [path] = TurntableExporter(**settings).export(no_gaussians(), render, tmp_path)
    assert path.name == f"turntable.{codec}"
    frames = imageio.imread(path).astype(float) / 255
    assert frames.shape[:3] == (9, side, side)
    shades = frames[..., :3].mean(axis=(1, 2, 3))
    assert np.abs(shades - np.arange(9) / 9).max() < 0.03


def test_a_transparent_webm_has_the_alpha_of_the_render(tmp_path):
    settings = {**SETTINGS, "codec": "webm", "beside": "none", "background": "transparent"}
    [path] = TurntableExporter(**settings).export(no_gaussians(), Recorder(), tmp_path)
    # Only this decoder reads the fourth channel.
    frames = imageio_ffmpeg.read_frames(
        path, pix_fmt="rgba", bits_per_pixel=32, input_params=["-c:v", "libvpx-vp9"]
    )
    assert next(frames)["size"] == (32, 32)
    alpha = np.frombuffer(next(frames), np.uint8).reshape(32, 32, 4)[..., 3]
    frames.close()
    assert alpha[16, 16] == 255
    assert alpha[2, 2] == 0


def test_other_codecs_refuse_a_transparent_background():
    for codec in ("mp4", "gif"):
        with pytest.raises(UserError, match=r"\.codec: expected webm, .*codec=webm$"):
            TurntableExporter(**{**SETTINGS, "codec": codec, "background": "transparent"})
    with pytest.raises(UserError, match=r"\.fps: expected at most 50 "):
        TurntableExporter(**{**SETTINGS, "codec": "gif", "fps": 60})


def test_negative_turns_go_the_other_way_round():
    azimuths = TurntableExporter(**{**SETTINGS, "turns": -2.0}).cameras().azimuth_deg % 360
    torch.testing.assert_close(azimuths, torch.arange(9) * -80.0 % 360)


def test_assets_are_side_by_side_under_the_same_cameras_with_room_for_captions(tmp_path):
    first, second = Recorder(), Recorder()
    subjects = [Subject(no_gaussians(), render, "a") for render in (first, second)]
    settings = {**SETTINGS, "beside": "none", "size": 64}
    [path] = TurntableExporter(**settings).compare(subjects, tmp_path)
    frames = imageio.imread(path).astype(float) / 255
    height, width = frames.shape[1:3]
    assert height > 64
    assert width > 128
    np.testing.assert_allclose(frames[:, 8:56, 8:56], frames[:, 8:56, width - 56 : width - 8], atol=0.05)
    for left, right in zip(first.cameras, second.cameras, strict=True):
        assert torch.equal(left.world_to_camera, right.world_to_camera)


def test_a_frame_that_is_too_wide_for_the_codecs_is_refused_before_it_is_rendered(tmp_path):
    subjects = [Subject(no_gaussians(), Recorder(), "a")] * 3
    with pytest.raises(UserError, match=r"^exporter\.turntable\.size: expected at most \d+,"):
        TurntableExporter(**{**SETTINGS, "size": 4096}).compare(subjects, tmp_path)
