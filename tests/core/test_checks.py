"""Messages for users: which key, what was expected, what came, what to type."""

import math

import pytest

from cadam3d.core.checks import fail, require_choice, require_color, require_range
from cadam3d.core.errors import UserError


def test_a_message_has_key_expected_got_and_what_to_type():
    message = str(fail("densifier.tau_Q", expected="a number >= 0", got=-1))
    assert message == "densifier.tau_Q: expected a number >= 0, got -1."


@pytest.mark.parametrize("value", [-1e-9, 1, 1.0, math.nan, math.inf, -math.inf, None, "0.5", True, [0.5]])
def test_numbers_out_of_range_and_other_values_are_refused(value):
    with pytest.raises(UserError, match=r"key: expected a number >= 0 and < 1, got .*\.$"):
        require_range("key", value, low=0, below=1)


def test_bounds_are_closed_or_open_as_declared():
    require_range("key", 3, low=3, high=3)
    with pytest.raises(UserError, match="> 3"):
        require_range("key", 3, above=3)
    with pytest.raises(UserError, match="< 3"):
        require_range("key", 3, below=3)


@pytest.mark.parametrize(
    ("value", "is_fine"), [(-1e30, True), (0, True), (math.inf, False), (math.nan, False)]
)
def test_without_bounds_any_finite_number_passes(value, is_fine):
    if is_fine:
        require_range("key", value)
    else:
        with pytest.raises(UserError, match="a finite number"):
            require_range("key", value)


@pytest.mark.parametrize(
    ("value", "choices"),
    [(0, (True, False)), (True, range(4)), (1.0, range(4)), ([], range(4)), (None, "ab")],
)
def test_a_value_equal_to_a_choice_but_of_another_type_is_refused(value, choices):
    with pytest.raises(UserError, match="key: expected one of"):
        require_choice("key", value, choices)


def test_a_colour_is_three_numbers_between_zero_and_one():
    require_color("background.color", [0, 0.5, 1.0])
    for wrong in (
        [0.0, 0.5],
        [0.0, 0.5, 1.01],
        [-0.1, 0.0, 0.0],
        [math.nan, 0.0, 0.0],
        1,
        None,
        "abc",
        [True] * 3,
    ):
        with pytest.raises(UserError, match=r"background\.color: expected three numbers in \[0, 1\]"):
            require_color("background.color", wrong)
