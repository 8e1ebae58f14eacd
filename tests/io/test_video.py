"""Videos contain the frames that were written."""

import imageio.v3 as imageio
import numpy as np
import pytest

from cadam3d.core.errors import UserError
from cadam3d.io.video import write_video


def greys(count, height, width):
    for i in range(count):
        yield np.full((height, width, 3), 20 * i, dtype=np.uint8)


@pytest.mark.parametrize("shape", [(32, 48), (33, 47), (2, 2), (1, 1), (250, 130)])
def test_all_frames_are_read_back_in_order_and_with_even_sizes(tmp_path, shape):
    height, width = shape
    write_video(tmp_path / "a.mp4", greys(7, height, width), fps=10)
    frames = imageio.imread(tmp_path / "a.mp4")
    assert frames.shape == (7, height + height % 2, width + width % 2, 3)
    assert np.abs(frames.mean(axis=(1, 2, 3)) - 20 * np.arange(7)).max() < 4


def test_the_frame_rate_and_format_are_what_players_expect(tmp_path):
    write_video(tmp_path / "a.mp4", greys(6, 16, 16), fps=12)
    facts = imageio.immeta(tmp_path / "a.mp4", plugin="FFMPEG")
    assert (facts["fps"], facts["codec"], facts["pix_fmt"].split("(")[0]) == (12, "h264", "yuv420p")


def test_no_frames_are_refused(tmp_path):
    with pytest.raises(UserError, match="it wrote nothing"):
        write_video(tmp_path / "a.mp4", [], fps=10)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("executable", ["/nonexistent/ffmpeg", "/bin/false"])
def test_a_missing_or_broken_ffmpeg_is_reported_with_a_hint(tmp_path, monkeypatch, executable):
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", executable)
    with pytest.raises(UserError, match="pip install --force-reinstall imageio-ffmpeg"):
        write_video(tmp_path / "a.mp4", greys(30, 64, 64), fps=10)
    assert list(tmp_path.iterdir()) == []


def test_an_error_of_the_renderer_is_not_blamed_on_ffmpeg_and_keeps_the_old_video(tmp_path):
    write_video(tmp_path / "a.mp4", greys(3, 16, 16), fps=10)
    before = (tmp_path / "a.mp4").read_bytes()

    def fails():
        yield from greys(2, 16, 16)
        raise RuntimeError("the renderer broke")

    with pytest.raises(RuntimeError, match="the renderer broke"):
        write_video(tmp_path / "a.mp4", fails(), fps=10)
    assert (tmp_path / "a.mp4").read_bytes() == before
    assert len(list(tmp_path.iterdir())) == 1
