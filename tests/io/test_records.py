"""What a run has written about itself is believed only if every entry has the kind that training writes."""

import json
from pathlib import Path

import pytest

from cadam3d.core.errors import UserError
from cadam3d.io.jsonl import append_jsonl, read_json, read_jsonl, truncate_after, write_json
from cadam3d.io.records import read_config, read_histograms, read_metrics, read_summary

SUMMARY = {
    "prompt": "a red cube",
    "negative_prompt": "",
    "seed": 3,
    "steps": 40,
    "steps_asked": 40,
    "outcome": "finished",
    "num_gaussians_initial": 300,
    "num_gaussians": 310,
    "seconds": 1.5,
    "skipped_steps": 0,
    "dimmed_steps": 0,
    "densifier": "cadam",
    "guidance": "sds",
    "psnr": None,
    "ssim": 0.5,
    "warnings": [],
    "of_another_metric": {"any": ["thing", 1]},
}
STEP = {"kind": "step", "step": 10, "loss": 0.5, "num_gaussians": 300, "seconds": 1.5, "drift": None}
REFINE = {"kind": "refine", "step": 10, "before": 3, "after": 4, "statistics": {"drift": 0.5, "snr": None}}
HISTOGRAM = {
    "step": 10,
    "score": "snr",
    "bins_per_decade": 10,
    "first": -20,
    "counts": [1, 2],
    "selected": [0, 1],
    "without_log": 3,
}
WRONG = ["x", [], {}, True, [1, "x"], {"a": "b"}, -1.5, 1e200, 10**15]


def test_honest_files_are_read_as_they_were_written(tmp_path):
    write_json(tmp_path / "summary.json", SUMMARY)
    for line in (STEP, REFINE):
        append_jsonl(tmp_path / "metrics.jsonl", line)
    append_jsonl(tmp_path / "candidates/histograms.jsonl", HISTOGRAM)
    assert read_summary(tmp_path) == SUMMARY
    assert read_metrics(tmp_path) == [STEP, REFINE]
    assert read_histograms(tmp_path) == [HISTOGRAM]


def test_no_entry_of_a_summary_has_another_kind(tmp_path):
    for name in SUMMARY.keys() - {"of_another_metric", "warnings", "prompt", "negative_prompt"}:
        write_json(tmp_path / "summary.json", SUMMARY | {name: {"a": "b"}})
        assert read_summary(tmp_path) == {}, name
    for name, wrong in (("psnr", "high"), ("num_gaussians", -1), ("num_gaussians", True), ("outcome", "won")):
        write_json(tmp_path / "summary.json", SUMMARY | {name: wrong})
        assert read_summary(tmp_path) == {}, name


@pytest.mark.parametrize("key", ["kind", "step", "loss", "num_gaussians", "seconds", "statistics", "new"])
@pytest.mark.parametrize("wrong", [*WRONG[:6], None])
def test_lines_with_entries_of_another_kind_are_left_out(tmp_path, key, wrong):
    may_be_none = key in ("loss", "num_gaussians", "seconds", "new") and wrong is None
    for line in (STEP | {key: wrong}, STEP):
        append_jsonl(tmp_path / "metrics.jsonl", line)
    is_sound = may_be_none or (key == "kind" and wrong == "x") or (key == "statistics" and wrong == {})
    assert len(read_metrics(tmp_path)) == 1 + is_sound


@pytest.mark.parametrize("key", ["step", "score", "bins_per_decade", "first", "counts", "selected"])
def test_histograms_of_another_form_are_left_out(tmp_path, key):
    for wrong in (None, 0.5, [1, -1], [1], ["x", 1], True, 10**9, {}):
        if not (key == "step" and wrong == 10**9):
            append_jsonl(tmp_path / "candidates/histograms.jsonl", HISTOGRAM | {key: wrong})
    append_jsonl(tmp_path / "candidates/histograms.jsonl", HISTOGRAM)
    assert read_histograms(tmp_path) == [HISTOGRAM]


NOT_JSON = {
    "deep": "[" * 100_000,
    "closed": "[" * 100_000 + "]" * 100_000,
    "a long number": '{"a": ' + "1" * 5000 + "}",
    "a large number": '{"a": 1e999}',
    "nan": '{"a": NaN}',
    "infinity": '{"a": -Infinity}',
    "half a pair": '{"a": "\\ud800"}',
    "half a pair in a key": '{"\\udfff": 1}',
    "a mark": "\ufeff{}",
    "nothing": "",
    "cut": '{"a": ',
}


@pytest.mark.parametrize("name", NOT_JSON)
def test_what_is_not_plain_json_is_one_message_and_no_line(tmp_path, name):
    (tmp_path / "a.json").write_text(NOT_JSON[name], encoding="utf-8")
    with pytest.raises(UserError, match=r"a\.json: not valid JSON") as caught:
        read_json(tmp_path / "a.json")
    assert len(str(caught.value).splitlines()) == 1
    (tmp_path / "a.jsonl").write_text(NOT_JSON[name] + '\n{"step": 1}\n', encoding="utf-8")
    assert read_jsonl(tmp_path / "a.jsonl") == [{"step": 1}]


def test_bytes_that_are_no_text_are_one_message_and_no_line(tmp_path):
    (tmp_path / "a").write_bytes(b'\xff\xfe{"a"}\n{"step": 1}\n')
    assert read_jsonl(tmp_path / "a") == [{"step": 1}]
    with pytest.raises(UserError, match="not valid JSON"):
        read_json(tmp_path / "a")


def test_a_line_of_text_may_contain_other_line_breaks(tmp_path):
    append_jsonl(tmp_path / "a", {"note": "one\u2028two\x85three", "step": 1})
    assert read_jsonl(tmp_path / "a") == [{"note": "one\u2028two\x85three", "step": 1}]


@pytest.mark.parametrize("step", ["10", None, [1], True, 1.5, -1, 10**15])
def test_truncating_removes_lines_whose_step_is_not_a_count(tmp_path, step):
    for line in ({"step": step}, {"step": 1}):
        append_jsonl(tmp_path / "a", line)
    truncate_after(tmp_path / "a", 5)
    assert read_jsonl(tmp_path / "a") == [{"step": 1}]


@pytest.mark.parametrize("content", ["", "[1]", "text", "1", "1: 2", "a: {1: 2}", "a: [{null: 1}]"])
def test_settings_of_a_run_are_keys_and_values(tmp_path: Path, content):
    (tmp_path / "config.yaml").write_text(content)
    with pytest.raises(UserError, match="expected the settings of a run"):
        read_config(tmp_path / "config.yaml")
    (tmp_path / "config.yaml").write_text(json.dumps({"a": {"b": [1, None]}}))
    assert read_config(tmp_path / "config.yaml") == {"a": {"b": [1, None]}}
