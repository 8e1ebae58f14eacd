"""The plan of a sweep is believed only if every entry has the type that its class declares."""

import json
from dataclasses import asdict
from pathlib import Path

import pytest

from cadam3d.core.errors import UserError
from cadam3d.io.jsonl import write_json
from cadam3d.sweep.folder import Job, Plan, read_plan, write_plan

JOB = Job(arm="cadam", name="cadam_seed=1", overrides=["prompt=a cube"], swept={"seed": 1})
PLAN = Plan(cwd="/tmp", flags=[], threads=2, jobs=[JOB], figures=None, line=["prompt=a cube"])


def test_a_plan_is_read_as_it_was_written(tmp_path: Path):
    write_plan(tmp_path, PLAN)
    assert read_plan(tmp_path) == PLAN


@pytest.mark.parametrize("key", [*asdict(PLAN), *(f"jobs.{key}" for key in asdict(JOB))])
def test_no_entry_of_a_plan_has_another_type(tmp_path: Path, key: str):
    for wrong in (0.5, "x\0", [7], [["x"]]):
        content = asdict(PLAN)
        name = key.removeprefix("jobs.")
        (content["jobs"][0] if name != key else content)[name] = wrong
        write_json(tmp_path / "jobs.json", content)
        with pytest.raises(UserError, match="not the plan of a sweep"):
            read_plan(tmp_path)


@pytest.mark.parametrize("content", [None, [], "x", 7, {}, {"jobs": 7}])
def test_other_json_is_not_a_plan(tmp_path: Path, content):
    (tmp_path / "jobs.json").write_text(json.dumps(content))
    with pytest.raises(UserError, match="not the plan of a sweep"):
        read_plan(tmp_path)


@pytest.mark.parametrize("name", ["", ".", "..", "../x", "/tmp/x", "a/b", "a\\b", "x\0"])
def test_the_folder_of_a_job_is_inside_that_of_the_sweep(tmp_path: Path, name: str):
    content = asdict(PLAN)
    content["jobs"][0]["name"] = name
    write_json(tmp_path / "jobs.json", content)
    with pytest.raises(UserError, match="not the plan of a sweep"):
        read_plan(tmp_path)
