"""Prompts of sweeps: files, sets, shards, and the settings that come with a prompt."""

import json

import pytest
from harsh_prompts import HARSH

from cadam3d import launch
from cadam3d.core.errors import UserError
from cadam3d.io.prompt_files import Prompt
from cadam3d.report import results
from cadam3d.settings.line import quoted
from cadam3d.sweep.folder import Job, Plan, load, write_plan
from cadam3d.sweep.grid import Grid, expand, prompt_axis, read_grid, read_line, sweep_name
from cadam3d.sweep.plan import read_sweep
from cadam3d.sweep.prompts import PromptChoice, read_choice

# A line of a text file cannot hold these.
LINES = ["one\ntwo", "one\r\n\u2028 two"]


def jobs_of(prompts, grid: Grid | None = None, line=(), has_setting=lambda *_: True) -> list[Job]:
    return expand(grid or read_grid(None), {"prompt": prompt_axis(prompts)} | read_line(line), has_setting)


# --- a part of the prompts --------------------------------------------------------------------------------


def choice(file: str | None = "paper50", **node) -> PromptChoice:
    found = read_choice({"file": file, **node})
    assert found is not None
    return found


def test_shards_are_disjoint_complete_in_order_and_of_equal_size(tmp_path):
    for number in (1, 2, 5, 12):
        path = tmp_path / f"{number}.txt"
        path.write_text("".join(f"prompt {each}\n" for each in range(number)))
        whole = choice(str(path)).read()
        for count in range(1, number + 1):
            shards = [choice(str(path), shard=f"{each}/{count}").read() for each in range(1, count + 1)]
            assert sum(shards, ()) == whole
            assert max(map(len, shards)) - min(map(len, shards)) <= 1


def test_a_category_and_a_number_choose_a_part(tmp_path):
    prompts = choice(category="material", first=5).read()
    assert {each.category for each in prompts} == {"Material"}
    assert len(prompts) == 5
    assert choice(category="material", first=5, shard="2/5").read() == prompts[1:2]


@pytest.mark.parametrize(
    ("node", "expected"),
    [
        ({"shard": "0/3"}, "prompts.shard: expected i/n"),
        ({"shard": "4/3"}, "prompts.shard: expected i/n"),
        ({"shard": 2}, "prompts.shard: expected i/n"),
        ({"shard": "1/51"}, "prompts.shard: expected at most 50 shards, got '1/51'"),
        ({"first": 0}, "prompts.first: expected a whole number >= 1, got 0"),
        ({"first": True}, "prompts.first: expected a whole number"),
        ({"category": "Matter"}, "expected one of Material|Structure|Concept, got 'Matter'"),
        ({"category": ""}, "prompts.category: expected"),
        ({"file": ""}, "prompts: expected a file, or one of the sets"),
        ({"file": 7}, "prompts: expected a file, or one of the sets"),
        ({"file": None, "shard": "1/2"}, "prompts: expected a file, or one of the sets"),
    ],
)
def test_wrong_parts_are_refused(node, expected):
    with pytest.raises(UserError) as caught:
        choice(**node).read()
    assert expected in str(caught.value)


def test_the_file_of_a_grid_is_replaced_by_that_of_the_line():
    assert read_choice(None, None) is None
    assert read_choice({"file": None, "first": 3}, "shapes6").source == "shapes6"
    assert read_choice({"file": "paper50"}, "shapes6").source == "paper50"
    assert read_grid({"prompts": "shapes6"}).prompts == "shapes6"


# --- jobs -------------------------------------------------------------------------------------------------


PARETO = {
    "each": {"prompt": "a lighthouse", "seed": [0, 1]},
    "arms": {
        "baseline": {"densifier": "baseline", "densifier.tau_pos": [0.1, 0.2]},
        "cadam": {"densifier": "cadam"},
    },
}


@pytest.mark.parametrize("grid", [None, PARETO])
def test_jobs_have_the_same_folders_with_and_without_a_shard_and_on_a_line(grid):
    prompts = [Prompt(text=text) for text in HARSH]
    whole = [job.name for job in jobs_of(prompts, read_grid(grid))]
    shards = [job.name for each in prompts for job in jobs_of([each], read_grid(grid))]
    assert sorted(whole) == sorted(shards)
    line = "prompt=" + ",".join(value.line.removeprefix("prompt=") for value in prompt_axis(prompts))
    assert [job.name for job in expand(read_grid(grid), read_line([line]))] == whole


def test_the_settings_of_a_prompt_count_for_its_folder_and_not_for_those_of_other_prompts():
    plain, other = Prompt(text="a cat"), Prompt(text="a dog")
    negative = Prompt(text="a cat", settings=(("negative_prompt", "blurry"),))
    [first, _] = jobs_of([plain, other])
    [second, dog] = jobs_of([negative, other])
    assert first.name != second.name
    assert dog.name == jobs_of([other])[0].name
    assert second.overrides == ["prompt='a cat'", "negative_prompt='blurry'"]
    assert (first.brought, second.brought) == ([], ["negative_prompt"])


def test_the_settings_of_one_prompt_change_no_folder_of_another_in_any_arm():
    grid = read_grid({"arms": {"some": {"negative_prompt": ["x", "y"]}, "none": {"densifier": "none"}}})
    plain, other = Prompt(text="a cat"), Prompt(text="a dog", settings=(("negative_prompt", "z"),))
    alone = [job.name for job in jobs_of([plain], grid)]
    assert [job.name for job in jobs_of([plain, other], grid)][: len(alone)] == alone


def test_the_line_and_the_grid_take_precedence_over_the_settings_of_a_prompt():
    prompts = [Prompt(text="a cat", settings=(("negative_prompt", "own"),)), Prompt(text="a dog")]
    lines = [job.overrides for job in jobs_of(prompts, line=["negative_prompt='typed'"])]
    assert lines == [
        ["prompt='a cat'", "negative_prompt='typed'"],
        ["prompt='a dog'", "negative_prompt='typed'"],
    ]
    grid = read_grid({"arms": {"own": {"seed": 1}, "none": {"seed": 1, "negative_prompt": ""}}})
    assert [job.overrides[2:] for job in jobs_of(prompts[:1], grid)] == [
        ["negative_prompt='own'"],
        ["negative_prompt=''"],
    ]


def test_a_setting_of_a_prompt_reaches_only_jobs_that_have_it():
    grid = read_grid({"arms": {"ball": {"initializer": "ball"}, "shap_e": {"initializer": "shap_e"}}})
    prompts = [Prompt(text="a cat", settings=(("initializer.prompt", "an animal"),))]
    jobs = jobs_of(prompts, grid, has_setting=lambda lines, key: "initializer=shap_e" in lines)
    assert [(job.arm, job.overrides[2:]) for job in jobs] == [
        ("ball", []),
        ("shap_e", ["initializer.prompt='an animal'"]),
    ]


def test_a_sweep_is_named_by_its_file_and_a_shard_has_a_folder_of_its_own(tmp_path):
    line = read_line(["densifier=a,b"])
    whole = sweep_name(None, {"prompt": prompt_axis([Prompt(text="a cat")])} | line, choice("dir/mine.txt"))
    assert whole.startswith("mine-densifier=a-b_")
    # The prompts themselves do not count, so that a line with a longer file continues the sweep.
    other = {"prompt": prompt_axis([Prompt(text="a dog"), Prompt(text="a cat")])} | line
    assert sweep_name(None, other, choice("./dir/mine.txt")) == whole
    assert sweep_name(None, other, choice("mine.txt")) != whole
    assert sweep_name(None, other, choice("dir/mine.txt", shard="2/3")) == f"{whole}_shard-2-of-3"
    assert sweep_name(None, other, choice("dir/mine.txt", first=1)) != whole
    assert sweep_name("paper", other, choice("paper50", shard="1/4")) == "paper_shard-1-of-4"


def test_jobs_of_a_prompt_are_compared_whether_or_not_they_have_its_settings(tmp_path):
    jobs = [
        Job(
            arm=arm,
            name=f"{arm}_{prompt}",
            overrides=[],
            swept={"prompt": prompt, "initializer.prompt": f"{prompt}s" if brought else None},
            brought=brought,
        )
        for prompt in ("cat", "dog")
        for arm, brought in (("ball", []), ("shap_e", ["initializer.prompt"]))
    ]
    write_plan(tmp_path, Plan(cwd=str(tmp_path), flags=[], threads=None, jobs=jobs))
    assert [row.brought for row in load(tmp_path)] == [job.brought for job in jobs]
    ball_cat, shap_e_cat, ball_dog, _ = (result.cell for result in results.read(tmp_path))
    assert ball_cat == shap_e_cat != ball_dog


def test_every_prompt_reaches_its_job_literally_with_its_settings(tmp_path):
    path = tmp_path / "prompts.json"
    entries = [
        {"prompt": each, "initializer_prompt": each, "negative_prompt": each} for each in [*HARSH, *LINES]
    ]
    path.write_text(json.dumps(entries))
    sweep = read_sweep(launch.read_line("sweep", [f"prompts={path}", "initializer=ball,shap_e"]))
    composed = sweep.composed
    wanted = [(text.strip(), name) for text in [*HARSH, *LINES] for name in ("ball", "shap_e")]
    assert [(job.get("prompt"), job.get("initializer")) for job in composed] == wanted
    assert [job.get("negative_prompt") for job in composed] == [text for text, _ in wanted]
    assert [job.get("initializer.prompt") for job in composed] == [
        text if name == "shap_e" else None for text, name in wanted
    ]
    # The process of a job reads its words with the same function as a line that was typed.
    for job in sweep.plan.jobs:
        assert [quoted(word, is_sweep=False) for word in job.overrides] == job.overrides
