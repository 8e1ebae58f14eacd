"""Laws of the backgrounds."""

import pytest
import torch

from cadam3d.background import ConstantBackground, RandomBackground
from cadam3d.core.checks import UserError


def draw(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_a_constant_background_is_its_color_for_every_view():
    colors = ConstantBackground(color=[0.25, 0.5, 1.0]).sample(3, draw())
    assert colors.tolist() == [[0.25, 0.5, 1.0]] * 3


def test_a_constant_background_draws_nothing():
    generator = draw()
    before = generator.get_state()
    ConstantBackground(color=[0.0, 0.0, 0.0]).sample(3, generator)
    assert torch.equal(generator.get_state(), before)


@pytest.mark.parametrize("probability", [0.0, 0.3, 1.0])
def test_a_random_background_is_random_with_its_probability(probability):
    constant = torch.tensor([2.0**-20, 0.5, 1.0])
    colors = RandomBackground(probability=probability, color=constant.tolist()).sample(20_000, draw())
    is_random = (colors != constant).any(dim=-1)
    assert float(is_random.float().mean()) == pytest.approx(probability, abs=0.01)
    assert colors.min() >= 0
    assert colors.max() <= 1
    if probability > 0:
        drawn = colors[is_random]
        torch.testing.assert_close(drawn.mean(dim=0), torch.full((3,), 1 / 2), atol=0.02, rtol=0)
        torch.testing.assert_close(drawn.var(dim=0), torch.full((3,), 1 / 12), atol=0.005, rtol=0)


def test_views_are_drawn_apart():
    colors = RandomBackground(probability=1.0, color=[0.0, 0.0, 0.0]).sample(5, draw())
    assert len(colors.unique(dim=0)) == 5


def test_the_generator_decides():
    background = RandomBackground(probability=0.5, color=[0.0, 0.0, 0.0])
    assert torch.equal(background.sample(9, draw(1)), background.sample(9, draw(1)))
    assert not torch.equal(background.sample(9, draw(1)), background.sample(9, draw(2)))


def test_what_is_drawn_later_does_not_depend_on_the_probability():
    rest = []
    for probability in (0.0, 0.5, 1.0):
        generator = draw()
        RandomBackground(probability=probability, color=[0.0, 0.0, 0.0]).sample(4, generator)
        rest.append(generator.get_state())
    assert torch.equal(rest[0], rest[1])
    assert torch.equal(rest[1], rest[2])


@pytest.mark.parametrize("color", [[0.0, 0.0], [0.0, 0.0, 1.5], [-0.1, 0.0, 0.0], [float("nan"), 0.0, 0.0]])
def test_what_is_no_color_is_refused(color):
    with pytest.raises(UserError, match=r"background\.color: wanted three numbers"):
        ConstantBackground(color=color)
    with pytest.raises(UserError, match=r"background\.color: wanted three numbers"):
        RandomBackground(probability=0.5, color=color)


@pytest.mark.parametrize("probability", [-0.1, 1.1])
def test_an_impossible_probability_is_refused(probability):
    with pytest.raises(UserError, match=r"background\.probability"):
        RandomBackground(probability=probability, color=[0.0, 0.0, 0.0])
