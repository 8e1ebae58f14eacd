"""Jobs become results: which keys make settings and cells, and which results may be compared."""

import json

import pytest
from declarations import declared

from cadam3d.report.results import at_noise, histograms, levels_of, measured, read


def test_a_threshold_that_varies_within_an_arm_makes_settings(jobs):
    for tau in (0.0002, 0.001):
        jobs.add("baseline", f"densifier.tau_pos={tau}", n=100, psnr=20.0)
    jobs.add("cadam", n=100, psnr=20.0)
    results = read(jobs.folder)
    assert [result.setting.name for result in results] == [
        "baseline (tau_pos 0.0002)",
        "baseline (tau_pos 0.001)",
        "cadam",
    ]
    assert len({result.cell for result in results}) == 1


def test_a_setting_with_the_shipped_threshold_is_standard(jobs):
    for tau in (0.0002, 0.001):
        jobs.add("baseline", f"densifier.tau_pos={tau}", n=100, psnr=20.0)
    for start in (0.35, 0.5):
        jobs.add("cadam_annealed", f"densifier.tau_Q.start={start}", n=100, psnr=20.0)
    assert [result.is_standard for result in read(jobs.folder)] == [True, False, False, True]


def test_a_number_in_place_of_a_schedule_is_not_standard(jobs):
    jobs.add("cadam_annealed", "densifier.tau_Q=0.9", n=100, psnr=20.0)
    assert not read(jobs.folder)[0].is_standard


def test_without_a_shipped_threshold_no_result_is_standard(jobs):
    for growth in (0.05, 0.1):
        jobs.add("mcmc", "densifier.cap=1500", f"densifier.growth={growth}", n=100, psnr=20.0)
    assert not any(result.is_standard for result in read(jobs.folder))


def test_a_job_that_may_face_any_side_is_judged_at_its_best_turn(jobs):
    turned = {"psnr_turned": 15.5, "ssim_turned": 0.7, "turn_deg": 40.0}
    more = {"psnr_start": 12.0, "iou": 0.8, "iou_start": 0.6, "colour_error": 9.0}
    jobs.add("cadam", n=100, psnr=12.5, ssim=0.5, **turned, **more)
    jobs.add("baseline", n=100, psnr=12.5, ssim=0.5)
    cadam, baseline = read(jobs.folder)
    assert turned.items() | more.items() <= cadam.numbers.items()
    assert not {"psnr", "ssim"} & cadam.numbers.keys()
    assert (baseline.numbers["psnr"], baseline.numbers["ssim"]) == (12.5, 0.5)
    assert not (turned.keys() | more.keys()) & baseline.numbers.keys()


def test_a_job_without_a_psnr_has_that_of_its_evaluation(jobs):
    """An evaluation of another asset, and one that cannot be read, do not count."""
    for count, psnr in ((100, None), (100, 20.0), (99, None)):
        folder = jobs.add("cadam", f"seed={count}", n=100, psnr=psnr)
        (folder / "eval.json").write_text(
            json.dumps(declared({"num_gaussians": count, "psnr": 15.0, "iou": "much"}))
        )
    (jobs.add("cadam", "seed=3", n=100, psnr=None) / "eval.json").write_text("[1")
    results = read(jobs.folder)
    assert [result.numbers.get("psnr") for result in results] == [15.0, 20.0, None, None]
    assert not any("iou" in result.numbers for result in results)


@pytest.mark.parametrize(
    "axis", ["prompt=a cube,a torus", "seed=0,1", "noise=weak,strong", "guidance=sds,ism"]
)
def test_any_other_key_that_varies_within_an_arm_makes_cells(jobs, axis):
    key, values = axis.split("=")
    for value in values.split(","):
        jobs.add("cadam", f"{key}={value}", n=100, psnr=20.0)
    results = read(jobs.folder)
    assert len({result.setting for result in results}) == 1
    assert [result.cell[key] for result in results] == values.split(",")


def test_a_key_that_only_differs_between_arms_belongs_to_the_arm(jobs):
    jobs.add("cadam", n=100, psnr=20.0)
    jobs.add("baseline", "refine.reset_interval=null", n=100, psnr=20.0)
    assert len({result.cell for result in read(jobs.folder)}) == 1


def test_named_arms_of_one_densifier_are_distinguished(jobs):
    jobs.add("cadam", "refine.reset_interval=null", n=100, psnr=20.0, arm="no_reset")
    jobs.add("cadam", n=100, psnr=20.0, arm="paper")
    jobs.plan("paper", ["densifier=cadam", "seed=1"])
    results = read(jobs.folder)
    assert [result.arm for result in results] == ["no_reset", "paper", "paper"]
    assert results[0].cell == results[1].cell
    assert results[2].outcome == "unfinished"


@pytest.mark.parametrize(
    ("outcome", "is_measured"),
    [
        ("finished", True),
        ("max_gaussians", True),
        ("out_of_memory", True),
        ("failed", False),
        ("interrupted", False),
        ("vanished", False),
    ],
)
def test_only_jobs_with_a_final_asset_are_measured(jobs, outcome, is_measured):
    jobs.add("cadam", n=100, psnr=20.0, outcome=outcome)
    result = read(jobs.folder)[0]
    assert result.is_measured == is_measured
    assert result.ended_early == (outcome != "finished")


def test_a_job_without_a_summary_is_unfinished(jobs):
    (jobs.add("cadam", n=100, psnr=20.0) / "summary.json").unlink()
    results = read(jobs.folder)
    assert results[0].outcome == "unfinished"
    assert measured(results) == []


def test_a_prompt_with_commas_and_quotes_is_read_back_unchanged(jobs):
    jobs.add("cadam", r"prompt='a red, \'old\' cube=1'", n=100, psnr=20.0)
    assert read(jobs.folder)[0].cell["prompt"] == "a red, 'old' cube=1"


def test_histograms_are_read_of_the_given_or_the_first_score(jobs):
    jobs.files(jobs.add("baseline", n=600, psnr=20.0), 600)
    result = read(jobs.folder)[0]
    assert histograms(result, "shake") == []
    assert [line["step"] for line in histograms(result)] == [40, 80, 120]


def test_noise_levels_are_in_the_order_of_the_sweep(jobs):
    for level in ("strong", "none", "weak"):
        jobs.add("cadam", f"noise={level}", n=100, psnr=20.0)
    results = read(jobs.folder)
    assert levels_of(results) == ["strong", "none", "weak"]
    assert len(at_noise(results, "weak")) == 1
