"""Declared charts are read back as they were written, and a damaged file is not an error."""

import json

import pytest

from cadam3d.core.chart import Chart, Curve, Level
from cadam3d.io.declarations import read_declarations, write_declarations

CHARTS = (
    Chart(
        title="A title",
        caption="A caption.",
        curves=(Curve(key="a", label="median"), Curve(key="b", is_threshold=True)),
        band=("low", "high"),
        band_label="10 to 90 %",
        log_y=True,
        score="a",
        levels=(Level(label="b", value=0.5),),
    ),
    Chart(title="Shares", caption="", curves=(Curve(key="c"),), percent=True),
)


def test_charts_are_read_back_as_they_were_written(tmp_path):
    write_declarations(tmp_path, CHARTS)
    assert read_declarations(tmp_path) == CHARTS


def test_a_missing_file_declares_nothing(tmp_path):
    assert read_declarations(tmp_path) == ()


@pytest.mark.parametrize(
    "content", ["", "{", "null", "3", '{"title": 1}', "\udcff", "[1, null, [], {}]", '[{"title": "a"}]']
)
def test_a_damaged_file_declares_nothing(tmp_path, content):
    (tmp_path / "charts.json").write_bytes(content.encode(errors="surrogateescape"))
    assert read_declarations(tmp_path) == ()


def test_a_score_that_names_another_file_is_left_out(tmp_path):
    write_declarations(tmp_path, CHARTS)
    content = json.loads((tmp_path / "charts.json").read_text(encoding="utf-8"))
    content[0]["score"] = "../up"
    (tmp_path / "charts.json").write_text(json.dumps(content), encoding="utf-8")
    assert read_declarations(tmp_path) == CHARTS[1:]
