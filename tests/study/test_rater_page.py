"""The page of a study in Chromium: a rater answers with the keyboard, and the saved file can be evaluated.

These tests skip themselves without playwright or without Chromium. They share one browser.
"""

import json
from collections.abc import Iterator
from pathlib import Path
from random import Random

import numpy as np
import pytest
from chromium import headless, watch
from PIL import Image

from cadam3d.study.answers import collect, find_files, read_files
from cadam3d.study.clips import encoded
from cadam3d.study.key import read_key, write_key
from cadam3d.study.questions import QUESTIONS
from cadam3d.study.rater_page import study_id, study_page
from cadam3d.study.runs import RunPair, StudyRun
from cadam3d.study.trials import make_plan

FRAMES = 6
SECONDS = 0.6  # of one turn


@pytest.fixture(scope="module")
def browser() -> Iterator:
    with headless() as started:
        yield started


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Return a folder with a page of two pairs and a catch trial, and with its key."""
    folder = tmp_path_factory.mktemp("study")
    runs = {
        (arm, prompt): StudyRun(Path(arm), arm, prompt, 0) for arm in ("heron", "ibis") for prompt in "ab"
    }
    pairs = [RunPair((runs["heron", prompt], runs["ibis", prompt])) for prompt in "ab"]
    plan = make_plan(pairs, list(runs.values()), 1, Random(0))
    draw = np.random.default_rng(0)
    clips = [
        [
            encoded(Image.fromarray(draw.integers(0, 255, (8, 8, 3), dtype=np.uint8)), 80)
            for _ in range(FRAMES)
        ]
        for _ in plan.sources
    ]
    study = study_id(plan.trials, clips)
    page = study_page(study, plan.trials, clips, seconds=SECONDS, consent="Please read this.")
    (folder / "study.html").write_text(page, encoding="utf-8")
    write_key(folder / "key.json", study, plan, seed=0)
    return folder


@pytest.fixture
def visit(browser, folder):
    """Return a function that opens the page; the test fails if it reports an error or requests anything."""
    problems, contexts = [], []

    def open_page(**options):
        context = browser.new_context(viewport={"width": 1000, "height": 700}, **options)
        contexts.append(context)
        page = context.new_page()
        watch(page, problems)
        page.goto((folder / "study.html").as_uri())
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert not problems


def begin(page, name: str) -> None:
    """Type a name, agree and start, with the keyboard only."""
    page.keyboard.type(name)
    for key in ("Tab", "Space", "Enter"):
        page.keyboard.press(key)
    page.wait_for_selector("#first[data-frame]")


def answer(page, keys: str | list[str]) -> None:
    """Press a key for each question, once its pair is shown."""
    for key in keys:
        until(page, "playing.length > 0")
        page.keyboard.press(key)


def until(page, claim: str) -> None:
    """Wait for a claim. The policy of the page forbids playwright's own way, which is to call ``eval``."""
    for _ in range(200):
        if page.evaluate(claim):
            return
        page.wait_for_timeout(20)
    raise AssertionError(claim)


def saved(page, folder: Path, key="Enter") -> tuple[Path, dict]:
    with page.expect_download() as download:
        page.keyboard.press(key)
    path = folder / download.value.suggested_filename
    download.value.save_as(path)
    return path, json.loads(path.read_text(encoding="utf-8"))


def place_of(page) -> str:
    return page.inner_text("#place")


def test_a_rater_needs_only_the_keyboard_and_the_saved_file_can_be_evaluated(visit, folder, tmp_path):
    page = visit(accept_downloads=True)
    begin(page, "Ann 7")
    assert place_of(page) == "Pair 1 of 3 · question 1 of 5"
    assert page.inner_text("#question") == QUESTIONS[0].text
    answer(page, ["ArrowLeft", "2", "Backspace", "1", "ArrowRight", "2", "1"])
    assert place_of(page) == "Pair 2 of 3 · question 1 of 5"
    page.reload()  # by accident
    assert place_of(page) == "Pair 2 of 3 · question 1 of 5"
    answer(page, ["1"] * 5 + ["ArrowRight"] * 5)
    assert page.is_visible("#end")
    assert not page.is_visible("#trial")
    path, content = saved(page, tmp_path)
    assert path.name.startswith("answers-Ann-7-")
    assert (content["rater"], len(content["answers"])) == ("Ann 7", 3 * len(QUESTIONS))
    sides = [each["shown"].index(each["chosen"]) for each in content["answers"]]
    assert sides == [0, 0, 1, 1, 0] + [0] * 5 + [1] * 5
    assert json.loads(page.input_value("#text")) == content
    files, left = read_files(find_files([str(path)]))
    raters, others = collect(files, read_key(folder / "key.json"))
    assert not left
    assert not others
    [rater] = raters
    assert (rater.name, len(rater.answers), len(rater.catches)) == (
        "Ann 7",
        2 * len(QUESTIONS),
        len(QUESTIONS),
    )


def test_both_objects_show_the_same_frame_and_stop_together(visit):
    page = visit(reduced_motion="no-preference")
    begin(page, "1")
    frames = "() => ['first', 'second'].map((id) => document.getElementById(id).dataset.frame)"
    seen = set()
    for _ in range(12):
        one, other = page.evaluate(frames)
        assert one == other
        seen.add(one)
        page.wait_for_timeout(40)
    assert len(seen) > 2
    page.keyboard.press("p")
    before = page.evaluate(frames)
    page.wait_for_timeout(250)
    assert page.evaluate(frames) == before
    page.keyboard.press("Space")
    until(page, "document.getElementById('first').dataset.frame === '0'")
    assert page.evaluate(frames) == ["0", "0"]


def test_nothing_moves_for_a_rater_who_prefers_reduced_motion(visit):
    page = visit(reduced_motion="reduce")
    begin(page, "1")
    page.wait_for_timeout(250)
    assert page.get_attribute("#first", "data-frame") == "0"
    assert page.inner_text("#pause") == "Play"


def test_every_second_number_sees_the_sides_exchanged_and_all_see_every_trial(visit, folder):
    trials = json.loads((folder / "key.json").read_text(encoding="utf-8"))["trials"]
    page = visit()
    for name in ("1", "2", "3", "4"):
        shown = page.evaluate(
            "(name) => { rater = { name, answers: [] };"
            "const all = trials.map((_, i) => shown(i * questions.length)); rater = null; return all; }",
            name,
        )
        assert sorted(each["number"] for each in shown) == [0, 1, 2]
        for each in shown:
            clips = trials[each["number"]]["clips"]
            assert each["clips"] == (clips if int(name) % 2 else clips[::-1])


def test_another_person_can_begin_once_the_answers_of_the_first_are_saved(visit):
    page = visit(accept_downloads=True)
    page.on("dialog", lambda dialog: dialog.accept())
    begin(page, "1")
    answer(page, "1")
    assert not page.is_visible("#next-now")
    page.click("#save-now")
    page.reload()
    assert page.is_visible("#next-now")
    answer(page, "2")  # which is in no file yet
    assert not page.is_visible("#next-now")
    page.click("#save-now")
    page.click("#next-now")
    begin(page, "2")
    assert page.inner_text("#who") == "2"
    assert place_of(page) == "Pair 1 of 3 · question 1 of 5"


def test_two_windows_of_one_browser_continue_the_same_answers(visit):
    page = visit()
    begin(page, "1")
    other = page.context.new_page()
    other.goto(page.url)
    answer(other, "12")
    until(page, "step === 2")
    answer(page, "1")
    until(other, "rater.answers.length === 3 && rater.answers.every(Boolean)")


def test_answers_that_the_browser_cannot_keep_are_not_closed_without_a_question(visit):
    asked = []
    page = visit()
    page.on("dialog", lambda dialog: (asked.append(dialog.type), dialog.accept()))
    page.evaluate("() => { Storage.prototype.setItem = () => { throw new Error('full'); }; }")
    begin(page, "1")
    assert "cannot keep your answers" in page.inner_text("#notice")
    answer(page, "1")
    page.reload()
    assert asked == ["beforeunload"]


@pytest.mark.parametrize(("width", "height"), [(390, 844), (360, 640), (844, 390), (1366, 768)])
def test_both_objects_and_both_buttons_fit_on_the_screen(visit, width, height):
    page = visit()
    page.set_viewport_size({"width": width, "height": height})
    begin(page, "1")
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    boxes = {name: page.locator(f"#{name}").bounding_box() for name in ("first", "second")}
    assert abs(boxes["first"]["width"] - boxes["second"]["width"]) < 1
    assert boxes["first"]["width"] >= 120
    if height > 400:
        for name in ("choose-first", "choose-second", "first", "second"):
            box = page.locator(f"#{name}").bounding_box()
            assert box["y"] + box["height"] <= height
