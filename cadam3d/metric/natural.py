"""Statistics of natural images for NIQE (Mittal et al. 2013): features, their model, and the distance to it.

Where the paper leaves something open, this follows basicsr 1.4, which most papers use. Three of its
conventions change the result and are therefore part of the definition:

* The image is the luma of ITU-R BT.601 in [16, 235], rounded to whole numbers.
* The second scale is half the size, by a bicubic kernel that is stretched to twice its width.
* A block without any contrast in a direction has no fit there. Its shape counts as the smallest of the grid,
  and its missing widths are left out of the means.

As in basicsr, pictures are processed in single precision. In plain areas, rounding decides between a small
number and zero, and the shapes come from a grid, so the precision is visible in the fourth digit of a result.
"""

import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32
from scipy.ndimage import correlate, correlate1d
from scipy.special import gamma

BLOCK = 96  # pixels, at the first scale
SCALES = 2
NUM_FEATURES = 36  # 18 per scale
# Weights of red, green and blue in the luma of an image in [0, 1].
LUMA = np.array([65.481, 128.553, 24.966])
LUMA_BLACK = 16.0
WHITE = 255.0
# Cubic convolution (Keys 1981) with a = -0.5, twice as wide, at the eight pixels nearest to the centre of a
# pixel of half the size. The sum is 1.
HALVING = np.array([-3, -9, 29, 111, 111, 29, -9, -3]) / 256
# The shapes that a fit may have, and for each the ratio of moments by which it is recognised.
SHAPES = np.arange(0.2, 10.001, 0.001)
RATIOS = gamma(2 / SHAPES) ** 2 / (gamma(1 / SHAPES) * gamma(3 / SHAPES))
# The neighbours with which products are fitted: to the right, below, and on both diagonals. (rows, columns)
NEIGHBOURS = ((0, 1), (1, 0), (1, 1), (1, -1))
# The entries of a file of parameters, as basicsr names them.
KEYS = ("mu_pris_param", "cov_pris_param", "gaussian_window")


@dataclass(frozen=True)
class Pristine:
    """A Gaussian model of the features of pristine photographs, and the window they were computed with."""

    mean: Float[np.ndarray, "f"]
    covariance: Float[np.ndarray, "f f"]
    window: Float[np.ndarray, "k k"]


def luma(image: Float[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w"]:
    """Return the luma of an RGB image in [0, 1] as whole numbers in [16, 235].

    The image is first rounded to 8 bits per channel, as it would be in a file.
    """
    stored = np.round(np.clip(image, 0, 1).astype(np.float64) * 255) / 255
    return np.round(stored @ LUMA + LUMA_BLACK).astype(np.float32)


def distance(image: Float[np.ndarray, "h w 3"], pristine: Pristine) -> float:
    """Return the distance between the blocks of an image and the model (paper eq. 10); lower is better.

    Blocks with missing features count for the mean but not for the covariance. Returns NaN if fewer than two
    blocks have all features.
    """
    features = block_features(luma(image), pristine.window)
    textured = features[~np.isnan(features).any(axis=1)]
    if len(textured) < 2:
        return float("nan")
    covariance = (pristine.covariance + np.cov(textured, rowvar=False)) / 2
    gap = pristine.mean - np.nanmean(features, axis=0)
    return float(np.sqrt(gap @ np.linalg.pinv(covariance) @ gap))


def block_features(
    image: Float32[np.ndarray, "h w"], window: Float[np.ndarray, "k k"]
) -> Float[np.ndarray, "b 36"]:
    """Return the features of every whole block of 96 x 96 pixels; NaN where a block has no fit.

    Per scale these are 18: shape and width of the normalised luma, and for each of the four neighbours the
    shape, mean, left and right width of the products (paper eq. 4 to 8).
    """
    scaled = cropped(image)
    columns = []
    for scale in range(SCALES):
        coefficients, _ = normalised(scaled, window)
        columns.append(_fits(blocks_of(coefficients, BLOCK >> scale)))
        scaled = halved(scaled)
    return np.concatenate(columns, axis=1)


def read(file: Path) -> Pristine:
    """Return the parameters in a file such as basicsr's ``niqe_pris_params.npz``.

    Nothing in the file is executed. Raises almost any exception if an entry is missing or damaged.
    """
    with np.load(file, allow_pickle=False) as entries:
        mean, covariance, window = (np.asarray(entries[name], dtype=np.float64) for name in KEYS)
    found = Pristine(mean.reshape(NUM_FEATURES), covariance.reshape(NUM_FEATURES, NUM_FEATURES), window)
    if not all(np.isfinite(values).all() for values in (mean, covariance, window)):
        raise ValueError("some values are not finite")
    return found


def cropped(image: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "a b"]:
    """Return the whole blocks of an image, counted from the top left corner."""
    height, width = (side // BLOCK * BLOCK for side in image.shape)
    return image[:height, :width]


def normalised(
    image: Float32[np.ndarray, "h w"], window: Float[np.ndarray, "k k"]
) -> tuple[Float32[np.ndarray, "h w"], Float32[np.ndarray, "h w"]]:
    """Return the image with local mean 0 and local deviation near 1, and its local deviation (eq. 1 to 3)."""
    mean = correlate(image, window, mode="nearest")
    deviation = np.sqrt(np.abs(correlate(image**2, window, mode="nearest") - mean**2))
    return (image - mean) / (deviation + 1), deviation


def halved(image: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h2 w2"]:
    """Return the image at half its size; beyond its edges it is mirrored. Both sides must be even."""
    half = image / np.float32(WHITE)
    # First the rows and then the columns. The kernel has its centre between the two pixels of a pair.
    for _ in range(2):
        half = correlate1d(half, HALVING, axis=0, mode="reflect", origin=-1)[::2].T
    return half * np.float32(WHITE)


def blocks_of(image: Float32[np.ndarray, "h w"], size: int) -> Float32[np.ndarray, "b s s"]:
    """Return the squares that an image consists of; its sides must be multiples of ``size`` pixels."""
    down, across = (side // size for side in image.shape)
    tiles = image.reshape(down, size, across, size).transpose(0, 2, 1, 3)
    return tiles.reshape(down * across, size, size)


def _fits(blocks: Float32[np.ndarray, "b s s"]) -> Float[np.ndarray, "b 18"]:
    """Return the features of blocks of normalised luma at one scale."""
    shape, left, right = asymmetric_fit(blocks)
    columns = [shape, (left + right) / 2]
    for neighbour in NEIGHBOURS:
        # The neighbour of a pixel at the edge of a block is on the other side of the block.
        shape, left, right = asymmetric_fit(blocks * np.roll(blocks, neighbour, axis=(1, 2)))
        mean = (right - left) * gamma(2 / shape) / gamma(1 / shape)
        columns += [shape, mean, left, right]
    return np.stack(columns, axis=1)


def asymmetric_fit(blocks: Float32[np.ndarray, "b s s"]) -> tuple[Float[np.ndarray, "b"], ...]:
    """Return shape, left and right width of the asymmetric generalised Gaussian of each block.

    They are estimated from moments (Lasmar et al. 2009). A side without values has the width NaN, and then
    the shape is the smallest.
    """
    with warnings.catch_warnings(), np.errstate(divide="ignore", invalid="ignore"):
        warnings.filterwarnings("ignore", "Mean of empty slice", RuntimeWarning)
        left, right, ratio = np.array([_moments(block.reshape(-1)) for block in blocks]).T
        skew = left / right
        ratio = ratio * (skew**3 + 1) * (skew + 1) / (skew**2 + 1) ** 2
    middles = (RATIOS[1:] + RATIOS[:-1]) / 2
    shape = SHAPES[np.where(np.isnan(ratio), 0, np.searchsorted(middles, ratio))]
    width = np.sqrt(gamma(1 / shape) / gamma(3 / shape))
    return shape, left * width, right * width


def _moments(values: Float32[np.ndarray, "n"]) -> tuple[np.floating, np.floating, np.floating]:
    """Return the root mean squares of the negative and of the positive values, and the ratio of moments."""
    left, right = (np.sqrt(np.mean(values[side] ** 2)) for side in (values < 0, values > 0))
    return left, right, np.mean(np.abs(values)) ** 2 / np.mean(values**2)
