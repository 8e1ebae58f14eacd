"""Where the true object of a run comes from: the prior, the embedded world, or nowhere."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from composed import composed

from cadam3d.build import component
from cadam3d.core.cameras import Cameras, turntable
from cadam3d.core.errors import UserError
from cadam3d.core.rendering import Truth
from cadam3d.prior.truth import NoTruth, PriorTruth, ShapesTruth

PROMPT = "a mug"


def views(count: int = 3, size: int = 24) -> Cameras:
    return turntable(count, elevation_deg=20.0, distance=3.0, fov_y_deg=40.0, size=size)


def shapes(prompt: str = PROMPT, **changes) -> Truth:
    source = ShapesTruth(**{"samples_per_pixel": 2, "turns": 24, "tracer": "auto", **changes})
    return source.of(prompt, component(composed("prior=tiny").prior))


def test_the_truth_of_the_prior_is_that_of_the_prior():
    prior = component(composed("prior=shapes").prior)
    own, found = prior.truth(PROMPT), PriorTruth().of(PROMPT, prior)
    background = torch.ones(3, 3)
    assert found is not None
    assert torch.equal(found.images(views(), background), own.images(views(), background))
    assert found.turns is None
    assert PriorTruth().of(PROMPT, component(composed("prior=tiny").prior)) is None
    assert NoTruth().of(PROMPT, prior) is None


def test_the_embedded_world_has_the_images_and_the_shape_of_its_own_prior():
    own, found = component(composed("prior=shapes").prior).truth("a sphere"), shapes("a sphere")
    background = torch.tensor([[0.2, 0.5, 0.8]]).expand(3, 3)
    assert torch.equal(found.images(views(), background), own.images(views(), background))
    assert found.surfaces is not None
    [(vertices, _)], [(expected, _)] = found.surfaces(), own.surfaces()
    np.testing.assert_array_equal(vertices, expected)


def test_the_outline_is_what_two_backgrounds_show():
    truth = shapes("a sphere")
    assert truth.alpha is not None
    black, white = (truth.images(views(), torch.full((3, 3), level)) for level in (0.0, 1.0))
    alpha = truth.alpha(views())
    assert alpha.shape == black.shape[:-1]
    torch.testing.assert_close(alpha, 1 - (white - black)[..., 1])


@pytest.mark.parametrize("turn_deg", [120.0, -120.0])
def test_a_turned_object_shows_its_views_from_other_sides(turn_deg):
    """With three views, a turn by 120 degrees moves every image to the next view."""
    truth, background = shapes(), torch.ones(3, 3)
    turned = replace(truth, turn_deg=turn_deg).turned()
    assert truth.alpha is not None
    assert turned.alpha is not None
    shift = 1 if turn_deg > 0 else -1
    # A ray along an edge may hit on either side of it, so a few pixels differ.
    for now, before in (
        (turned.images(views(), background), truth.images(views(), background).roll(shift, dims=1)),
        (turned.alpha(views()), truth.alpha(views()).roll(shift, dims=1)),
    ):
        assert float((now - before).abs().mean()) < 1e-3
    other = replace(truth, turn_deg=-turn_deg).turned().images(views(), background)
    assert float((turned.images(views(), background) - other).abs().mean()) > 0.01


@pytest.mark.parametrize("prompt", ["a corgi wearing a beret", "a cube on", "", "a\nred\ncorgi Try: this"])
def test_a_prompt_of_another_world_is_refused_in_one_line(prompt):
    with pytest.raises(UserError, match=r"^truth: expected .* Try: truth=prior$"):
        shapes(prompt)
