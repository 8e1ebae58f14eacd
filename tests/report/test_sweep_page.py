"""The page of a sweep is self-contained, names what failed, and is safe against whatever a user typed."""

import html
import json
import re

import pytest

from cadam3d import report
from cadam3d.core.errors import UserError
from cadam3d.report import tables
from cadam3d.report.pages import table
from cadam3d.report.results import read


@pytest.fixture(scope="module")
def whole(bench_page):
    return bench_page.read_text(encoding="utf-8")


def text_of(content: str) -> str:
    return " ".join(re.sub(r"<[^>]*>", " ", content).split())


def test_a_whole_comparison_has_tables_figures_failures_and_command(whole, bench):
    text = text_of(whole)
    for expected in (
        *("finished 144", "failed 1"),
        *("Differences between arms", "PSNR (dB) at equal count", "Medians of every setting"),
        *("Quality against count", "Gaussians over time", "Selected Gaussians", "Arms side by side"),
        *("Shaking of the Gaussians", "How much each Gaussian shakes.", "tau_shake 0.1"),
        *("Jobs that ended early, failed or are not done", "failed (no &lt;b&gt;)", "All 146 jobs"),
    ):
        assert expected in text, expected
    assert "cadam3d sweep grid=pareto" in text


def test_the_line_of_the_sweep_comes_before_those_of_its_jobs(jobs):
    jobs.line = ["grid=mine", "prompt=a cube"]
    jobs.add("cadam", "prompt=a cube", n=100, psnr=20.0)
    text = html.unescape(report.write_sweep(jobs.folder).read_text(encoding="utf-8"))
    assert "cadam3d sweep grid=mine 'prompt=a cube'\ncadam3d train densifier=cadam 'prompt=a cube'" in text


def test_the_page_fetches_nothing_and_runs_nothing(whole):
    assert "<script" not in whole
    assert not re.findall(r'(?:src|href)="https?:', whole)
    assert not re.findall(r"@import|url\(http", whole)


def test_every_job_links_to_its_own_report(whole, bench):
    links = set(re.findall(r'href="([^"]*)/report\.html"', whole))
    assert links == {result.folder.name for result in read(bench)}


def test_ids_are_not_shared_between_figures(whole):
    ids = re.findall(r'<clipPath id="([^"]*)"', whole)
    assert len(ids) == len(set(ids)) > 0


OF_CELLS = ("bars hold the middle half", "shaded areas", "Medians over cells")
OF_SETTINGS = ("it beside each mark", "standard setting is ringed", "A dagger")


def test_captions_describe_only_what_is_drawn(whole, jobs):
    for each in (*OF_CELLS, *OF_SETTINGS[:2]):
        assert each in text_of(whole)
    for arm in ("cadam", "baseline"):
        jobs.files(jobs.add(arm, n=1000, psnr=20.0), 1000)
    small = text_of(report.write_sweep(jobs.folder).read_text(encoding="utf-8"))
    assert "Each mark is one setting." in small
    for each in (*OF_CELLS, *OF_SETTINGS, "rows are objectives", "standard setting"):
        assert each not in small
    jobs.add("baseline", "densifier.tau_pos=0.001", n=500, psnr=19.0, outcome="max_gaussians")
    more = text_of(report.write_sweep(jobs.folder).read_text(encoding="utf-8"))
    for each in OF_SETTINGS:
        assert each in more


def test_an_unfinished_sweep_has_a_page_too(jobs):
    folder = jobs.add("cadam", n=100, psnr=20.0)
    jobs.add("baseline", n=1000, psnr=20.5)
    (folder / "summary.json").unlink()
    text = text_of(report.write_sweep(jobs.folder).read_text(encoding="utf-8"))
    assert "1 job is not done" in text
    assert "baseline" in text


def test_a_sweep_whose_jobs_all_failed_has_a_page_too(jobs):
    jobs.add("cadam", n=0, psnr=None, outcome="failed", message="out of luck")
    assert "failed (out of luck)" in text_of(report.write_sweep(jobs.folder).read_text(encoding="utf-8"))


def test_nothing_that_a_user_typed_becomes_markup(jobs):
    nasty = "<i>&"
    jobs.line = [f"prompt={nasty}"]
    jobs.figures = ["growth", nasty]
    jobs.add("cadam", f"prompt='{nasty}'", n=100, psnr=20.0, outcome="failed", message=nasty)
    jobs.files(jobs.add("cadam", f"prompt='{nasty}'", "seed=1", n=100, psnr=20.0, arm=nasty), 100)
    assert nasty not in report.write_sweep(jobs.folder).read_text(encoding="utf-8")


def test_the_title_of_a_list_names_some_prompts(jobs):
    for prompt in ("a red torus", "a <b>", "a very " + "long " * 30 + "prompt"):
        jobs.add("cadam", f"prompt='{prompt}'", n=100, psnr=20.0)
    page = html.unescape(report.write_sweep(jobs.folder).read_text(encoding="utf-8"))
    title = re.findall(r"<h1>(.*)</h1>", page)[0]
    assert title.startswith("Sweep: a red torus, a <b>, a very long ")
    assert title.endswith("long ...")
    assert f"<title>{title} - cadam3d</title>" in page


@pytest.mark.parametrize("prompts", [5, 6])
def test_a_page_has_intervals_only_with_enough_prompts(jobs, prompts):
    for prompt in range(prompts):
        for arm, n in (("baseline", 1000), ("cadam", 100)):
            jobs.add(arm, f"prompt=thing {prompt}", n=n + prompt, psnr=20.0)
    page = report.write_sweep(jobs.folder).read_text(encoding="utf-8")
    assert ("[+0.00, +0.00]" in page) == (prompts == 6)


def test_a_folder_that_is_not_a_sweep_is_refused(tmp_path):
    with pytest.raises(UserError, match="expected a sweep"):
        report.write_sweep(tmp_path)


def test_a_sweep_without_jobs_is_refused(jobs):
    jobs.write_plan()
    with pytest.raises(UserError, match="expected a sweep with jobs"):
        report.write_sweep(jobs.folder)


def test_the_plan_of_a_sweep_may_name_its_figures(jobs):
    jobs.figures = ["growth"]
    jobs.files(jobs.add("cadam", "seed=0", n=100, psnr=20.0, arm="paper"), 100)
    text = text_of(report.write_sweep(jobs.folder).read_text(encoding="utf-8"))
    assert "Gaussians over time" in text
    assert "Shaking" not in text
    assert "cadam3d train densifier=cadam seed=0" in text


def test_a_figure_that_does_not_exist_is_reported_and_the_others_are_drawn(jobs):
    jobs.figures = ["pie", "growth"]
    jobs.files(jobs.add("cadam", n=100, psnr=20.0), 100)
    text = text_of(report.write_sweep(jobs.folder).read_text(encoding="utf-8"))
    assert "got pie" in text
    assert "Gaussians over time" in text


def test_a_declared_score_is_a_figure_that_can_be_named(jobs):
    jobs.figures = ["shake"]
    jobs.files(jobs.add("cadam", n=100, psnr=20.0), 100)
    report.write_sweep(jobs.folder)
    assert [path.stem for path in (jobs.folder / "figures").glob("*.svg")] == ["shake"]


@pytest.mark.parametrize("content", ["", "[{]", '[{"score": "shake"}]'])
def test_damaged_declarations_leave_out_the_score_and_nothing_else(jobs, content):
    folder = jobs.add("cadam", n=100, psnr=20.0)
    jobs.files(folder, 100)
    (folder / "charts.json").write_text(content)
    text = text_of(report.write_sweep(jobs.folder).read_text(encoding="utf-8"))
    assert "Gaussians over time" in text
    assert "Shaking" not in text


def test_the_frontier_of_any_number_can_be_requested(jobs):
    jobs.figures = ["frontier_ssim"]
    for arm in ("baseline", "cadam"):
        jobs.add(arm, n=100, psnr=20.0, psnr_turned=21.0, ssim_turned=0.8)
    assert "SSIM at the best turn against count" in report.write_sweep(jobs.folder).read_text(
        encoding="utf-8"
    )


# Tables.


def test_the_comparison_has_an_estimate_of_every_difference(jobs):
    for i in range(6):
        where = (f"prompt=object {i}", "seed=0")
        for tau, n, best in ((0.001, 100, 10.0), (0.0002, 10000, 20.0)):
            jobs.add("baseline", f"densifier.tau_pos={tau}", *where, n=n, psnr=best + i, seconds=4.0)
        jobs.add("cadam", *where, n=1000, psnr=15.5 + i, seconds=3.0)
    jobs.add("cadam", "prompt=another", "seed=0", n=1000, psnr=9.0)
    results = read(jobs.folder)
    [line] = tables.shown_comparison(tables.comparison_table(results), results)
    assert line == {
        "setting": "cadam",
        "against": "baseline (tau_pos 0.0002)",
        "cells": 6,
        "Gaussians (%)": "-90.0 [-90.0, -90.0]",
        "PSNR (dB)": "-4.50 [-4.50, -4.50]",
        "seconds": "-1.0 [-1.0, -1.0]",
        "PSNR (dB) at equal count": "+0.50 [+0.50, +0.50]",
        "unpaired": 1,
    }
    assert "-4.50 [-4.50, -4.50]" in report.comparison(jobs.folder)


def test_any_two_arms_are_compared_whatever_their_names(jobs):
    for arm, n in (("red", 1000), ("green", 100), ("blue", 10)):
        jobs.add("cadam", n=n, psnr=20.0, arm=arm)
    results = read(jobs.folder)
    pairs = [(line["setting"], line["against"]) for line in tables.comparison_table(results)]
    assert pairs == [("green", "red"), ("blue", "red")]
    pairs = [(line["setting"], line["against"]) for line in tables.comparison_table(results, "blue")]
    assert pairs == [("red", "blue"), ("green", "blue")]


@pytest.mark.parametrize(("prompts", "is_possible"), [(6, False), (7, True)])
def test_a_page_shows_every_two_arms_and_whether_so_many_can_be_certain(jobs, prompts, is_possible):
    for i in range(prompts):
        for arm, psnr in (("red", 20.0), ("green", 20.0), ("my <b>own</b>", 21.5)):
            jobs.add("cadam", f"prompt=object {i}", n=100, psnr=psnr, arm=arm)
    text = text_of(html.unescape(report.write_sweep(jobs.folder).read_text(encoding="utf-8")))
    assert "corrected by Holm's method for all 3 pairs" in text
    assert ("no difference among so many pairs could be certain" in text) != is_possible
    difference = f"+1.50{' *' * is_possible} [+1.50, +1.50]"
    assert f"green +0.00 [+0.00, +0.00] - my own {difference} {difference}" in text
    assert "p corrected" in (jobs.folder / "figures/pairs.csv").read_text()


def test_a_page_with_two_arms_has_no_matrix(jobs):
    for arm in ("red", "green"):
        jobs.add("cadam", n=100, psnr=20.0, arm=arm)
    assert "Every two arms" not in report.write_sweep(jobs.folder).read_text(encoding="utf-8")


def test_numbers_of_a_metric_from_elsewhere_are_in_the_tables(jobs):
    entry = {"label": "shine", "unit": "lx", "digits": 1, "is_more_better": True, "preference": 1}
    for arm, shine in (("baseline", 2.0), ("cadam", 3.5)):
        folder = jobs.add(arm, n=100, psnr=20.0)
        summary = json.loads((folder / "summary.json").read_text())
        summary["numbers"]["shine"] = entry
        (folder / "summary.json").write_text(json.dumps({**summary, "shine": shine}))
    results = read(jobs.folder)
    [line] = tables.comparison_table(results)
    assert line["shine (lx)"].value == 1.5
    assert [line["shine (lx)"] for line in tables.medians_table(results)] == [2.0, 3.5]


def test_the_medians_have_a_line_per_objective_level_and_arm(jobs):
    for guidance in ("sds", "ism"):
        for arm, n in (("none", 10), ("cadam", 100)):
            jobs.add(arm, f"guidance={guidance}", n=n, psnr=20.0 + n)
    lines = tables.medians_table(read(jobs.folder))
    assert [(line["objective"], line["setting"]) for line in lines] == [
        *(("ism", "none"), ("ism", "cadam"), ("sds", "none"), ("sds", "cadam")),
    ]
    assert lines[1]["PSNR over no growth"] == 90.0
    assert lines[1]["size of asset.ply (MiB)"] == pytest.approx(68 * 100 / 2**20, abs=0.01)
    assert "noise" not in lines[0]


def test_numbers_of_a_column_have_the_same_decimals():
    content = table([{"PSNR": 20.9, "n": 12345}, {"PSNR": 21.25, "n": 1}], align_decimals=True)
    assert content.lines == [["20.90", "12,345"], ["21.25", "1"]]
