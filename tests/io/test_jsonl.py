"""Logs stay readable after a kill, and any reader accepts the JSON."""

import json
import math
from pathlib import Path

import pytest

from cadam3d.core.errors import UserError
from cadam3d.io.jsonl import append_jsonl, read_json, read_jsonl, truncate_after, write_json


def refuse_constant(name):
    raise AssertionError(f"{name} is not JSON")


def test_lines_are_read_in_the_order_in_which_they_were_written(tmp_path):
    lines = [
        {"step": step, "loss": 0.1 * step, "prompt": "ein Ü\nzwei", "nested": {"a": [1, None]}}
        for step in range(5)
    ]
    for line in lines:
        append_jsonl(tmp_path / "deep" / "metrics.jsonl", line)
    assert read_jsonl(tmp_path / "deep" / "metrics.jsonl") == lines
    assert len((tmp_path / "deep" / "metrics.jsonl").read_text().splitlines()) == 5


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_values_that_json_lacks_become_null(tmp_path, value):
    append_jsonl(tmp_path / "m.jsonl", {"loss": value, "deep": {"list": [value, 1.0]}})
    write_json(tmp_path / "s.json", {"loss": value})
    assert read_jsonl(tmp_path / "m.jsonl") == [{"loss": None, "deep": {"list": [None, 1.0]}}]
    json.loads((tmp_path / "s.json").read_text(), parse_constant=refuse_constant)


@pytest.mark.parametrize("levels", [65, 900, 5_000, 300_000])
@pytest.mark.parametrize(("begin", "end"), [("[", "]"), ('{"a":', "}"), ('[{"a":', "}]")])
@pytest.mark.parametrize("is_closed", [True, False])
def test_json_that_is_too_deep_is_one_message_and_never_an_error_of_recursion(
    levels, begin, end, is_closed, tmp_path
):
    """Some Pythons parse five thousand levels, but most code that uses the result recurses and fails."""
    text = begin * levels + "1" + end * levels * is_closed
    (tmp_path / "a.json").write_text(text)
    (tmp_path / "a.jsonl").write_text(f"{text}\n{{}}\n")
    with pytest.raises(UserError, match=r"^[^\n]*not valid JSON[^\n]*$"):
        read_json(tmp_path / "a.json")
    assert read_jsonl(tmp_path / "a.jsonl") == [{}]


def test_json_of_every_depth_that_is_written_is_read(tmp_path):
    deep: list = []
    for _ in range(63):
        deep = [deep, {}]
    write_json(tmp_path / "a.json", deep)
    assert read_json(tmp_path / "a.json") == deep


@pytest.mark.parametrize("cut", range(1, 20))
def test_a_cut_last_line_is_left_out_and_harms_no_later_line(tmp_path, cut):
    path = tmp_path / "m.jsonl"
    append_jsonl(path, {"step": 1})
    append_jsonl(path, {"step": 2, "x": "abc"})
    path.write_bytes(path.read_bytes()[:-cut])
    complete = [{"step": 1}, {"step": 2, "x": "abc"}][: 1 + (cut == 1)]
    assert read_jsonl(path) == complete
    append_jsonl(path, {"step": 3})
    assert read_jsonl(path) == [*complete, {"step": 3}]


def test_truncating_drops_later_steps_only(tmp_path):
    path = tmp_path / "m.jsonl"
    for line in [
        {"note": "no step"},
        {"step": 10},
        {"step": 20, "kind": "refine"},
        {"step": 20},
        {"step": 30},
    ]:
        append_jsonl(path, line)
    truncate_after(path, 20)
    assert [line.get("step") for line in read_jsonl(path)] == [None, 10, 20, 20]


def test_truncating_keeps_the_bytes_of_what_stays(tmp_path):
    path = tmp_path / "m.jsonl"
    for step in range(1, 6):
        append_jsonl(path, {"step": step, "loss": 1 / 3 * step})
    before = path.read_bytes()
    truncate_after(path, 5)
    assert path.read_bytes() == before


def test_a_json_file_is_read_as_it_was_written(tmp_path):
    write_json(tmp_path / "s.json", {"prompt": "Ü", "path": Path("/a"), "counts": (1, 2)})
    assert read_json(tmp_path / "s.json") == {"prompt": "Ü", "path": "/a", "counts": [1, 2]}


@pytest.mark.parametrize("content", [None, "{cut", ""])
def test_a_missing_or_broken_json_file_is_a_user_error(tmp_path, content):
    if content is not None:
        (tmp_path / "s.json").write_text(content)
    with pytest.raises(UserError, match=r"s\.json"):
        read_json(tmp_path / "s.json")


def test_a_log_that_cannot_be_written_is_a_user_error(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(UserError, match="cannot be written"):
        append_jsonl(tmp_path / "file" / "m.jsonl", {"step": 1})
    with pytest.raises(UserError, match="cannot be written"):
        write_json(tmp_path / "file" / "s.json", {})
