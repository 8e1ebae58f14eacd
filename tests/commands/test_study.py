"""``cadam3d study``: the page and the key that it writes, and what it makes of answers."""

import json
import re
from pathlib import Path

import pytest
import torch

from cadam3d.core.gaussians import Gaussians
from cadam3d.io.jsonl import read_json, write_json
from cadam3d.io.ply import write_ply
from cadam3d.study.questions import QUESTION_NAMES

ARMS = ("heron", "ibis")
PROMPTS = ("a cube", "a cone", 'a <b>torus</b> & "co"</script>')
SMALL = ("size=16", "frames=2", "rasterizer=auto", "catch_share=0.5")


def make_run(folder: Path, arm: str, prompt: str, seed=0, count=8) -> Path:
    folder.mkdir(parents=True)
    draw = torch.Generator().manual_seed(len(str(folder)))
    gaussians = Gaussians(
        means=torch.randn(count, 3, generator=draw) * 0.3,
        log_scales=torch.full((count, 3), -1.5),
        quats=torch.randn(count, 4, generator=draw),
        opacity_logits=torch.full((count,), 2.0),
        sh=torch.randn(count, 1, 3, generator=draw),
    )
    write_ply(folder / "asset.ply", gaussians, up="-y", pad_sh=0)
    (folder / "config.yaml").touch()
    facts = {"prompt": prompt, "seed": seed, "densifier": arm, "outcome": "finished", "num_gaussians": count}
    write_json(folder / "summary.json", {**facts, "warnings": []})
    return folder


@pytest.fixture
def arms(tmp_path) -> str:
    """Make two folders with a run for each prompt, and return them as a setting."""
    for arm in ARMS:
        for number, prompt in enumerate(PROMPTS):
            make_run(tmp_path / arm / f"{number}", arm, prompt)
    return f"runs=[{','.join(ARMS)}]"


def page_data(page: str) -> dict:
    [found] = re.findall(r'<script type="application/json" id="study">(.*?)</script>', page, re.DOTALL)
    return json.loads(found)


def answered(key: dict, rater: str, choose, *, saves=1) -> dict:
    """Return the file of a rater who has answered everything as ``choose(trial, arms of its clips)`` says."""
    answers = []
    for number, trial in enumerate(key["trials"]):
        names = [key["clips"][clip]["run"]["arm"] for clip in trial["clips"]]
        chosen = trial["clips"][choose(trial, names)]
        answers += [
            {"trial": number, "shown": trial["clips"], "question": name, "chosen": chosen, "seconds": 1}
            for name in QUESTION_NAMES
        ]
    whole = {"kind": "study answers", "version": 1, "study": key["study"], "rater": rater}
    return {**whole, "session": rater, "saves": saves, "answers": answers}


def prefers_ibis(trial: dict, names: list[str]) -> int:
    right = trial["right"]
    return names.index("ibis") if right is None else trial["clips"].index(right)


def fails(trial: dict, names: list[str]) -> int:
    return 0 if trial["right"] is None else 1 - trial["clips"].index(trial["right"])


def test_the_page_says_nothing_about_arms_files_and_counts(arms, type_line, tmp_path):
    code, out, err = type_line("study", arms, *SMALL)
    assert code == 0
    assert "heron and ibis: 3 pair(s)\n5 trial(s), of which 2 are catch trials" in out
    assert "certain between heron and ibis (3 prompts). That needs at least 8 raters and 8 prompts" in err
    page = (tmp_path / "study/study.html").read_text(encoding="utf-8")
    for hidden in (
        *ARMS,
        "cadam",
        "ply",
        "gaussian",
        "key.json",
        "catch_",
        "catch trial",
        "ruined",
        str(tmp_path),
    ):
        assert hidden not in page.lower()
    data = page_data(page)
    assert {tuple(sorted(trial)) for trial in data["trials"]} == {("clips", "prompt")}
    assert {trial["prompt"] for trial in data["trials"]} == set(PROMPTS)


def test_the_page_makes_no_request_and_a_prompt_stays_text(arms, type_line, tmp_path):
    type_line("study", arms, *SMALL)
    page = (tmp_path / "study/study.html").read_text(encoding="utf-8")
    assert "default-src 'none'" in page
    assert not re.findall(r"https?://|src=|href=\"(?!data:,)", page.replace("image.src", ""))
    assert "<b>" not in page
    assert page.count("</script>") == 2 + len(re.findall('id="clip-', page))


def test_the_key_has_the_arms_of_all_clips_and_is_of_this_page(arms, type_line, tmp_path):
    type_line("study", arms, *SMALL)
    key = read_json(tmp_path / "study/key.json")
    data = page_data((tmp_path / "study/study.html").read_text(encoding="utf-8"))
    assert key["study"] == data["study"]
    assert [{**trial, "right": None} for trial in data["trials"]] == [
        {**trial, "right": None} for trial in key["trials"]
    ]
    for trial in key["trials"]:
        clips = [key["clips"][clip] for clip in trial["clips"]]
        if trial["right"] is None:
            assert {clip["run"]["arm"] for clip in clips} == set(ARMS)
            assert {clip["run"]["prompt"] for clip in clips} == {trial["prompt"]}


def test_the_same_seed_gives_the_same_bytes_and_another_one_another_study(arms, type_line, tmp_path):
    for name, seed in (("one", 0), ("two", 0), ("three", 1)):
        assert type_line("study", arms, *SMALL, f"output={name}", f"seed={seed}").code == 0
    pages = [(tmp_path / name / "study.html").read_bytes() for name in ("one", "two", "three")]
    assert pages[0] == pages[1] != pages[2]
    assert (tmp_path / "one/key.json").read_bytes() == (tmp_path / "two/key.json").read_bytes()


def test_the_numbers_of_the_clips_cannot_be_computed_from_the_page_and_the_seed(arms, type_line, tmp_path):
    keys = []
    for name in ("one", "two"):
        assert type_line("study", arms, *SMALL, f"output={name}").code == 0
        keys.append([clip["run"]["folder"] for clip in read_json(tmp_path / name / "key.json")["clips"]])
        for number, arm in enumerate(ARMS):  # other assets of the same prompts
            asset = tmp_path / arm / "0/asset.ply"
            asset.write_bytes(
                (
                    make_run(tmp_path / "other" / name / arm, arm, "a cube", count=9 + number) / "asset.ply"
                ).read_bytes()
            )
    assert keys[0] != keys[1]


def test_answers_become_a_table_and_files_beside_the_key(arms, type_line, tmp_path):
    type_line("study", arms, *SMALL)
    key = read_json(tmp_path / "study/key.json")
    for rater, choose in (("1", prefers_ibis), ("2", prefers_ibis), ("3", fails)):
        write_json(tmp_path / f"study/answers/{rater}.json", answered(key, rater, choose))
    (tmp_path / "study/answers/broken.json").write_text("{", encoding="utf-8")
    code, out, err = type_line("study", "answers=study/answers/*.json")
    assert code == 0
    assert "2 arms, 2 raters, 3 prompts, 30 answers." in out
    assert re.search(r"^\| ibis +\| 100\.0", out, re.MULTILINE)
    assert "right answers in catch trials: 3 (0 of 10)." in out
    assert "broken.json is left out: it is not a complete file of answers" in err
    result = read_json(tmp_path / "study/study.json")
    assert (result["study"], result["catch_trials"], result["answers"]) == (key["study"], 2, 30)
    assert [each["file"] for each in result["left_out"]] == ["broken.json"]
    assert "broken.json" in (tmp_path / "study/study.md").read_text(encoding="utf-8")


def test_names_of_files_do_not_control_the_terminal(arms, type_line, tmp_path):
    type_line("study", arms, *SMALL)
    key = read_json(tmp_path / "study/key.json")
    for name in ("a\x1b[2J\udcff.json", "b\x1b[2J\udcff.json"):
        write_json(tmp_path / "study/answers" / name, answered(key, "1", prefers_ibis))
    (tmp_path / "study/answers/c\x1b[2J\udcff.json").write_text("{", encoding="utf-8")
    code, out, err = type_line("study", "answers=study/answers")
    assert code == 0
    page = (tmp_path / "study/study.md").read_text(encoding="utf-8")
    assert "c [2J .json is left out" in err
    assert "b \\[2J .json: study/answers/a \\[2J .json has the answers of the same session" in page
    assert "\x1b" not in out + err + page


def test_the_key_is_in_output_or_where_the_line_says(arms, type_line, tmp_path):
    type_line("study", arms, *SMALL, "output=mine")
    key = read_json(tmp_path / "mine/key.json")
    write_json(tmp_path / "elsewhere/a.json", answered(key, "1", prefers_ibis))
    for words in ("output=mine", "key=mine/key.json", "key=mine"):
        assert type_line("study", "answers=elsewhere", words).code == 0, words
    for words in (("key=nowhere",), ()):
        message = type_line("study", "answers=elsewhere", *words).message
        assert message.startswith("key: expected the key of a study, got ")


def test_a_folder_with_a_key_is_not_written_again(arms, type_line, tmp_path):
    type_line("study", arms, *SMALL)
    before = (tmp_path / "study/key.json").read_bytes()
    message = type_line("study", arms, *SMALL, "seed=1").message
    assert message.startswith("output: expected a folder of its own, got one with key.json")
    assert message.endswith("Try: output=study-2")
    assert (tmp_path / "study/key.json").read_bytes() == before


def test_objects_that_cannot_be_seen_make_no_catch_trial(tmp_path, type_line):
    for arm in ARMS:
        make_run(tmp_path / arm, arm, "a cube", count=0)
    code, _, err = type_line("study", f"runs=[{','.join(ARMS)}]", *SMALL)
    assert code == 1
    assert "cadam3d: backdrop: expected a colour in front of which the objects can be seen" in err
    assert not (tmp_path / "study").exists()
    assert type_line("study", f"runs=[{','.join(ARMS)}]", *SMALL, "catch_share=0").code == 0


def test_a_text_of_consent_is_shown_as_text(arms, type_line, tmp_path):
    (tmp_path / "consent.txt").write_text("First <i>point</i>.\n\nSecond point.", encoding="utf-8")
    assert type_line("study", arms, *SMALL, "consent=consent.txt").code == 0
    page = (tmp_path / "study/study.html").read_text(encoding="utf-8")
    assert "<p>First &lt;i&gt;point&lt;/i&gt;.</p>" in page
    assert "<p>Second point.</p>" in page


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "runs, answers: expected one of them, got neither"),
        (("runs=a", "answers=b"), "runs, answers: expected one of them, got both"),
        (
            ("runs=[a,b]", "frames=0"),
            "frames: expected a whole number >= 1 and <= 1000, got 0. Try: frames=72",
        ),
        (("runs=[a,b]", "catch_share=2"), "catch_share: expected a number >= 0 and <= 1, got 2"),
        (("answers=a", "least_caught=2"), "least_caught: expected a number >= 0 and <= 1, got 2"),
        (("runs=[a,b]", "labels=x"), "labels: expected a list of texts or null, got 'x'. Try: labels=null"),
        (("runs=[a,b]", "arms=x"), "arms: expected a list of texts or null, got 'x'. Try: arms=null"),
        (("runs=[a,b]", "backdrop=red"), "backdrop: expected a list of numbers, got 'red'. Try: 'backdrop="),
        (("runs=[a,a]",), "labels: expected 2 different names, one for each arm"),
    ],
)
def test_a_wrong_line_is_one_message(words, message, type_line):
    assert type_line("study", *words).message.startswith(message)
