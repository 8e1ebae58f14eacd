"""The snapshots in the page of a run."""

import base64
import json
import re

import pytest
from splats import make_gaussians

from cadam3d.io.ply import write_ply
from cadam3d.io.run_folder import SNAPSHOTS, snapshot_name
from cadam3d.report import run_page, write_report


def record(folder, *steps, size=100):
    for step in steps:
        path = folder / SNAPSHOTS / snapshot_name(step)
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(bytes([step % 251]) * size)


def asset(folder):
    write_ply(folder / "asset.ply", make_gaussians(5), up="-y", pad_sh=0)


def test_all_snapshots_are_shown_in_order_and_the_last_is_the_finished_object(tmp_path):
    record(tmp_path, 200, 0, 100)
    found = run_page.frames(tmp_path, 200)
    assert [step for step, _ in found] == [0, 100, 200]
    assert base64.b64decode(found[1][1]) == bytes([100]) * 100


def test_an_interrupted_run_ends_with_its_asset(tmp_path):
    record(tmp_path, 0, 50)
    asset(tmp_path)
    assert [step for step, _ in run_page.frames(tmp_path, 70)] == [0, 50, 70]


@pytest.mark.parametrize(
    ("room", "steps"), [(5, [0, 1, 2, 3, 4]), (4, [0, 2, 4]), (2, [1, 4]), (1, [4]), (0, [])]
)
def test_snapshots_are_left_out_evenly_until_they_fit_and_the_last_one_stays(
    tmp_path, monkeypatch, room, steps
):
    record(tmp_path, 0, 1, 2, 3, 4)
    monkeypatch.setattr(run_page, "LARGEST", 100 * room)
    assert [step for step, _ in run_page.frames(tmp_path, 4)] == steps


def test_a_run_without_anything_to_show_has_a_page_without_a_program(tmp_path):
    (tmp_path / "asset.ply").write_text("nonsense")
    (tmp_path / "summary.json").write_text('{"steps": 3}')
    page = write_report(tmp_path)
    assert "<script" not in page.read_text(encoding="utf-8")


def test_the_page_contains_the_snapshots_and_a_slider_over_them(tmp_path):
    record(tmp_path, 0, 50, 100)
    summary = {"prompt": '"><script>alert(1)</script>', "steps": 100}
    (tmp_path / "summary.json").write_text(json.dumps(summary))
    text = write_report(tmp_path).read_text(encoding="utf-8")
    assert re.findall(r'class="snapshot" data-step="(\d+)"', text) == ["0", "50", "100"]
    assert 'max="2" value="2"' in text
    assert "class SplatView" in text
    assert "<script>alert" not in text
