"""Numbers, durations and sizes are written in a readable form."""

import math

import pytest

from cadam3d.report.formatting import elapsed, number, short, show


@pytest.mark.parametrize(
    ("value", "text"),
    [(0, "0"), (1e-17, "0"), (12300, "12.3k"), (-50, "-50"), (2e6, "2M"), (0.25, "0.25")],
)
def test_numbers_on_axes_are_short(value, text):
    assert short(value) == text


@pytest.mark.parametrize(
    ("value", "text"),
    [
        *((None, "-"), ("", "-"), (math.nan, "-"), ([], "-"), (True, "yes"), (9999, "9999")),
        *((10_000, "10,000"), (3.0, "3"), (0.123456, "0.1235"), ([1, "b"], "1, b")),
    ],
)
def test_any_value_has_a_text(value, text):
    assert show(value) == text


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(1.54, "1.5 s"), (59.9, "59.9 s"), (75, "0:01:15"), (7260, "2:01:00")],
)
def test_durations_have_suitable_units(seconds, text):
    assert elapsed(seconds) == text


@pytest.mark.parametrize("value", [True, None, "3", math.inf, math.nan])
def test_a_number_is_finite_and_not_a_boolean(value):
    assert number(value) is None
