"""Make cadam3d/metric/niqe_parameters.npz, and compare our NIQE with that of basicsr.

    python scripts/make_niqe.py                       # fits the parameters of metric=niqe
    python scripts/make_niqe.py --basicsr DIR         # writes tests/metric/niqe_basicsr.json

The parameters are fitted to photographs that are installed with scikit-image and matplotlib: Eileen Collins
(NASA), the cameraman (Lav Varshney), the cat Chelsea (Stefan van der Walt), a cup of coffee (Rachel
Michetti), a motorcycle (the Middlebury 2014 stereo benchmark), Greek coins (Brooklyn Museum), gravel
(CC0Textures) and Grace Hopper (US Navy). Mittal et al. have 125 photographs. With eight, three things are
different: every photograph except the last also counts at half its size, blocks overlap by half, and blocks
count from 0.4 of the sharpness of the sharpest one instead of 0.75. Chosen in this way, the numbers have the
magnitude of those with the published parameters, but they are not the same.

DIR is an unpacked source distribution of basicsr 1.4.2. Its niqe.py runs as it is, apart from modules that
it imports and does not need here.
"""

import argparse
import importlib.util
import json
import sys
import types
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import matplotlib
import numpy as np
import scipy.ndimage
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
TESTS = Path(__file__).parent.parent / "tests"
EXPECTED = TESTS / "metric/niqe_basicsr.json"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--basicsr", metavar="DIR", type=Path)
    folder = parser.parse_args().basicsr
    if folder is None:
        pristine = fitted(photographs())
        with replacing(OWN_PARAMETERS) as temporary:
            values = (pristine.mean[None], pristine.covariance, pristine.window)
            np.savez(temporary, **dict(zip(natural.KEYS, values, strict=True)))
        print(OWN_PARAMETERS)
        return
    with replacing(EXPECTED) as temporary:
        temporary.write_text(json.dumps(expected(folder / "basicsr"), indent=1) + "\n", encoding="utf-8")
    print(EXPECTED)


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


def expected(package: Path) -> dict[str, Any]:
    """Return basicsr's numbers for the images of the tests, with its parameters and with ours."""
    calculate, niqe = _basicsr(package)
    with OWN_PARAMETERS.open("rb") as file, np.load(file) as stored:
        ours = [stored[key] for key in natural.KEYS]
    numbers: dict[str, Any] = {"own": {}, "basicsr": {}}
    for name, image in _imported("niqe_images", TESTS / "niqe_images.py").images().items():
        bgr = image[..., ::-1]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # plain blocks have no fit
            numbers["basicsr"][name] = calculate(bgr, crop_border=0, input_order="HWC", convert_to="y")
            luma = sys.modules["basicsr.metrics.metric_util"].to_y_channel(bgr.astype(np.float32))
            numbers["own"][name] = niqe(luma.squeeze().round(), *ours)
    return numbers


def _basicsr(package: Path) -> tuple[Callable[..., float], Callable[..., float]]:
    """Return ``calculate_niqe`` and ``niqe`` of basicsr."""

    class Registry:
        def register(self) -> Callable[[Any], Any]:
            return lambda function: function

    def module(name: str, **entries: Any) -> Any:
        made = types.ModuleType(name)
        vars(made).update(entries)
        sys.modules[name] = made
        return made

    def read(name: str) -> Any:
        return _imported(name, package.parent / Path(*name.split(".")).with_suffix(".py"))

    module("cv2")
    module("scipy.ndimage.filters", convolve=scipy.ndimage.convolve)  # its old name
    module("basicsr")
    module("basicsr.metrics")
    module("basicsr.utils.registry", METRIC_REGISTRY=Registry())
    utils = module("basicsr.utils")
    utils.bgr2ycbcr = read("basicsr.utils.color_util").bgr2ycbcr
    read("basicsr.utils.matlab_functions")
    read("basicsr.metrics.metric_util")
    found = read("basicsr.metrics.niqe")
    return found.calculate_niqe, found.niqe


def _imported(name: str, path: Path) -> Any:
    """Return the module in a file."""
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    made = importlib.util.module_from_spec(spec)
    sys.modules[name] = made
    spec.loader.exec_module(made)
    return made


if __name__ == "__main__":
    main()
