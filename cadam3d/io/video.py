"""Videos: H.264 in MP4, VP9 in WebM and animated GIF. The suffix of the file chooses the format.

MP4 with yuv420p plays in every browser and player. WebM may be transparent. GIF plays wherever pictures are
shown.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import imageio_ffmpeg
import numpy as np
from jaxtyping import UInt8

from cadam3d.core.errors import UserError
from cadam3d.io.atomic import replacing

# A palette of its own for each frame has the best colours, and needs memory for a single frame only.
GIF = "split[a][b];[a]palettegen=stats_mode=single[p];[b][p]paletteuse=new=1:dither=sierra2_4a"


@dataclass(frozen=True)
class Format:
    """The options of ffmpeg for one kind of file."""

    codec: str
    pixels: str  # the pixel format in the file
    options: tuple[str, ...]
    transparent_pixels: str | None  # the pixel format with a fourth channel; None if the format has none
    most_fps: int  # frames per second
    is_halved: bool  # whether colours have half the resolution, so that sizes must be even


FORMATS = {
    # A constant rate factor of 18 is visually lossless; larger numbers give smaller and worse files. Players
    # handle rates up to 240; much larger ones overflow in ffmpeg. With faststart, a browser plays the video
    # while it loads.
    ".mp4": Format("libx264", "yuv420p", ("-crf", "18", "-movflags", "+faststart"), None, 240, True),
    # VP9's factors have another scale. With a bit rate of 0, the factor alone decides. Frames that are not
    # shown (auto-alt-ref) cannot be transparent.
    ".webm": Format(
        "libvpx-vp9",
        "yuv420p",
        ("-crf", "24", "-b:v", "0", "-row-mt", "1", "-cpu-used", "4", "-auto-alt-ref", "0"),
        "yuva420p",
        240,
        True,
    ),
    # Delays are whole hundredths of a second, and browsers slow down a GIF with delays below two of them.
    ".gif": Format("gif", "pal8", ("-filter_complex", GIF, "-loop", "0"), None, 50, False),
}
CODECS = tuple(suffix.removeprefix(".") for suffix in FORMATS)


def write_video(path: Path, frames: Iterable[UInt8[np.ndarray, "h w c"]], *, fps: int) -> None:
    """Write video frames atomically, one at a time, so that a generator needs memory for one frame only.

    ``path`` ends with one of the suffixes in ``FORMATS``. Frames have three channels, or four (straight
    alpha) in a format that can be transparent. Colours of MP4 and WebM have half the resolution, so odd sizes
    are padded there by repeating the last row or column. Raises ``UserError`` if the
    file cannot be written, or if ffmpeg is missing or fails.
    """
    kind = FORMATS[path.suffix]
    with replacing(path) as temporary:
        writer = None
        try:
            for each in frames:
                height, width, _ = each.shape
                odd = ((0, height % 2), (0, width % 2), (0, 0))
                frame = np.pad(each, odd, mode="edge") if kind.is_halved else each
                if writer is None:
                    writer = _open(temporary, kind, fps, frame)
                    _send(writer, None)
                _send(writer, frame)
        finally:
            if writer is not None:
                writer.close()
        if not temporary.is_file() or temporary.stat().st_size == 0:
            raise _ffmpeg_error("it wrote nothing")


def _open(path: Path, kind: Format, fps: int, frame: UInt8[np.ndarray, "h w c"]):
    """Return a generator to which frames like ``frame`` are sent."""
    height, width, channels = frame.shape
    pixels = kind.pixels if channels == 3 else kind.transparent_pixels
    assert pixels is not None, "the exporters refuse transparent frames in other formats"
    return imageio_ffmpeg.write_frames(
        str(path),
        (width, height),
        pix_fmt_in="rgb24" if channels == 3 else "rgba",
        pix_fmt_out=pixels,
        fps=fps,
        codec=kind.codec,
        # The options choose the quality.
        quality=None,  # pyright: ignore[reportArgumentType]  (its default is a number)
        # The frames already have even sizes. The default of 16 would rescale them.
        macro_block_size=1,
        # Palettes have equal colours in flat pictures, of which ffmpeg would warn.
        ffmpeg_log_level="error",
        output_params=list(kind.options),
    )


def _send(writer, frame: UInt8[np.ndarray, "h w c"] | None) -> None:
    """Send a frame to ffmpeg, which starts with the first one, or None to begin."""
    try:
        writer.send(None if frame is None else np.ascontiguousarray(frame))
    except (RuntimeError, OSError, StopIteration) as error:
        raise _ffmpeg_error(error) from error


def _ffmpeg_error(reason: object) -> UserError:
    first_line = next(iter(str(reason).strip().splitlines()), "unknown reason")
    problem = f"video: ffmpeg is missing or does not work ({first_line})"
    return UserError(f"{problem}. Try: pip install --force-reinstall imageio-ffmpeg")
