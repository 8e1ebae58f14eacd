"""The object of these tests shows every mistake that a file or a program could make."""

from dataclasses import replace

import pytest
import torch
from programs.files import VIEW
from programs.render_elsewhere import ours, psnr, turned
from programs.snowman import snowman_and_pine

from cadam3d.core.gaussians import Gaussians


def with_rest(gaussians: Gaussians, change) -> Gaussians:
    rest = change(gaussians.sh[:, 1:])
    return replace(gaussians, sh=torch.cat([gaussians.sh[:, :1], rest], dim=1))


def without_band(band: int):
    def change(rest):
        changed = rest.clone()
        changed[:, band**2 - 1 : (band + 1) ** 2 - 1] = 0
        return changed

    return change


def without_turning_colours(gaussians: Gaussians) -> Gaussians:
    return replace(turned(gaussians, "-y", "+y"), sh=gaussians.sh)


MISTAKES = {
    "upside down": lambda g: turned(g, "-y", "+y"),
    "lying": lambda g: turned(g, "+z", "+y"),
    "mirrored": lambda g: replace(g, means=g.means * torch.tensor([1.0, -1.0, 1.0])),
    "rotations inverted": lambda g: replace(g, quats=g.quats * torch.tensor([1.0, -1.0, -1.0, -1.0])),
    "rotations as xyzw": lambda g: replace(g, quats=g.quats.roll(-1, dims=1)),
    "scales permuted": lambda g: replace(g, log_scales=g.log_scales.roll(1, dims=1)),
    "opacities halved": lambda g: replace(g, opacity_logits=(g.opacities / 2).logit()),
    "no view dependence": lambda g: with_rest(g, torch.zeros_like),
    "no band 1": lambda g: with_rest(g, without_band(1)),
    "no band 2": lambda g: with_rest(g, without_band(2)),
    "no band 3": lambda g: with_rest(g, without_band(3)),
    "red and blue exchanged": lambda g: replace(g, sh=g.sh.flip(2)),
    "coefficients transposed": lambda g: with_rest(g, lambda r: r.mT.reshape(r.shape)),
    "seen from behind": lambda g: with_rest(g, torch.neg),
}


@pytest.fixture(scope="module")
def right():
    return ours(snowman_and_pine(3), VIEW)


@pytest.mark.parametrize("mistake", MISTAKES.values(), ids=MISTAKES)
def test_a_mistake_costs_more_than_a_program_may_differ(right, mistake):
    # 35 dB is the lowest floor of a program that renders as we do.
    assert psnr(ours(mistake(snowman_and_pine(3)), VIEW), right) < 33


def test_colours_that_are_not_turned_with_the_object_are_noticed():
    gaussians = snowman_and_pine(3)
    right, wrong = turned(gaussians, "-y", "+y"), without_turning_colours(gaussians)
    assert psnr(ours(wrong, VIEW), ours(right, VIEW)) < 33
