"""Files of answers: which ones count, and what happens to damaged, repeated, foreign and incomplete ones."""

import json
from pathlib import Path
from random import Random

import pytest

from cadam3d.core.errors import UserError
from cadam3d.study.answers import LARGEST_FILE, collect, find_files, read_files
from cadam3d.study.key import Key, read_key, write_key
from cadam3d.study.questions import QUESTION_NAMES
from cadam3d.study.runs import RunPair, StudyRun
from cadam3d.study.trials import ClipSource, Trial, make_plan

STUDY = "0123456789abcdef"
# Clips 0 and 2 are of heron, 1 and 3 of stork, and 4 is a ruined one. Trial 1 is a catch trial.
KEY = Key(
    study=STUDY,
    seed=0,
    clips=tuple(
        ClipSource(StudyRun(Path(arm), arm, "a cube", 0), is_ruined=False)
        for arm in ("heron", "stork", "heron", "stork", "heron")
    ),
    trials=(Trial("a cube", (0, 1)), Trial("a cube", (4, 1), right=1), Trial("a cone", (3, 2))),
)


def written(chosen: dict[int, int], questions=QUESTION_NAMES, **changes) -> dict:
    """Return a file of answers in which every question about a trial has the same clip as its answer."""
    answers = [
        {
            "trial": trial,
            "shown": list(KEY.trials[trial].clips),
            "question": name,
            "chosen": clip,
            "seconds": 2.5,
        }
        for trial, clip in chosen.items()
        for name in questions
    ]
    whole = {"kind": "study answers", "version": 1, "study": STUDY, "rater": "7", "session": "a1", "saves": 1}
    return {**whole, "answers": answers, **changes}


@pytest.fixture
def read(tmp_path):
    """Return a function that writes files, each given as JSON or as bytes, and collects their answers."""

    def collected(**files):
        for name, content in files.items():
            data = content if isinstance(content, bytes) else json.dumps(content).encode()
            (tmp_path / f"{name}.json").write_bytes(data)
        found, left = read_files(find_files([str(tmp_path)]))
        raters, others = collect(found, KEY)
        reasons = {path.stem: reason for path, reason in (left | others).items()}
        return {rater.name: rater for rater in raters}, reasons

    return collected


def test_answers_name_arms_instead_of_clips(read):
    raters, left = read(one=written({0: 1, 2: 2}, questions=("overall",)))
    assert not left
    assert [(each.prompt, each.question, each.chosen, each.other) for each in raters["7"].answers] == [
        ("a cube", "overall", "stork", "heron"),
        ("a cone", "overall", "heron", "stork"),
    ]
    assert {each.rater for each in raters["7"].answers} == {"7"}


def test_every_question_of_a_catch_trial_is_a_catch_and_no_answer(read):
    content = written({0: 1, 1: 1})
    content["answers"][-1]["chosen"] = 4
    raters, _ = read(one=content)
    assert raters["7"].catches == (True, True, True, True, False)
    assert len(raters["7"].answers) == len(QUESTION_NAMES)


def test_the_last_file_of_a_session_counts(read):
    raters, left = read(
        early=written({0: 0}, saves=1), late=written({0: 1, 2: 2}, saves=2), copy=written({0: 0}, saves=1)
    )
    assert len(raters["7"].answers) == 2 * len(QUESTION_NAMES)
    assert raters["7"].answers[0].chosen == "stork"
    assert set(left) == {"early", "copy"}
    assert all("of the same session" in reason for reason in left.values())


def test_two_sessions_under_one_name_are_both_left_out_and_name_each_other(read):
    raters, left = read(
        one=written({0: 0}, rater="Ann"),
        two=written({0: 1}, rater="ann ", session="b2"),
        three=written({0: 1}, rater="Bob", session="c3"),
    )
    assert set(raters) == {"Bob"}
    assert set(left) == {"one", "two"}
    assert "two.json" in left["one"]
    assert "one.json" in left["two"]


def test_a_session_under_two_names_is_one_rater_with_the_later_name(read):
    raters, left = read(
        early=written({0: 0}, rater="ann", saves=1), late=written({0: 1, 2: 2}, rater="anne", saves=2)
    )
    assert set(raters) == {"anne"}
    assert raters["anne"].answers[0].chosen == "stork"
    assert set(left) == {"early"}


def test_invisible_characters_of_names_cost_no_answers(read):
    names = {"x\u200cy": "x y", "a\x1b[2Jb": "a [2Jb"}
    raters, left = read(
        **{f"f{i}": written({0: 0}, rater=name, session=f"s{i}") for i, name in enumerate(names)}
    )
    assert set(raters) == set(names.values())
    assert not left


def test_a_file_of_another_study_is_left_out(read):
    raters, left = read(one=written({0: 0}), two=written({0: 0}, study="f" * 16, rater="8"))
    assert set(raters) == {"7"}
    assert set(left) == {"two"}


def test_the_key_and_the_results_beside_the_answers_are_skipped_without_a_message(read):
    raters, left = read(one=written({0: 0}), key={"kind": "study key"}, study={"kind": "study results"})
    assert set(raters) == {"7"}
    assert not left


def broken(**changes) -> dict:
    content = written({0: 0})
    content["answers"][0] |= changes
    return content


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"{",
        b"\xff\xfe",
        b"[" * 100_000,
        b" " * (LARGEST_FILE + 1),
        [],
        {},
        written({0: 0}, kind="study"),
        written({0: 0}, answers={}),
        written({0: 0}, saves="1"),
        written({0: 0}, rater=""),
        written({0: 0}, rater="x" * 65),
        written({0: 0}, rater="\u200b\x1b"),
        written({0: 0}, session=5),
        {key: value for key, value in written({0: 0}).items() if key != "saves"},
        written({}),
        broken(trial=-1),
        broken(trial=3),
        broken(chosen=2),
        broken(question="beauty"),
        broken(question="overall"),
    ],
    ids=lambda content: str(content)[:30],
)
def test_a_damaged_file_is_left_out_with_a_reason_and_the_others_count(read, content):
    raters, left = read(bad=content, good=written({0: 0}, rater="8", session="b2"))
    assert set(raters) == {"8"}
    assert set(left) == {"bad"}
    assert left["bad"].isprintable()
    assert len(left["bad"]) < 200


def test_a_named_pipe_is_left_out_without_waiting_for_it(tmp_path, read):
    import os

    os.mkfifo(tmp_path / "pipe.json")
    raters, left = read(good=written({0: 0}))
    assert set(raters) == {"7"}
    assert set(left) == {"pipe"}


def test_files_are_found_by_name_folder_and_pattern_each_once(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("a.json", "b.json", "c.txt", "x[1].json"):
        Path(name).touch()
    assert [path.name for path in find_files(["b.json", "*.json", "."])] == ["b.json", "a.json", "x[1].json"]
    assert [path.name for path in find_files(["x[1].json"])] == ["x[1].json"]
    assert [path.name for path in find_files([str(tmp_path / "?.json")])] == ["a.json", "b.json"]


def test_a_key_is_read_as_it_was_written(tmp_path):
    runs = [StudyRun(Path(arm), arm, "a cube", 0) for arm in ("heron", "stork")]
    plan = make_plan([RunPair((runs[0], runs[1]))], runs, 1, Random(0))
    write_key(tmp_path / "key.json", STUDY, plan, seed=0)
    key = read_key(tmp_path / "key.json")
    assert key.trials == plan.trials
    assert key.clips == plan.sources
    assert key.study == STUDY


@pytest.mark.parametrize(
    "changes",
    [
        {"kind": "study answers"},
        {"clips": "heron"},
        {"trials": [{"prompt": "a cube", "clips": [0], "right": None}]},
        {"trials": [{"prompt": "a cube", "clips": [0, 0], "right": None}]},
        {"trials": [{"prompt": "a cube", "clips": [0, 9], "right": None}]},
        {"trials": [{"clips": [0, 1], "right": None}]},
    ],
    ids=str,
)
def test_a_damaged_key_is_one_message(tmp_path, changes):
    runs = [StudyRun(Path(arm), arm, "a cube", 0) for arm in ("heron", "stork")]
    path = tmp_path / "key.json"
    write_key(path, STUDY, make_plan([RunPair((runs[0], runs[1]))], runs, 1, Random(0)), seed=0)
    path.write_text(json.dumps(json.loads(path.read_text(encoding="utf-8")) | changes), encoding="utf-8")
    with pytest.raises(UserError, match="key: expected"):
        read_key(path)
