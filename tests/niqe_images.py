"""The images on which our NIQE is compared with that of basicsr: five photographs, each in four states."""

from functools import cache
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import skimage

PHOTOGRAPHS = ("astronaut.png", "chelsea.png", "coffee.png", "motorcycle_left.png", "rocket.jpg")
HEIGHT, WIDTH = 390, 490  # pixels: up to 20 blocks, and a rest that does not count
PLAIN = np.array([255, 255, 255])


@cache
def images() -> dict[str, np.ndarray]:
    """Return RGB images of 8 bits by name: as they are, blurred, noisy, and as an object on white."""
    found = {}
    for name in PHOTOGRAPHS:
        stem = name.partition(".")[0]
        image = iio.imread(Path(skimage.__file__).parent / "data" / name)[:HEIGHT, :WIDTH]
        found[f"{stem} as it is"] = image
        found[f"{stem} blurred"] = blurred(image)
        found[f"{stem} noisy"] = noisy(image)
        found[f"{stem} as an object"] = as_object(image)
    return found


def blurred(image: np.ndarray) -> np.ndarray:
    """Return the means over 3 x 3 pixels, in whole numbers."""
    rows, columns = image.shape[:2]
    padded = np.pad(image.astype(np.int64), ((1, 1), (1, 1), (0, 0)), mode="edge")
    total = sum(padded[y : y + rows, x : x + columns] for y in range(3) for x in range(3))
    return ((total + 4) // 9).astype(np.uint8)


def noisy(image: np.ndarray) -> np.ndarray:
    """Return the image with noise of about 12 of 255."""
    noise = np.random.default_rng(0).integers(-20, 21, image.shape)
    return np.clip(image.astype(np.int64) + noise, 0, 255).astype(np.uint8)


def as_object(image: np.ndarray) -> np.ndarray:
    """Return a disc of the image on white, so that some blocks are plain and others partly."""
    rows, columns = np.mgrid[: image.shape[0], : image.shape[1]]
    inside = (rows - 150) ** 2 + (columns - 200) ** 2 < 120**2
    return np.where(inside[..., None], image, PLAIN).astype(np.uint8)
