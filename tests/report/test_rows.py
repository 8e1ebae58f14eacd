"""Jobs become rows: what is a setting, what is a cell, and what may be compared."""

import json

import pytest

from cadam3d.report.rows import Setting, at_noise, counts, histograms, in_noise_order, measured, read


def test_a_threshold_that_varies_within_an_arm_makes_settings(jobs):
    for tau in (0.0002, 0.001):
        jobs.add("baseline", f"densifier.tau_pos={tau}", n=100, psnr=20.0)
    jobs.add("cadam", n=100, psnr=20.0)
    rows = read(jobs.folder)
    assert [row.setting.name for row in rows] == [
        "baseline (tau_pos 0.0002)",
        "baseline (tau_pos 0.001)",
        "cadam",
    ]
    assert len({row.cell for row in rows}) == 1


def test_a_job_that_leaves_a_swept_threshold_alone_has_the_shipped_one(jobs):
    jobs.add("baseline", n=100, psnr=20.0)
    jobs.add("baseline", "densifier.tau_pos=0.001", n=100, psnr=20.0)
    rows = read(jobs.folder)
    assert rows[0].setting == Setting("baseline", (("tau_pos", 0.0002),))
    assert [row.is_standard for row in rows] == [True, False]


def test_a_changed_threshold_is_no_standard_even_if_it_never_varies(jobs):
    jobs.add("baseline", "densifier.tau_pos=0.001", n=100, psnr=20.0)
    assert not read(jobs.folder)[0].is_standard


def test_the_key_of_a_schedule_has_its_shipped_value_too(jobs):
    for start in (0.35, 0.5, 0.65):
        jobs.add("cadam_annealed", f"densifier.tau_Q.start={start}", n=100, psnr=20.0)
    jobs.add("cadam_annealed", n=100, psnr=20.0)
    rows = read(jobs.folder)
    assert [row.is_standard for row in rows] == [False, True, False, True]
    assert rows[1].setting == rows[3].setting == Setting("cadam_annealed", (("tau_Q.start", 0.5),))


def test_a_number_in_place_of_a_schedule_is_not_the_shipped_one(jobs):
    jobs.add("cadam_annealed", "densifier.tau_Q=0.9", n=100, psnr=20.0)
    assert not read(jobs.folder)[0].is_standard


def test_where_no_threshold_is_the_shipped_one_nothing_is_standard(jobs):
    for growth in (0.05, 0.1):
        jobs.add("mcmc", "densifier.cap=1500", f"densifier.growth={growth}", n=100, psnr=20.0)
    assert not any(row.is_standard for row in read(jobs.folder))


def test_thresholds_may_be_words(jobs):
    for views in ("sum_norm", "last"):
        jobs.add("baseline", f"densifier.views={views}", n=100, psnr=20.0)
    assert [row.setting.short for row in read(jobs.folder)] == ["views sum_norm", "views last"]


@pytest.mark.parametrize(
    "axis", ["prompt=a cube,a torus", "seed=0,1", "noise=weak,strong", "guidance=sds,ism"]
)
def test_what_else_varies_within_an_arm_makes_cells(jobs, axis):
    key, values = axis.split("=")
    for value in values.split(","):
        jobs.add("cadam", f"{key}={value}", n=100, psnr=20.0)
    rows = read(jobs.folder)
    assert len({row.setting for row in rows}) == 1
    assert [row.cell[key] for row in rows] == values.split(",")


def test_what_only_tells_arms_apart_belongs_to_the_arm(jobs):
    jobs.add("cadam", n=100, psnr=20.0)
    jobs.add("baseline", "refine.reset_interval=null", n=100, psnr=20.0)
    assert len({row.cell for row in read(jobs.folder)}) == 1


def test_named_arms_of_one_densifier_stay_apart(jobs):
    first = jobs.add("cadam", "refine.reset_interval=null", n=100, psnr=20.0)
    second = jobs.add("cadam", n=100, psnr=20.0)
    planned = [
        {
            "folder": first.name,
            "arm": "no_reset",
            "overrides": ["densifier=cadam", "refine.reset_interval=null"],
        },
        {"folder": second.name, "arm": "paper", "overrides": ["densifier=cadam"]},
        {"folder": "waits", "arm": "paper", "overrides": ["densifier=cadam", "seed=1"]},
    ]
    (jobs.folder / "jobs.json").write_text(json.dumps({"jobs": planned}))
    rows = read(jobs.folder)
    assert [row.arm for row in rows] == ["no_reset", "paper", "paper"]
    assert rows[0].cell == rows[1].cell
    assert rows[2].outcome == "unfinished"


@pytest.mark.parametrize(
    ("outcome", "may"),
    [
        ("finished", True),
        ("max_gaussians", True),
        ("out_of_memory", True),
        ("failed", False),
        ("interrupted", False),
        ("vanished", False),
    ],
)
def test_only_assets_at_an_end_are_measured(jobs, outcome, may):
    jobs.add("cadam", n=100, psnr=20.0, outcome=outcome)
    row = read(jobs.folder)[0]
    assert row.is_measured == may
    assert row.ended_early == (outcome != "finished")


def test_a_job_without_a_summary_is_unfinished(jobs):
    (jobs.add("cadam", n=100, psnr=20.0) / "summary.json").unlink()
    rows = read(jobs.folder)
    assert rows[0].outcome == "unfinished"
    assert measured(rows) == []


def test_jobs_come_in_the_order_of_their_numbers(jobs):
    for seed in range(12):
        jobs.add("cadam", f"seed={seed}", n=100, psnr=20.0)
    assert [row.cell["seed"] for row in read(jobs.folder)] == [str(seed) for seed in range(12)]


def test_a_prompt_with_commas_and_quotes_comes_back_whole(jobs):
    folder = jobs.add("cadam", n=100, psnr=20.0)
    line = r"prompt='a red, \'old\' cube=1'"
    (folder / ".hydra/overrides.yaml").write_text(json.dumps(["densifier=cadam", line]))
    assert read(jobs.folder)[0].cell["prompt"] == "a red, 'old' cube=1"


def test_counts_show_a_refinement_as_a_jump(jobs):
    folder = jobs.add("cadam", n=2400, psnr=20.0)
    jobs.files(folder, 2400)
    assert counts(read(jobs.folder)[0]) == [
        *((1, 300), (40, 300), (40, 600), (80, 600), (80, 1200), (120, 1200), (120, 2400)),
    ]


def test_histograms_are_read_by_score_or_the_first_there_is(jobs):
    jobs.files(jobs.add("baseline", n=600, psnr=20.0), 600)
    row = read(jobs.folder)[0]
    assert histograms(row, "snr") == []
    assert [line.step for line in histograms(row)] == [40, 80, 120]


def test_noise_runs_from_none_to_strong(jobs):
    assert in_noise_order(["strong", "weak", "none", "medium", "weak", "zzz"]) == [
        *("none", "weak", "medium", "strong", "zzz")
    ]
    jobs.add("cadam", "noise=weak", n=100, psnr=20.0)
    jobs.add("cadam", "noise=strong", n=100, psnr=20.0)
    assert len(at_noise(read(jobs.folder), "weak")) == 1
