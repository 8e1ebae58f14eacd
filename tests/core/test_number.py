"""Numbers have labels and directions, and what is declared about them survives a file."""

import pytest
from declarations import all_numbers, declared

from cadam3d.io import records

NUMBERS = all_numbers()


def test_a_label_names_the_unit_and_a_value_is_written_with_it():
    assert NUMBERS["psnr"].heading == "PSNR (dB)"
    assert NUMBERS["psnr"].written(23.4149) == "23.41 dB"
    assert NUMBERS["num_gaussians"].written(12345.0) == "12,345"
    assert NUMBERS["iou"].fact == "Overlap of the outlines (IoU)"
    assert NUMBERS["median_scale"].fact == "Median scale (world units)"


@pytest.mark.parametrize(
    ("name", "better", "worse"), [("psnr", 30.0, 20.0), ("niqe", 4.0, 9.0), ("image_reward", 0.1, -1.0)]
)
def test_the_merit_of_a_better_value_is_larger(name, better, worse):
    assert NUMBERS[name].merit(better) > NUMBERS[name].merit(worse)


def test_a_declaration_in_a_file_is_the_one_of_the_metric():
    assert records.declared(declared(dict.fromkeys(NUMBERS, 1.0))) == NUMBERS


@pytest.mark.parametrize(
    "wrong",
    [
        {"label": 3},
        {"label": "two\nlines"},
        {"digits": -1},
        {"digits": 10**9},
        {"is_more_better": "maybe"},
        {"preference": "first"},
    ],
)
def test_a_declaration_of_another_form_is_left_out(wrong):
    entry = {"label": "mine", "digits": 2, "is_more_better": True}
    assert "mine" in records.declared({"numbers": {"mine": entry}})
    for entries in ({"mine": entry | wrong}, {"mine": list(entry)}, [entry], "mine"):
        assert list(records.declared({"numbers": entries})) == ["num_gaussians"]
