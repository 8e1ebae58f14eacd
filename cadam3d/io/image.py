"""Images: writing PNG files, colour maps for depth and alpha, and contact sheets."""

import math
import re
import warnings
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from cadam3d.core.errors import UserError
from cadam3d.io.atomic import replacing
from cadam3d.io.reading import read_bytes

# Viridis (van der Walt and Smith, CC0) at ten equal distances. Dark is low, and it stays readable in grey.
VIRIDIS = (
    (68, 1, 84), (72, 40, 120), (62, 74, 137), (49, 104, 142), (38, 130, 142),
    (31, 158, 137), (53, 183, 121), (110, 206, 88), (181, 222, 43), (253, 231, 37),
)  # fmt: skip
LABEL_MARGIN = 4  # pixels
STEP_PICTURE = re.compile(r"step_([0-9]{6,12})\.png")
LARGEST_PNG = 1 << 28  # bytes


def to_uint8(images: Float[Tensor, "*batch h w c"]) -> UInt8[np.ndarray, "*batch h w c"]:
    """Return images in [0, 1] as bytes, rounded to the nearest; values outside are clamped, NaN is black."""
    return (images.detach().nan_to_num(nan=0.0).clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()


def cutout(
    over_black: Float[Tensor, "*batch h w 3"], alpha: Float[Tensor, "*batch h w"]
) -> Float[Tensor, "*batch h w 4"]:
    """Return images with straight alpha, from renders over black and their alpha, for 8-bit files.

    After :func:`to_uint8`, each pixel over any colour, ``a * rgb + (1 - a) * colour``, is the render over
    that colour to within 1/255, unless the Gaussians are brighter than white. Colours are divided by the
    rounded alpha, because that is the one in the file.
    """
    rounded = (alpha.nan_to_num(nan=0.0).clamp(0, 1) * 255).round() / 255
    straight = torch.where(rounded[..., None] > 0, over_black / rounded[..., None], 0.0)
    return torch.cat([straight, rounded[..., None]], dim=-1)


def write_png(path: Path, image: Float[Tensor, "h w c"]) -> None:
    """Write one image in [0, 1] as 8-bit sRGB, atomically; a fourth channel is straight alpha.

    Raises ``UserError`` if the file cannot be written.
    """
    write_png_bytes(path, to_uint8(image))


def write_png_bytes(path: Path, image: UInt8[np.ndarray, "h w c"]) -> None:
    """Write one 8-bit image, atomically. Raises ``UserError`` if it cannot be written."""
    with replacing(path) as temporary:
        temporary.write_bytes(imageio.imwrite("<bytes>", image, extension=".png"))


def step_picture(folder: Path, step: int) -> Path:
    """Return the path of the image of ``step`` in ``folder``; the names sort in the order of the steps."""
    return folder / f"step_{step:06d}.png"


def step_pictures(folder: Path) -> list[tuple[int, Path]]:
    """Return the step and the path of every such image in ``folder``, in order; none if it does not exist."""
    named = [(STEP_PICTURE.fullmatch(path.name), path) for path in folder.glob("step_*.png")]
    return sorted((int(name.group(1)), path) for name, path in named if name is not None)


def drop_step_pictures(folder: Path, step: int) -> None:
    """Delete the images of the steps after ``step``, which a resumed run draws again."""
    for drawn_at, path in step_pictures(folder):
        if drawn_at > step:
            path.unlink()


def read_png(path: Path) -> UInt8[np.ndarray, "h w 3"]:
    """Return a picture that :func:`write_png` has written. Raises ``UserError`` if it cannot be read."""
    content = read_bytes(path, largest=LARGEST_PNG)
    # Pillow raises many exceptions for damaged files, and one for a picture that would need too much memory.
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(BytesIO(content), formats=["PNG"]) as picture:
                return np.array(picture.convert("RGB"))
    except Exception as error:
        reason = " ".join(str(error).split())[:200]
        raise UserError(f"{path}: expected a PNG picture, got {reason}. Try: delete it") from error


def colorize(values: Float[Tensor, "*batch h w"]) -> Float[Tensor, "*batch h w 3"]:
    """Return the Viridis colours of values in [0, 1]; values outside are clamped, and NaN counts as 0."""
    table = torch.tensor(VIRIDIS, dtype=values.dtype, device=values.device) / 255
    position = values.nan_to_num(nan=0.0).clamp(0, 1) * (len(VIRIDIS) - 1)
    low = position.floor().clamp_max(len(VIRIDIS) - 2)
    return torch.lerp(table[low.long()], table[low.long() + 1], (position - low)[..., None])


def closeness(
    depth: Float[Tensor, "*batch h w"], alpha: Float[Tensor, "*batch h w"], distance: float
) -> Float[Tensor, "*batch h w 3"]:
    """Return depth as colours: yellow is near, dark is far, and black is background.

    The range covers the unit ball, in which objects fit, seen from ``distance``. It is the same in every
    view, so that colours can be compared between images.
    """
    return colorize((distance + 1.0 - depth) / 2.0) * alpha[..., None]


def contact_sheet(
    images: Float[Tensor, "v h w 3"], columns: int, labels: Sequence[str] = ()
) -> Float[Tensor, "sheet_h sheet_w 3"]:
    """Return one image with all images in rows of ``columns``, and with labels in their corners.

    White fills the rest of the last row.
    """
    views, height, width, _ = images.shape
    rows = math.ceil(views / columns)
    cells = images.new_ones(rows * columns, height, width, 3)
    cells[:views] = images
    for cell, label in zip(cells, labels, strict=False):
        mask = Image.new("L", (width, height))
        ImageDraw.Draw(mask).text(
            (LABEL_MARGIN, LABEL_MARGIN), label, fill=255, font=ImageFont.load_default()
        )
        coverage = torch.from_numpy(np.array(mask)).to(cell) / 255
        # The ink is dark or light depending on the corner.
        ink = 0.15 if cell[: height // 8 + 1, : width // 4 + 1].mean() > 0.5 else 0.9
        cell.lerp_(torch.full_like(cell, ink), coverage[..., None])
    grid = cells.reshape(rows, columns, height, width, 3)
    return grid.transpose(1, 2).reshape(rows * height, columns * width, 3)
