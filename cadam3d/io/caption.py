"""Captions: several pictures side by side, with two lines of text under each."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageColor, ImageDraw, ImageFont

from cadam3d.core import palette

Color = tuple[int, ...]  # red, green and blue from 0 to 255
# The colours of a title and of a detail, on light and on dark paper.
LIGHT = (palette.INK, palette.SOFT)
DARK = (palette.DARK[palette.INK], palette.DARK[palette.SOFT])
PAPER = ImageColor.getrgb(palette.PAPER)[:3]
BOLD, REGULAR = "DejaVuSans-Bold.ttf", "DejaVuSans.ttf"
# The size of letters as a share of the width of a picture, and its limits.
SHARE = 1 / 18
SMALLEST, LARGEST = 9, 32  # pixels
ELLIPSIS = "\u2026"


@dataclass(frozen=True)
class Caption:
    """The text under one picture."""

    title: str
    detail: str = ""


def side_by_side(
    pictures: Sequence[UInt8[np.ndarray, "h w c"]], captions: Sequence[Caption], paper: Color = PAPER
) -> UInt8[np.ndarray, "tall wide c"]:
    """Return one picture with ``pictures``, which have one size, from left to right on ``paper``.

    Under each is its caption, with letters that grow with the pictures. A line that is too long for its
    picture ends with an ellipsis. Without captions, the pictures are joined without margins.
    """
    if not captions:
        return np.concatenate(pictures, axis=1)
    height, width, channels = pictures[0].shape
    letter = round(min(max(width * SHARE, SMALLEST), LARGEST))
    gap = letter // 2
    strip = round(3.6 * letter) if any(caption.detail for caption in captions) else round(2.1 * letter)
    sheet = np.full((height + strip, len(pictures) * (width + gap) - gap, channels), 255, dtype=np.uint8)
    sheet[..., :3] = paper
    title_color, detail_color = LIGHT if np.mean(paper) > 127 else DARK
    for index, (picture, caption) in enumerate(zip(pictures, captions, strict=True)):
        left = index * (width + gap)
        sheet[:height, left : left + width] = picture
        text = Image.new("RGB", (width, strip), paper)
        _write(text, caption.title, round(0.5 * letter), BOLD, letter, title_color)
        _write(text, caption.detail, round(1.85 * letter), REGULAR, round(0.85 * letter), detail_color)
        sheet[height:, left : left + width, :3] = np.asarray(text)
    return sheet


def plain(text: str) -> str:
    """Return ``text`` on one line, without characters that cannot be drawn."""
    letters = "".join(letter if letter.isprintable() else " " for letter in text)
    return " ".join(letters.encode("utf-8", "replace").decode("utf-8").split())


@cache
def font(face: str, size: int) -> ImageFont.FreeTypeFont:
    """Return the font ``BOLD`` or ``REGULAR`` in ``size`` pixels.

    Both come with matplotlib, and have the letters of most alphabets.
    """
    # Matplotlib is slow to import, and few commands write captions.
    import matplotlib

    return ImageFont.truetype(Path(matplotlib.get_data_path(), "fonts", "ttf", face), size)


def _write(image: Image.Image, text: str, top: int, face: str, size: int, color: str) -> None:
    """Write one line in the middle of ``image`` (in place), ``top`` pixels below its upper border."""
    text, room = plain(text), image.width - size // 2
    letters = font(face, size)
    if letters.getlength(text) > room:
        while text and letters.getlength(text + ELLIPSIS) > room:
            text = text[:-1]
        text = text.rstrip() + ELLIPSIS if text else ""
    ImageDraw.Draw(image).text((image.width / 2, top), text, fill=color, font=letters, anchor="ma")
