"""The files through which a run that trains and its pages exchange data."""

import json
import os
import time
from pathlib import Path

import pytest

from cadam3d.io import live

STATE = {
    **{"step": 3, "total_steps": 9, "num_gaussians": 5, "seconds": 0.5, "loss": None},
    **{"is_paused": False, "has_ended": False, "statistics": {"snr_p50": 0.1}},
}


def test_a_request_is_seen_until_it_is_taken_or_withdrawn(tmp_path):
    live.begin(tmp_path)
    assert not live.is_asked(tmp_path, "save")
    assert live.ask(tmp_path, "save")
    assert live.ask(tmp_path, "save")  # by another page
    assert live.take_request(tmp_path, "save")
    assert not live.take_request(tmp_path, "save")
    live.ask(tmp_path, "pause")
    assert live.withdraw(tmp_path, "pause")
    assert live.withdraw(tmp_path, "pause")
    assert not live.is_asked(tmp_path, "pause")


def test_without_the_folder_of_a_run_that_trains_nothing_is_written(tmp_path):
    live.touch_watched(tmp_path)
    assert not live.ask(tmp_path, "stop")
    assert not live.withdraw(tmp_path, "pause")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kind", ["folder", "link", "pipe"])
def test_only_a_plain_file_is_a_request(tmp_path, kind):
    live.begin(tmp_path)
    (tmp_path / "elsewhere").write_text("precious")
    make = {"folder": Path.mkdir, "link": lambda path: path.symlink_to("../elsewhere"), "pipe": os.mkfifo}
    make[kind](tmp_path / "live/stop")
    assert not live.is_asked(tmp_path, "stop")
    assert not live.take_request(tmp_path, "stop")
    assert not live.ask(tmp_path, "stop")
    assert (tmp_path / "elsewhere").read_text() == "precious"


def test_a_link_in_place_of_the_folder_is_not_followed(tmp_path):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere/pause").write_text("precious")
    (tmp_path / "live").symlink_to("elsewhere")
    live.touch_watched(tmp_path)
    assert not live.ask(tmp_path, "stop")
    assert not live.withdraw(tmp_path, "pause")
    live.clear(tmp_path)
    assert [path.name for path in (tmp_path / "elsewhere").iterdir()] == ["pause"]


def test_clearing_removes_its_own_files_and_no_others(tmp_path):
    live.begin(tmp_path)
    for request in live.REQUESTS:
        live.ask(tmp_path, request)
    live.publish_state(tmp_path, STATE)
    (tmp_path / "live/notes.txt").write_text("mine")
    live.clear(tmp_path)
    assert [path.name for path in (tmp_path / "live").iterdir()] == ["notes.txt"]
    (tmp_path / "live/notes.txt").unlink()
    live.clear(tmp_path)
    assert not (tmp_path / "live").exists()


def test_a_page_counts_for_a_few_seconds_after_each_touch_whatever_its_clock_says(tmp_path, monkeypatch):
    now = [0.0]
    monkeypatch.setattr(live.time, "monotonic", lambda: now[0])
    live.begin(tmp_path)
    watch = live.Watch(tmp_path)
    assert not watch.is_watched()
    live.touch_watched(tmp_path)
    os.utime(tmp_path / "live/watched", (0, 0))
    assert watch.is_watched()
    now[0] += live.WATCHED_SECONDS - 0.1
    assert watch.is_watched()
    now[0] += 0.2
    assert not watch.is_watched()
    os.utime(tmp_path / "live/watched", (1, 1))
    assert watch.is_watched()


def test_the_state_reads_back(tmp_path):
    live.begin(tmp_path)
    live.publish_state(tmp_path, STATE)
    assert live.read_state(tmp_path) == {**STATE, "process": live.process_name()}
    assert [path.name for path in (tmp_path / "live").iterdir()] == ["state.json"]


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"[]",
        b"{}",
        b"\xff",
        b"[" * 100_000,
        b" " * (live.LARGEST_STATE + 1),
        json.dumps({"process": "1 on x", **STATE, "step": "<b>"}).encode(),
        json.dumps({"process": "1 on x", **STATE, "statistics": {"a": "b"}}).encode(),
        json.dumps({"process": "1 on x", **STATE, "loss": 1e200}).encode(),
    ],
)
def test_a_damaged_state_is_no_state(tmp_path, content):
    live.begin(tmp_path)
    (tmp_path / "live/state.json").write_bytes(content)
    before = time.monotonic()
    assert live.read_state(tmp_path) is None
    assert time.monotonic() - before < 2
