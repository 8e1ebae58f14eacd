"""Laws of the prior's trajectory: number of steps, arrival and inversion."""

import pytest
import torch

from cadam3d.guidance.trajectory import ddim, strides
from cadam3d.prior.path import DDPM, per_view

SPREAD = 0.5


def levels(*values):
    return torch.tensor(values, dtype=torch.float64)


@pytest.mark.parametrize(
    ("s", "calls"), [(0.0, 0), (0.1, 1), (0.2, 1), (0.2001, 2), (0.6, 3), (0.93, 5), (1.0, 5)]
)
def test_the_number_of_inversion_steps_follows_from_the_stride(s, calls, gaussian, means):
    prior = gaussian(DDPM())
    ddim(means.positive, strides(levels(0, 0, 0), levels(s, s, s), 0.2), means, prior)
    assert len(prior.calls) == calls


def test_rounding_adds_no_step(gaussian, means):
    """In single precision 0.6 is a little more than three times 0.2."""
    prior, zero = gaussian(DDPM()), torch.zeros(3)
    ddim(means.positive.float(), strides(zero, torch.full((3,), 0.6), 0.2), means, prior)
    assert len(prior.calls) == 3


def test_inversion_and_sampling_undo_each_other(path, gaussian, means):
    prior, x0 = gaussian(path, spread=SPREAD), means.positive
    start, end = levels(0.0, 0.0, 0.0), levels(0.3, 0.6, 0.9)
    there = ddim(x0, strides(start, end, 0.005), means, prior)
    back = ddim(there, strides(end, start, 0.005), means, prior)
    assert (there - x0).abs().max() > 0.1
    torch.testing.assert_close(back, x0, rtol=0, atol=0.02)


def test_fine_inversion_follows_the_probability_flow(path, gaussian, means):
    """The exact trajectory keeps (x - a * mean) / sqrt(a^2 s^2 + b^2) constant."""
    prior = gaussian(path, spread=SPREAD)
    start, end = levels(0.01, 0.01, 0.01), levels(0.2, 0.5, 0.8)
    noisy = path.mix(means.empty, means.negative, start)

    def standardized(x, t):
        a, b = per_view(path.a(t)), per_view(path.b(t))
        return (x - a * means.positive) / (a**2 * SPREAD**2 + b**2).sqrt()

    errors = []
    for stride in (0.01, 0.005):
        there = ddim(noisy, strides(start, end, stride), means, prior)
        errors.append(float((standardized(there, end) - standardized(noisy, start)).abs().max()))
    assert errors[1] < 0.15
    assert errors[1] == pytest.approx(errors[0] / 2, rel=0.25)  # a first-order method


def test_a_view_that_has_arrived_does_not_change(path, gaussian, means):
    start, end = levels(0.0, 0.0, 0.0), levels(0.0, 0.2, 0.9)
    prior = gaussian(path, spread=SPREAD)
    together = ddim(means.empty, strides(start, end, 0.2), means, prior)
    assert torch.equal(together[0], means.empty[0])
    for view in range(3):
        one = slice(view, view + 1)
        own = type(means)(means.positive[one], means.negative[one], means.empty[one])
        alone = ddim(means.empty[one], strides(start[one], end[one], 0.2), own, prior)
        torch.testing.assert_close(together[one], alone)
