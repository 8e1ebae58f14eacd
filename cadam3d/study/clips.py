"""Clips: turntables as single frames, which a page draws side by side from one clock.

Frames are WebP pictures. Unlike two videos, they cannot drift apart, and every browser decodes them. All
clips of a study come from the same cameras, over the same background, in the same size.
"""

import io
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import UInt8
from PIL import Image

from cadam3d.core.cameras import turntable
from cadam3d.core.rendering import RenderFn
from cadam3d.io.image import to_uint8

FOV_Y_DEG = 40.0  # at distance 3 the unit ball just fits
VIEWS_AT_ONCE = 4  # bounds the memory of rendering
# A ruined clip keeps this many pixels per side of each frame, and each of them gets noise.
RUINED_SIZE = 12  # pixels
RUINED_NOISE = 70.0  # standard deviation, of 255
RUINED_QUALITY = 30  # of WebP; there is no detail to keep
# A clip in which less than this share of the pixels differs from the background shows nothing.
LEAST_VISIBLE = 0.01
VISIBLE_CHANGE = 16  # of 255
ENCODER_EFFORT = 4  # 0 to 6


@dataclass(frozen=True, kw_only=True)
class ClipSettings:
    """Settings with which every clip of a study is rendered."""

    size: int  # pixels, height and width
    frames: int  # of one turn
    seconds: float  # of one turn
    elevation_deg: float
    distance: float  # world units, from the camera to the origin
    backdrop: Sequence[float]  # RGB in [0, 1]
    quality: int  # of WebP, in [1, 100]


@dataclass(frozen=True)
class FilmedTurn:
    """The frames of one turn, each as the bytes of a WebP file."""

    frames: tuple[bytes, ...]
    small: UInt8[np.ndarray, "v s s 3"]  # the frames with RUINED_SIZE pixels per side
    visible: float  # share of the pixels of all frames that differ from the background, in [0, 1]


def film(render: RenderFn, settings: ClipSettings) -> FilmedTurn:
    """Return one turn of an object, which begins at the front."""
    cameras = turntable(
        settings.frames,
        elevation_deg=settings.elevation_deg,
        distance=settings.distance,
        fov_y_deg=FOV_Y_DEG,
        size=settings.size,
    )
    color = torch.tensor([float(channel) for channel in settings.backdrop])
    backdrop = to_uint8(color[None, None])
    frames, small, visible = [], [], []
    for some in cameras.parts(VIEWS_AT_ONCE):
        for picture in to_uint8(render(some, color.expand(len(some), 3)).rgb):
            change = np.abs(picture.astype(np.int16) - backdrop).max(axis=-1)
            visible.append(float((change >= VISIBLE_CHANGE).mean()))
            image = Image.fromarray(picture)
            small.append(np.asarray(image.resize((RUINED_SIZE, RUINED_SIZE), Image.Resampling.BOX)))
            frames.append(encoded(image, settings.quality))
    return FilmedTurn(tuple(frames), np.stack(small), float(np.mean(visible)))


def ruined(clip: FilmedTurn, settings: ClipSettings, seed: int) -> tuple[bytes, ...]:
    """Return the frames of a clip, blurred and noisy until nothing can be recognised.

    The noise is the same in all frames, so that the clip turns as calmly as the others.
    """
    noise = np.random.default_rng(seed).normal(0.0, RUINED_NOISE, size=clip.small.shape[1:])
    coarse = (clip.small + noise).clip(0, 255).astype(np.uint8)
    size, quality = (settings.size, settings.size), min(settings.quality, RUINED_QUALITY)
    return tuple(
        encoded(Image.fromarray(picture).resize(size, Image.Resampling.BICUBIC), quality)
        for picture in coarse
    )


def encoded(image: Image.Image, quality: int) -> bytes:
    """Return a picture as the bytes of a WebP file."""
    buffer = io.BytesIO()
    image.save(buffer, "WEBP", quality=quality, method=ENCODER_EFFORT)
    return buffer.getvalue()
