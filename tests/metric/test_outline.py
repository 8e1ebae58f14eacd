"""Outline: known overlaps of discs, known distances of colours, and the right mode."""

import pytest
import torch
from protocols import output
from splats import make_gaussians

from cadam3d.core.rendering import Truth
from cadam3d.metric.base import Measurand
from cadam3d.metric.outline import Outline

SETTINGS = {
    "views": 2,
    "elevations_deg": [0.0, 30.0],
    "distance": 3.0,
    "fov_y_deg": 40.0,
    "size": 64,
    "background": [1.0, 1.0, 1.0],
}
RED, GREY, BLUE = (0.86, 0.12, 0.12), (0.5, 0.5, 0.5), (0.14, 0.3, 0.84)


def disc(cameras, radius):
    """Return the alpha "v h w" of a disc in the centre of every view, with a radius in pixels."""
    across = torch.arange(cameras.height) + 0.5 - cameras.height / 2
    inside = across[:, None] ** 2 + across**2 <= radius**2
    return inside.float().expand(len(cameras), -1, -1)


def painted(cameras, background, radius, colour):
    alpha = disc(cameras, radius)[..., None]
    return alpha * torch.tensor(colour) + (1 - alpha) * background[:, None, None]


def renders(radius, colour=RED):
    def render(cameras, background):
        return output(painted(cameras, background, radius, colour), disc(cameras, radius))

    return render


def truth_of(*discs):
    return Truth(
        lambda cameras, background: torch.stack([painted(cameras, background, *each) for each in discs]),
        alpha=lambda cameras: torch.stack([disc(cameras, radius) for radius, _ in discs]),
    )


def measure(render, truth, **changes):
    return Outline(**{**SETTINGS, **changes}).measure(seen_as(render, truth)).numbers


def seen_as(render, truth):
    return Measurand(gaussians=make_gaussians(0), render=render, prompt="a disc", truth=truth)


def test_an_asset_that_is_the_truth_has_an_overlap_of_one_and_no_colour_error():
    assert measure(renders(20.0), truth_of((20.0, RED))) == {"iou": 1.0, "colour_error": 0.0}


def test_the_overlap_of_two_discs_is_the_ratio_of_their_areas():
    for ours, theirs in ((14.0, 20.0), (20.0, 14.0)):
        assert measure(renders(ours), truth_of((theirs, RED)))["iou"] == pytest.approx(0.49, abs=0.02)


@pytest.mark.parametrize(
    ("colour", "distance"),
    [
        # Distances of the CIE L*a*b* values of these sRGB colours, computed with the formulas of CIE 15:2004.
        (GREY, 84.7),
        ((0.6 * 0.86, 0.6 * 0.12, 0.6 * 0.12), 34.6),
        ((0.9 * 0.86, 0.9 * 0.12, 0.9 * 0.12), 8.3),
    ],
)
def test_a_wrong_colour_has_its_distance_in_lab(colour, distance):
    measured = measure(renders(20.0, colour), truth_of((20.0, RED)))
    assert measured["colour_error"] == pytest.approx(distance, abs=0.2)
    assert measured["iou"] == 1.0


def test_only_colours_inside_both_outlines_count():
    for size in (8.0, 25.0):
        assert measure(renders(size), truth_of((16.0, RED)))["colour_error"] == pytest.approx(0.0, abs=1e-3)


def test_among_modes_of_one_shape_the_nearest_colour_counts():
    modes = [(20.0, GREY), (20.0, RED), (20.0, BLUE)]
    assert measure(renders(20.0, BLUE), truth_of(*modes)) == {"iou": 1.0, "colour_error": 0.0}


def test_among_modes_of_several_shapes_the_largest_overlap_counts():
    measured = measure(renders(20.0), truth_of((10.0, RED), (20.0, BLUE)))
    assert measured["iou"] == 1.0
    assert measured["colour_error"] > 50


def test_an_asset_that_shows_nothing_has_no_overlap_and_no_colour():
    assert measure(renders(0.0), truth_of((20.0, RED))) == {"iou": 0.0}


def test_the_start_has_an_overlap_of_its_own():
    outline = Outline(**SETTINGS)
    start = outline.measure_start(seen_as(renders(14.0), truth_of((20.0, RED))))
    assert start == {"iou_start": measure(renders(14.0), truth_of((20.0, RED)))["iou"]}


def test_without_true_outlines_there_are_no_numbers():
    def never(cameras, background):
        raise AssertionError("rendered although there are no true outlines")

    assert measure(never, None) == {}
    assert measure(never, Truth(never)) == {}
