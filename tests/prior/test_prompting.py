"""Prompting: the text of each view around the angles where it changes, and the arithmetic of guidance."""

import math

import pytest
import torch

from cadam3d.core.cameras import orbit
from cadam3d.prior.prompting import (
    BACK,
    FRONT,
    HEIGHTS,
    OVERHEAD,
    SIDE,
    SIDES,
    Compass,
    Discrete,
    Interpolated,
    PerpNeg,
    Plain,
    guide,
)

DISCRETE = Discrete(front_deg=45, back_deg=45, overhead_deg=60)
LUCID = PerpNeg(curve="lucid", overhead_deg=None)
THREESTUDIO = PerpNeg(curve="threestudio", overhead_deg=60)
EVERY = [Plain(), DISCRETE, Interpolated(), LUCID, THREESTUDIO]


def views(azimuth, elevation=0.0):
    azimuth = torch.as_tensor(azimuth, dtype=torch.float32).reshape(-1)
    ones = torch.ones_like(azimuth)
    return orbit(azimuth, ones * elevation, ones * 3, ones * 45, 8, 8)


@pytest.mark.parametrize("prompting", EVERY, ids=lambda each: type(each).__name__)
def test_weights_are_valid_and_the_same_on_both_sides(prompting):
    mix = prompting.mix(views(torch.linspace(-180, 180, 73), elevation=30))
    k = len(prompting.texts("a corgi"))
    for rows in (mix.positive, mix.repelled):
        assert rows.shape[-1] == k
        torch.testing.assert_close(rows.sum(dim=-1), torch.ones(rows.shape[:-1]))
        assert (rows >= 0).all()
    assert mix.repelled.shape[1] == mix.strengths.shape[1]
    assert (mix.strengths <= 1e-3).all()
    mirrored = prompting.mix(views(torch.linspace(180, -180, 73), elevation=30))
    torch.testing.assert_close(mix.positive, mirrored.positive)  # left and right are alike
    torch.testing.assert_close(mix.strengths, mirrored.strengths)
    assert all(text.startswith("a corgi") for text in prompting.texts("a corgi"))


@pytest.mark.parametrize(
    ("azimuth", "elevation", "text"),
    [
        (0, 0, FRONT),
        (-44.9, 0, FRONT),
        (45, 0, SIDE),
        (-90, 0, SIDE),
        (135, 0, SIDE),
        (135.1, 0, BACK),
        (-180, 0, BACK),
        (0, 60, FRONT),
        (0, 60.1, OVERHEAD),
        (180, 80, OVERHEAD),
    ],
)
def test_discrete_rules_with_precedence_for_overhead(azimuth, elevation, text):
    assert DISCRETE.mix(views(azimuth, elevation)).positive.argmax() == text


COMPASS = Compass(below_deg=-5, above_deg=35)


def named(azimuth, elevation=0.0):
    """Return the text of each view under ``COMPASS``."""
    rows = COMPASS.mix(views(azimuth, elevation)).positive
    assert ((rows == 0) | (rows == 1)).all()
    assert (rows.sum(dim=1) == 1).all()
    return [COMPASS.texts("a corgi")[i] for i in rows.argmax(dim=1)]


def test_the_compass_has_a_text_for_every_side_at_every_height():
    texts = COMPASS.texts("a corgi")
    assert len(set(texts)) == len(texts) == len(SIDES) * len(HEIGHTS) == 24
    azimuth = torch.arange(-180.0, 180.0, 45.0)
    assert {text for elevation in (-10, 0, 50) for text in named(azimuth, elevation)} == set(texts)


@pytest.mark.parametrize(
    ("azimuth", "elevation", "words"),
    [
        (0, 0, "front view"),
        (22.4, 0, "front view"),
        (22.6, 0, "front right view"),
        (90, 0, "right view"),
        (-90, 0, "left view"),
        (180, 0, "back view"),
        (-157.6, 0, "back view"),
        (-135, 0, "back left view"),
        (0, -5, "front view"),
        (0, -5.1, "front view from below"),
        (0, 35, "front view"),
        (90, 35.1, "right view from above"),
        (0, 89, "front view from above"),
    ],
)
def test_the_compass_names_the_nearest_side_and_the_height(azimuth, elevation, words):
    assert named(azimuth, elevation) == [f"a corgi, {words}"]


def test_the_right_side_is_at_plus_y():
    """In the picture of a camera at the front, the point +y is to the right of the origin."""
    front = views(0)
    to_camera = front.world_to_camera[0, :3, :3]
    assert (to_camera @ torch.tensor([0.0, 1.0, 0.0]))[0] > 0.99
    assert views(90).positions[0, 1] > 2.9
    assert named(90) == ["a corgi, right view"]


@pytest.mark.parametrize(
    ("azimuth", "weights"),
    [(0, [1, 0, 0]), (30, [2 / 3, 1 / 3, 0]), (-90, [0, 1, 0]), (135, [0, 0.5, 0.5]), (180, [0, 0, 1])],
)
def test_interpolation_is_linear_in_azimuth(azimuth, weights):
    torch.testing.assert_close(Interpolated().mix(views(azimuth)).positive, torch.tensor([weights]).float())


@pytest.mark.parametrize(
    ("azimuth", "names", "strengths"),
    [
        (0, (FRONT, SIDE), (0, -2)),
        (9, (FRONT, SIDE), (0, -2 * math.exp(-1))),
        (45, (FRONT, SIDE), (-2 * math.exp(-1), -2 * math.exp(-5))),
        (81, (FRONT, SIDE), (-2 * math.exp(-0.2), 0)),
        (90, (SIDE, FRONT), (0, -2)),
        (135, (SIDE, FRONT), (-math.exp(-5), -2)),
        (180, (SIDE, FRONT), (-1, -2)),
    ],
)
def test_the_curves_of_lucid_dreamer(azimuth, names, strengths):
    mix = LUCID.mix(views(azimuth))
    assert tuple(mix.repelled[0].argmax(dim=-1).tolist()) == names
    torch.testing.assert_close(mix.strengths[0], torch.tensor(strengths).float())


@pytest.mark.parametrize(
    ("azimuth", "strengths"),
    [
        (0, (-(4 * math.exp(-0.5) - 2.426), -(4 - 2.426))),
        (45, (-(4 * math.exp(-0.25) - 2.426), -(4 * math.exp(-0.25) - 2.426))),
        (90, (-(math.exp(-0.5) - 0.606), -(math.exp(-0.5) + 0.967))),
        (180, (-(1 - 0.606), -(1 + 0.967))),
    ],
)
def test_the_curves_of_threestudio(azimuth, strengths):
    torch.testing.assert_close(THREESTUDIO.mix(views(azimuth)).strengths[0], torch.tensor(strengths))


def test_nothing_is_repelled_from_overhead_views():
    mix = THREESTUDIO.mix(views([0, 120], elevation=70))
    assert (mix.positive.argmax(dim=-1) == OVERHEAD).all()
    assert (mix.strengths == 0).all()


def random(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_without_repulsion_guidance_has_the_conventional_form():
    negative, positive = random(2, 3, 4, 4), random(2, 3, 4, 4, seed=1)
    guided = guide(negative, positive, [], negative.new_zeros(2, 0), 7.5)
    torch.testing.assert_close(guided, negative + 7.5 * (positive - negative))


def test_repulsion_acts_across_the_prompt_only():
    negative, positive = random(2, 3, 4, 4), random(2, 3, 4, 4, seed=1)
    others, strengths = random(2, 2, 3, 4, 4, seed=2), -random(2, 2, seed=3).abs()
    guided = guide(negative, positive, list(others), strengths, 1.0)
    direction = (positive - negative).flatten(1)
    extra = (guided - positive).flatten(1)
    torch.testing.assert_close((extra * direction).sum(dim=1), torch.zeros(2).double(), atol=1e-10, rtol=0)
    # Compute the same with projection matrices, one view at a time.
    for view in range(2):
        d = direction[view]
        across = torch.eye(len(d)).double() - torch.outer(d, d) / d.square().sum()
        wanted = sum(strengths[view, i] * across @ (others[i] - negative)[view].flatten() for i in range(2))
        torch.testing.assert_close(extra[view], wanted)
