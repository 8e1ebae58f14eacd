"""Videos: H.264 in MP4 with yuv420p, which every browser and player supports."""

from collections.abc import Iterable
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
from jaxtyping import UInt8

from cadam3d.core.checks import require
from cadam3d.core.errors import UserError
from cadam3d.io.atomic import replacing

# 18 is visually lossless; larger numbers give smaller and worse files.
CRF = 18


def write_video(path: Path, frames: Iterable[UInt8[np.ndarray, "h w 3"]], *, fps: int) -> None:
    """Write video frames atomically, one at a time, so that a generator needs memory for one frame only.

    yuv420p needs even sizes, so odd sizes are padded by repeating the last row or column. Raises
    ``UserError`` if there is no frame, if the file cannot be written, or if ffmpeg is missing or fails.
    """
    with replacing(path) as temporary:
        writer = None
        try:
            for frame in frames:
                writer = writer or _open(temporary, fps)
                _append(writer, _even(frame))
        finally:
            if writer is not None:
                writer.close()
        require(
            writer is not None,
            str(path),
            expected="at least one frame",
            got=0,
            example="exporter.turntable.views=60",
        )
        if not temporary.is_file() or temporary.stat().st_size == 0:
            raise _ffmpeg_error("it wrote nothing")


def _even(frame: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h2 w2 3"]:
    height, width, _ = frame.shape
    return np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")


def _open(path: Path, fps: int):
    try:
        return imageio.get_writer(
            path,
            format="FFMPEG",  # pyright: ignore[reportArgumentType]  (its own documented name)
            mode="I",
            fps=fps,
            codec="libx264",
            pixelformat="yuv420p",
            # The frames already have even sizes. The default of 16 would rescale them.
            macro_block_size=1,
            # With faststart, a browser plays the video while it loads.
            output_params=["-crf", str(CRF), "-movflags", "+faststart"],
        )
    except (RuntimeError, OSError, ImportError) as error:
        raise _ffmpeg_error(error) from error


def _append(writer, frame: UInt8[np.ndarray, "h w 3"]) -> None:
    try:
        writer.append_data(frame)
    # ffmpeg starts with the first video frame, so a broken one fails here.
    except (RuntimeError, OSError) as error:
        raise _ffmpeg_error(error) from error


def _ffmpeg_error(reason: object) -> UserError:
    first_line = next(iter(str(reason).strip().splitlines()), "unknown reason")
    return UserError(
        f"video: ffmpeg is missing or does not work ({first_line}). The variable $IMAGEIO_FFMPEG_EXE "
        "chooses another one. Try: pip install --force-reinstall imageio-ffmpeg"
    )
