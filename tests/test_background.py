"""Laws of the backgrounds."""

import pytest
import torch

from cadam3d.background import BlackOrWhite, LucidBackground, RandomBackground


def draw(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize("probability", [0.0, 0.3, 1.0])
def test_a_random_background_is_random_with_its_probability(probability):
    constant = torch.tensor([2.0**-20, 0.5, 1.0])
    colors = RandomBackground(probability=probability, color=constant.tolist(), shared=False).sample(
        20_000, draw()
    )
    is_random = (colors != constant).any(dim=-1)
    assert float(is_random.float().mean()) == pytest.approx(probability, abs=0.01)
    assert colors.min() >= 0
    assert colors.max() <= 1
    if probability > 0:
        drawn = colors[is_random]
        torch.testing.assert_close(drawn.mean(dim=0), torch.full((3,), 1 / 2), atol=0.02, rtol=0)
        torch.testing.assert_close(drawn.var(dim=0), torch.full((3,), 1 / 12), atol=0.005, rtol=0)


@pytest.mark.parametrize(("probability", "black"), [(0.66, 0.5), (0.3, 0.2), (1.0, 0.0), (0.0, 0.5)])
def test_a_lucid_background_is_random_black_or_constant_with_its_probabilities(probability, black):
    constant = torch.tensor([2.0**-20, 0.5, 1.0])
    background = LucidBackground(probability=probability, black=black, color=constant.tolist())
    colors = background.sample(20_000, draw())
    is_black, is_constant = (colors == 0).all(dim=-1), (colors == constant).all(dim=-1)
    is_random = ~(is_black | is_constant)
    shares = [float(rows.float().mean()) for rows in (is_black, is_random, is_constant)]
    wanted = [probability * black, probability * (1 - black), 1 - probability]
    assert shares == pytest.approx(wanted, abs=0.01)
    assert ((colors >= 0) & (colors <= 1)).all()
    if wanted[1] > 0:
        drawn = colors[is_random]
        torch.testing.assert_close(drawn.mean(dim=0), torch.full((3,), 1 / 2), atol=0.02, rtol=0)
        torch.testing.assert_close(drawn.var(dim=0), torch.full((3,), 1 / 12), atol=0.005, rtol=0)


@pytest.mark.parametrize("white", [0.0, 0.5, 0.8, 1.0])
def test_black_or_white_gives_only_these_two_and_white_with_its_probability(white):
    colors = BlackOrWhite(white=white).sample(20_000, draw())
    assert set(colors.unique().tolist()) <= {0.0, 1.0}
    assert (colors == colors[:, :1]).all()
    assert float(colors.mean()) == pytest.approx(white, abs=0.01)


def after(background) -> torch.Tensor:
    """The state of the generator once four views are drawn."""
    generator = draw()
    background.sample(4, generator)
    return generator.get_state()


def test_later_draws_do_not_depend_on_the_probabilities():
    black = [0.0, 0.0, 0.0]
    for family in (
        [RandomBackground(probability=p, color=black, shared=False) for p in (0.0, 0.5, 1.0)],
        [LucidBackground(probability=p, black=b, color=black) for p in (0.0, 1.0) for b in (0.0, 1.0)],
        [BlackOrWhite(white=p) for p in (0.0, 1.0)],
    ):
        first, *others = [after(background) for background in family]
        assert all(torch.equal(first, other) for other in others)


def test_a_shared_background_has_one_colour_per_step():
    shared = RandomBackground(probability=0.5, color=[1.0, 1.0, 1.0], shared=True)
    steps = [shared.sample(4, torch.Generator().manual_seed(seed)) for seed in range(200)]
    assert all(torch.equal(step, step[:1].expand(4, 3)) for step in steps)
    first = torch.stack([step[0] for step in steps])
    is_white = (first == 1).all(dim=1)
    assert 60 < is_white.sum() < 140
    assert first[~is_white].std(dim=0).min() > 0.2
