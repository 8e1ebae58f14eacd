"""Niqe: equal to basicsr's numbers, worse on distorted photographs, and its record names the parameters.

``niqe_basicsr.json`` has what ``niqe.py`` of basicsr 1.4.2 computes for the images of ``niqe_images``, with
the parameters of basicsr and with ours. The tests compute the numbers with our parameters, because those of
basicsr do not come with this package.
"""

import hashlib
import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from niqe_images import images
from protocols import output, ring
from splats import make_gaussians

from cadam3d.core.errors import UserError
from cadam3d.metric import natural
from cadam3d.metric.base import Measurand
from cadam3d.metric.niqe import OWN_NAME, OWN_PARAMETERS, Niqe

EXPECTED = json.loads((Path(__file__).parent / "niqe_basicsr.json").read_text(encoding="utf-8"))["own"]


def protocol(size=192, views=2):
    return ring(views=views, size=size)


def metric(parameters=None, **changes):
    return Niqe(protocol=protocol(**changes), parameters=parameters)


def showing(*pictures):
    """Return what is measured if the views of the protocol show these pictures in turn."""
    waiting = list(pictures)

    def render(cameras, background):
        return output(torch.stack([waiting.pop(0) for _ in range(len(cameras))]))

    return Measurand(gaussians=make_gaussians(3), render=render, prompt="a cat")


@cache
def picture(name, size=192):
    return torch.from_numpy(images()[name][:size, :size] / 255).float()


@pytest.fixture(scope="module")
def pristine():
    return natural.read(OWN_PARAMETERS)


def ours(image, pristine):
    return natural.distance(image / 255, pristine)


@pytest.mark.oracle
def test_numbers_equal_those_of_basicsr_on_20_images(pristine):
    found = {name: ours(image, pristine) for name, image in images().items()}
    assert len(found) == 20
    assert found == pytest.approx(EXPECTED, abs=1e-3)


def test_photographs_are_better_than_the_same_with_blur_or_noise():
    for stem in {name.partition(" ")[0] for name in EXPECTED}:
        assert EXPECTED[f"{stem} as it is"] < min(EXPECTED[f"{stem} blurred"], EXPECTED[f"{stem} noisy"])


@pytest.mark.parametrize(("shape", "left", "right"), [(0.8, 1.0, 1.0), (2.0, 0.5, 1.5), (1.2, 2.0, 1.0)])
def test_the_fit_recovers_an_asymmetric_generalised_gaussian(shape, left, right):
    # Each side is a power of a gamma variate, and a side is chosen in proportion to its width.
    generator = np.random.default_rng(0)
    count = 250 * 250
    sizes = generator.gamma(1 / shape, size=count) ** (1 / shape)
    is_left = generator.random(count) < left / (left + right)
    values = np.where(is_left, -left, right) * sizes
    found = natural.asymmetric_fit(values.reshape(1, 250, 250).astype(np.float32))
    assert [float(each[0]) for each in found] == pytest.approx([shape, left, right], rel=0.03)


def test_the_second_scale_is_a_bicubic_reduction_of_the_first():
    # Cubics (Keys 1981, a = -0.5) at the centres of the small pixels, written out pixel by pixel.
    def cubic(x):
        x = abs(x)
        if x <= 1:
            return 1.5 * x**3 - 2.5 * x**2 + 1
        return -0.5 * x**3 + 2.5 * x**2 - 4 * x + 2 if x < 2 else 0.0

    line = np.random.default_rng(0).integers(16, 236, 12).astype(np.float32)
    mirrored = np.concatenate([line[::-1], line, line[::-1]])
    wanted = []
    for centre in 2 * np.arange(6) + 0.5:
        near = range(int(centre) - 3, int(centre) + 5)
        weights = np.array([cubic((centre - pixel) / 2) for pixel in near])
        wanted.append((weights @ [mirrored[12 + pixel] for pixel in near]) / weights.sum())
    assert natural.halved(np.tile(line, (8, 1)))[0] == pytest.approx(wanted, rel=1e-6)


def test_the_luma_is_that_of_bt_601():
    colours = np.array([[[1, 1, 1], [0, 0, 0], [1, 0, 0]]], dtype=np.float32)
    assert natural.luma(colours).tolist() == [[235.0, 16.0, 81.0]]


def test_a_plain_image_has_no_number(pristine):
    assert np.isnan(ours(np.full((200, 200, 3), 180), pristine))


def test_the_number_is_the_mean_of_the_views_and_its_record_names_the_parameters(pristine):
    names = ("chelsea as it is", "chelsea noisy")
    measured = metric().measure(showing(*[picture(name) for name in names]))
    values = [ours(images()[name][:192, :192], pristine) for name in names]
    record = measured.details["niqe"]
    assert measured.numbers["niqe"] == pytest.approx(np.mean(values), abs=1e-9)
    assert record["views"] == pytest.approx(values, abs=1e-9)
    assert record["model"] == OWN_NAME
    assert record["weights_sha256"] == hashlib.sha256(OWN_PARAMETERS.read_bytes()).hexdigest()
    assert record["interval"]["low"] < measured.numbers["niqe"] < record["interval"]["high"]
    assert json.loads(json.dumps(record)) == record


def test_views_without_texture_are_left_out_and_counted():
    measured = metric().measure(showing(picture("chelsea as it is"), torch.ones(192, 192, 3)))
    assert measured.details["niqe"]["views_left_out"] == 1
    assert len(measured.details["niqe"]["views"]) == 1
    assert "1 of 2 views" in measured.warnings[0]


def test_without_any_texture_there_is_no_number():
    assert metric().measure(showing(*[torch.ones(192, 192, 3)] * 2)).numbers == {}


def test_a_file_in_the_format_of_basicsr_is_read_and_recorded(tmp_path, pristine):
    other = tmp_path / "niqe_pris_params.npz"
    values = (pristine.mean[None] + 1, pristine.covariance, pristine.window)
    np.savez(other, **dict(zip(natural.KEYS, values, strict=True)))
    one, two = (
        metric(parameters=file).measure(showing(*[picture("coffee as it is")] * 2))
        for file in (None, str(other))
    )
    assert two.details["niqe"]["model"] == str(other)
    assert two.details["niqe"]["weights_sha256"] == hashlib.sha256(other.read_bytes()).hexdigest()
    assert two.numbers["niqe"] > one.numbers["niqe"]


MEAN, COVARIANCE, WINDOW = np.zeros(36), np.eye(36), np.full((7, 7), 1 / 49)


@pytest.mark.parametrize(
    "entries",
    [
        (MEAN,),
        (MEAN[:35], COVARIANCE, WINDOW),
        (MEAN, COVARIANCE * np.nan, WINDOW),
        (np.array([{}] * 36), COVARIANCE, WINDOW),
    ],
)
def test_files_without_the_right_entries_are_refused(tmp_path, entries):
    file = tmp_path / "other.npz"
    np.savez(file, **dict(zip(natural.KEYS, entries, strict=False)))
    with pytest.raises(UserError, match=r"metric\.niqe\.parameters: expected a file"):
        metric(parameters=str(file)).scorer(torch.device("cpu"))


def test_small_views_are_refused():
    with pytest.raises(UserError, match=r"protocol\.size: expected a whole number >= 192"):
        metric(size=128).scorer(torch.device("cpu"))
