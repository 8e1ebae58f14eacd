"""Captions are below their pictures, stay in their columns, and have the colours of the reports."""

import numpy as np
import pytest

from cadam3d.io.caption import Caption, plain, side_by_side

PICTURES = [np.full((40, 96, 3), shade, dtype=np.uint8) for shade in (50, 150)]


def ink(sheet, paper=255):
    return np.abs(sheet.astype(int) - paper).max(axis=2) > 60


def test_each_picture_is_unchanged_and_has_its_own_text_below_it():
    sheet = side_by_side(PICTURES, [Caption("cadam", "3,508 Gaussians"), Caption("", "")])
    width = (sheet.shape[1] - 2 * 96) + 96
    assert np.array_equal(sheet[:40, :96], PICTURES[0])
    assert np.array_equal(sheet[:40, width:], PICTURES[1])
    below = ink(sheet[40:])
    assert below[:, :96].any()
    assert not below[:, 96:].any()


def test_without_captions_nothing_is_added():
    assert np.array_equal(side_by_side(PICTURES, []), np.concatenate(PICTURES, axis=1))


@pytest.mark.parametrize(
    "text", ["w" * 500, "<script>&amp;", "a\nb\tc\x1b[2J", "\udcff", "\u96ea \u2603", "{x}%s"]
)
def test_a_text_of_any_kind_stays_below_its_own_picture(text):
    sheet = side_by_side(PICTURES, [Caption(text, text), Caption("", "")])
    assert sheet.shape == side_by_side(PICTURES, [Caption("a", "b"), Caption("", "")]).shape
    assert not ink(sheet[40:])[:, 96:].any()
    assert "\n" not in plain(text)
