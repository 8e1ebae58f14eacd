"""A dry run of a sweep: its list of jobs and its estimate of time. Nothing runs and nothing is written."""

import json
from pathlib import Path

import pytest

from cadam3d.io.run_folder import ENDED
from cadam3d.sweep import preview
from cadam3d.sweep.folder import Plan, Row


def row(number: int, folder: Path, *, wall: float | None = None, arm: str = "", **summary) -> Row:
    """Return a job, with a result if it has a time."""
    place = folder / f"job{number}"
    if wall is not None:
        place.mkdir()
        (place / ENDED).write_text(json.dumps({"exit_code": 0, "seconds": wall}))
        summary = {"outcome": "finished", "warnings": [], **summary}
    return Row(number, arm, place, [], {"prompt": "a cube", "seed": number}, summary)


def estimate(rows, steps, side_by_side=1) -> str:
    plan = Plan(cwd=".", flags=[], threads=None, jobs=[])
    return preview.estimate(rows, steps, plan, side_by_side, Path("unused"))


def test_the_estimate_is_the_mean_time_of_the_jobs_with_a_result(tmp_path):
    rows = [row(0, tmp_path, wall=10.0), row(1, tmp_path, wall=30.0), *(row(i, tmp_path) for i in (2, 3, 4))]
    assert estimate(rows, [100] * 5) == (
        "About 60 s for 3 jobs, one after another. Based on the 2 jobs with a result."
    )


def test_jobs_are_estimated_from_those_of_their_own_arm_if_there_are_any(tmp_path):
    rows = [row(0, tmp_path, wall=10.0, arm="slow"), row(1, tmp_path, wall=2.0, arm="fast")]
    rows += [row(2, tmp_path, arm="slow"), row(3, tmp_path, arm="fast"), row(4, tmp_path, arm="other")]
    assert estimate(rows, [100] * 5).startswith("About 18 s for 3 jobs")


def test_the_time_of_a_job_is_in_proportion_to_its_steps(tmp_path):
    rows = [row(0, tmp_path, wall=10.0, steps_asked=100), row(1, tmp_path)]
    assert estimate(rows, [100, 300]).startswith("About 30 s for 1 job,")


def test_a_job_without_a_record_of_its_process_counts_its_training(tmp_path):
    done = row(0, tmp_path, wall=10.0, seconds=7.0)
    (done.folder / ENDED).write_text("{")
    assert estimate([done, row(1, tmp_path)], [100, 100]).startswith("About 7 s for 1 job,")


@pytest.mark.parametrize("seconds", ["soon", -1, 0, True, None, [3]])
def test_times_that_are_no_numbers_are_ignored(tmp_path, seconds):
    strange = row(0, tmp_path, wall=10.0, seconds=seconds)
    (strange.folder / ENDED).write_text(json.dumps({"seconds": seconds}))
    rows = [strange, row(1, tmp_path, wall=5.0), row(2, tmp_path)]
    assert estimate(rows, [100] * 3).startswith("About 5 s for 1 job,")


@pytest.mark.parametrize(
    ("side_by_side", "expected"),
    [
        (2, "About 20 s for 4 jobs, 2 at a time."),
        (64, "About 10 s for 4 jobs, 4 at a time."),
        (None, "About 40 s of computing for 4 jobs, divided by how many run at once."),
    ],
)
def test_jobs_side_by_side_take_less_time(tmp_path, side_by_side, expected):
    rows = [row(0, tmp_path, wall=10.0), *(row(i, tmp_path) for i in range(1, 5))]
    assert estimate(rows, [100] * 5, side_by_side).startswith(expected)


def test_a_measured_pace_has_a_part_that_does_not_grow_with_the_steps():
    pace = preview.Pace(step_seconds=0.5, other_seconds=3.0)
    assert pace.seconds(10) == 8.0
