"""Schedules: pure functions of the step."""

import math

import pytest

from cadam3d.core.errors import UserError
from cadam3d.core.schedule import Linear, LogLinear, Steps, as_schedule
from cadam3d.densifier.random import RandomGrowth


@pytest.mark.parametrize("kind", [Linear, LogLinear])
def test_ramps_have_their_first_and_final_values_and_keep_the_final_one(kind):
    ramp = kind(start=1e-2, end=1e-4, steps=100, begin=20)
    assert [ramp(step) for step in (0, 20, 120, 10**6)] == pytest.approx([1e-2, 1e-2, 1e-4, 1e-4])
    values = [ramp(step) for step in range(20, 121)]
    assert values == sorted(values, reverse=True)


def test_halfway_is_the_mean_on_a_linear_and_the_geometric_mean_on_a_logarithmic_ramp():
    assert Linear(start=1, end=3, steps=10)(5) == pytest.approx(2)
    assert LogLinear(start=1e-2, end=1e-4, steps=10)(5) == pytest.approx(1e-3)


def test_steps_change_exactly_at_their_milestones():
    schedule = Steps(values=[0.98, 0.5, 0.1], milestones=[10, 20])
    assert [schedule(step) for step in (0, 9, 10, 19, 20, 99)] == [0.98, 0.98, 0.5, 0.5, 0.1, 0.1]


def test_a_number_is_a_constant_schedule_and_a_schedule_is_itself():
    assert as_schedule(3)(7) == 3.0
    ramp = Linear(start=0, end=1, steps=4)
    assert as_schedule(ramp) is ramp


@pytest.mark.parametrize(
    ("build", "key"),
    [
        (lambda: Linear(start=0, end=1, steps=0), r"\.steps"),
        (lambda: LogLinear(start=1, end=1, steps=0), r"\.steps"),
        (lambda: LogLinear(start=0, end=1, steps=5), r"\.start"),
        (lambda: LogLinear(start=1, end=-1, steps=5), r"\.end"),
        (lambda: Steps(values=[1, 2], milestones=[]), r"\.values"),
        (lambda: Steps(values=[1, 2, 3], milestones=[20, 10]), r"\.values"),
    ],
)
def test_impossible_schedules_name_the_key(build, key):
    with pytest.raises(UserError, match=key):
        build()


@pytest.mark.parametrize(
    "share", [-1, 2.0, True, math.nan, Linear(start=1, end=-1, steps=10), Linear(2, 1, 10)]
)
def test_numbers_and_schedules_that_start_or_end_outside_are_refused(share):
    with pytest.raises(UserError, match=r"^RandomGrowth\.share: expected a number >= 0 and < 1, got .*\.$"):
        RandomGrowth(share=share)
