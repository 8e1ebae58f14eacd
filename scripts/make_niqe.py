"""Fit the parameters of metric=niqe and write cadam3d/metric/niqe_parameters.npz.

    python scripts/make_niqe.py

The parameters are fitted to photographs that are installed with scikit-image and matplotlib: Eileen Collins
(NASA), the cameraman (Lav Varshney), the cat Chelsea (Stefan van der Walt), a cup of coffee (Rachel
Michetti), a motorcycle (the Middlebury 2014 stereo benchmark), Greek coins (Brooklyn Museum), gravel
(CC0Textures) and Grace Hopper (US Navy). Mittal et al. have 125 photographs. With eight, three things are
different: every photograph except the last also counts at half its size, blocks overlap by half, and blocks
count from 0.4 of the sharpness of the sharpest one instead of 0.75. Chosen in this way, the numbers have the
magnitude of those with the published parameters, but they are not the same.
"""

from pathlib import Path

import imageio.v3 as iio
import matplotlib
import numpy as np
import skimage
from jaxtyping import Float, Float32

from cadam3d.io.atomic import replacing
from cadam3d.metric import natural
from cadam3d.metric.niqe import OWN_PARAMETERS

DATA = Path(skimage.__file__).parent / "data"
HALVED = ("astronaut", "camera", "chelsea", "coffee", "motorcycle_left", "coins", "gravel")
WHOLE = Path(matplotlib.__file__).parent / "mpl-data/sample_data/grace_hopper.jpg"
WINDOW = 7  # pixels
WINDOW_SIGMA = 7 / 6  # pixels
OFFSETS = (0, natural.BLOCK // 2)  # of the blocks, in both directions
SHARPNESS = 0.4  # relative to the sharpest block of a photograph


def main() -> None:
    """Fit and write the parameters."""
    pristine = fitted(photographs())
    with replacing(OWN_PARAMETERS) as temporary:
        values = (pristine.mean[None], pristine.covariance, pristine.window)
        np.savez(temporary, **dict(zip(natural.KEYS, values, strict=True)))
    print(OWN_PARAMETERS)


def photographs() -> list[Float32[np.ndarray, "h w"]]:
    """Return the luma of all photographs, at all sizes."""
    found = []
    for path in [DATA / f"{name}.png" for name in HALVED] + [WHOLE]:
        content = iio.imread(path)
        whole = content.astype(np.float32) if content.ndim == 2 else natural.luma(content / 255)
        found.append(whole)
        if path != WHOLE:
            even = whole[: whole.shape[0] // 2 * 2, : whole.shape[1] // 2 * 2]
            found.append(natural.halved(even).round().astype(np.float32))
    return found


def gaussian_window() -> Float[np.ndarray, "k k"]:
    """Return the weights of the local means, with sum 1."""
    offsets = np.arange(WINDOW) - WINDOW // 2
    row = np.exp(-(offsets**2) / (2 * WINDOW_SIGMA**2))
    return np.outer(row, row) / row.sum() ** 2


def fitted(photographs: list[Float32[np.ndarray, "h w"]]) -> natural.Pristine:
    """Return the Gaussian model of the sharp blocks (paper sec. II-B and II-E)."""
    window = gaussian_window()
    rows = [row for photograph in photographs for row in _sharp_blocks(photograph, window)]
    return natural.Pristine(np.mean(rows, axis=0), np.cov(rows, rowvar=False), window)


def _sharp_blocks(
    photograph: Float32[np.ndarray, "h w"], window: Float[np.ndarray, "k k"]
) -> Float[np.ndarray, "b 36"]:
    parts = [photograph[down:, across:] for down in OFFSETS for across in OFFSETS]
    features = np.concatenate([natural.block_features(part, window) for part in parts])
    deviations = [natural.normalised(natural.cropped(part), window)[1] for part in parts]
    blocks = np.concatenate([natural.blocks_of(each, natural.BLOCK) for each in deviations])
    sharpness = blocks.mean(axis=(1, 2))
    is_whole = ~np.isnan(features).any(axis=1)
    return features[(sharpness > SHARPNESS * sharpness[is_whole].max()) & is_whole]


if __name__ == "__main__":
    main()
