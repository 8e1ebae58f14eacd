"""The page of a sweep is self-contained, names what failed, and is safe against whatever a user typed."""

import csv
import html
import re
import shlex

import pytest

from cadam3d import report
from cadam3d.core.errors import UserError
from cadam3d.report import sweep_page, tables
from cadam3d.report.pages import table
from cadam3d.report.results import read


@pytest.fixture(scope="module")
def whole(bench):
    return report.write_sweep(bench).read_text(encoding="utf-8")


def text_of(content: str) -> str:
    return " ".join(re.sub(r"<[^>]*>", " ", content).split())


def test_a_whole_comparison_has_verdict_figures_tables_failures_and_command(whole, bench):
    text = text_of(whole)
    for expected in (
        *("finished 144", "failed 1", "3 noise levels"),
        *(
            "fewer Gaussians than baseline (tau_pos 0.0002)",
            "At strong noise: cadam (tau_Q 0.9, tau_SNR 0.1)",
        ),
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
    assert 'cadam3d sweep grid=mine "prompt=a cube"\ncadam3d train densifier=cadam "prompt=a cube"' in text


def test_figures_and_tables_are_files_too(whole, bench):
    names = {path.name for path in (bench / "figures").iterdir()}
    drawn = {"frontier", "frontier_ssim", "growth", "shake", "masks", "thresholds", "regimes", "ablation"}
    assert {f"{name}.{kind}" for name in drawn for kind in ("svg", "png")} <= names
    assert {"objectives.csv", "frontiers.csv", "standings.csv"} <= names
    with (bench / "figures/frontiers.csv").open(newline="") as file:
        lines = list(csv.DictReader(file))
    assert len(lines) == 3 * 8
    assert {line["noise"] for line in lines} == {"none", "medium", "strong"}


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


def heading(folder) -> str:
    """Return the heading of the page of a sweep, which must also be its title."""
    page = report.write_sweep(folder).read_text(encoding="utf-8")
    found = re.search(r"<h1>(.*)</h1>", page)
    assert found is not None
    assert f"<title>{found.group(1)} - cadam3d</title>" in page
    return html.unescape(found.group(1))


def test_the_title_of_a_grid_is_its_name_with_the_prompts(jobs):
    jobs.line = ["steps=60", "grid='thresholds'", "prompt=a red torus"]
    for tau in (0.1, 0.2):
        jobs.add("cadam", "prompt=a red torus", f"densifier.tau_Q={tau}", n=100, psnr=20.0)
    assert heading(jobs.folder) == "thresholds: a red torus"


def test_the_title_of_a_list_names_the_keys_that_vary_and_some_prompts(jobs):
    for prompt in ("a red torus", "a blue cube", "a <b>", "a cone", "a very " + "long " * 30 + "prompt"):
        for arm in ("baseline", "cadam"):
            for seed in (0, 1):
                jobs.add(arm, f"prompt='{prompt}'", f"seed={seed}", n=100, psnr=20.0)
    assert heading(jobs.folder) == "Sweep of densifier and seed: a red torus, a blue cube, a <b> and 2 more"


def test_the_title_of_a_list_of_prompts_has_no_other_key(jobs):
    jobs.add("cadam", "prompt=a cube", n=100, psnr=20.0)
    jobs.add("cadam", "prompt=" + "long " * 30, n=100, psnr=20.0)
    assert heading(jobs.folder) == f"Sweep: a cube, {'long ' * 11}..."


@pytest.mark.parametrize("prompts", [1, 2, 4, 5])
def test_a_page_shows_quartiles_only_with_enough_prompts(jobs, prompts):
    for prompt in range(prompts):
        for seed in range(3):
            for arm, n in (("none", 50), ("baseline", 1000), ("cadam", 100)):
                words = (f"prompt=thing {prompt}", f"seed={seed}")
                jobs.files(jobs.add(arm, *words, n=n + seed + prompt, psnr=20.0 + seed), n)
    page = report.write_sweep(jobs.folder).read_text(encoding="utf-8")
    # The captions state the rule.
    numbers = text_of(page.replace(html.escape(sweep_page.SPREAD), ""))
    assert ("quartiles" in numbers) == (prompts == 5)
    assert ("lowest" in numbers) == (prompts in (2, 4))


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
    assert "figures: no figure is called pie. The figures of this sweep are frontier," in text
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


def test_commands_can_be_pasted():
    words = ["densifier=cadam", "prompt='a cube'", "prompt='it''s $5'", "seed=0"]
    assert [shlex.split(sweep_page.for_shell(word)) for word in words] == [[word] for word in words]
    assert sweep_page.for_shell("prompt='a cube'") == "\"prompt='a cube'\""


def test_a_figure_can_be_requested_by_name(jobs):
    jobs.files(jobs.add("cadam", n=100, psnr=20.0), 100)
    sweep_page.write(jobs.folder, ["growth"])
    assert [path.stem for path in (jobs.folder / "figures").glob("*.svg")] == ["growth"]


# Tables.


def test_standings_show_the_spread_over_seeds_and_what_is_out_of_reach(jobs):
    for seed, psnr in enumerate((9.0, 9.2)):
        for tau, n, best in ((0.001, 100, 10.0), (0.0002, 10000, 20.0)):
            jobs.add("baseline", f"densifier.tau_pos={tau}", f"seed={seed}", n=n, psnr=best)
        jobs.add("cadam", f"seed={seed}", n=1000, psnr=psnr)
    jobs.add("cadam", "seed=2", n=1000, psnr=9.0)
    [line] = tables.standings_table(read(jobs.folder))
    assert line["over seeds (dB)"] == 0.14
    assert (line["baseline needs times"], line["always exceeds"], line["never reaches"]) == ("always", 2, 0)
    assert line["unpaired"] == 1


def test_an_arm_without_a_standard_setting_is_named_below_the_key_table(jobs):
    jobs.add("cadam", n=100, psnr=20.0)
    for growth in (0.1, 0.2):
        jobs.add("mcmc", f"densifier.growth={growth}", n=100, psnr=20.0)
    text = text_of(report.write_sweep(jobs.folder).read_text(encoding="utf-8"))
    assert "mcmc has no standard setting and appears only in the table of all settings." in text


@pytest.mark.parametrize(("zero", "title", "expected"), [(True, "SSIM gain", 0.15), (False, "SSIM", 0.85)])
def test_the_table_of_frontiers_has_ssim(jobs, zero, title, expected):
    for seed, ssim in enumerate((0.8, 0.85, 0.95)):
        jobs.add("cadam", f"seed={seed}", n=100, psnr=20.0, ssim=ssim)
        if zero:
            jobs.add("none", f"seed={seed}", n=10, psnr=10.0, ssim=0.7)
    line = next(line for line in tables.frontier_table(read(jobs.folder)) if line["setting"] == "cadam")
    assert line[title] == pytest.approx(expected)


def test_the_table_of_frontiers_counts_cells_that_it_left_out(jobs):
    jobs.add("none", "seed=0", n=10, psnr=10.0)
    for seed in (0, 1):
        jobs.add("cadam", f"seed={seed}", n=100, psnr=20.0)
    lines = {line["setting"]: line for line in tables.frontier_table(read(jobs.folder))}
    assert (lines["cadam"]["cells"], lines["cadam"]["left out"]) == (1, 1)
    assert lines["none"]["left out"] is None


def test_the_key_table_counts_cells_that_only_one_of_two_has(jobs):
    for seed in (0, 1):
        jobs.add("baseline", f"seed={seed}", n=1000, psnr=20.0)
    jobs.add("cadam", "seed=0", n=100, psnr=20.0)
    jobs.add("cadam", "seed=1", n=100, psnr=None, outcome="failed")
    assert [line["unpaired"] for line in tables.objectives_table(read(jobs.folder))] == [None, 1]


def test_the_key_table_has_a_line_per_objective_level_and_arm(jobs):
    for guidance in ("sds", "ism"):
        for arm, n in (("baseline", 1000), ("cadam", 100)):
            jobs.add(arm, f"guidance={guidance}", n=n, psnr=20.0)
    lines = tables.objectives_table(read(jobs.folder))
    assert [(line["objective"], line["arm"]) for line in lines] == [
        *(("ism", "baseline"), ("ism", "cadam"), ("sds", "baseline"), ("sds", "cadam")),
    ]
    assert lines[1]["fewer than baseline"] == "90.0%"
    assert lines[1]["MiB"] == pytest.approx(68 * 100 / 2**20, abs=1e-3)


def test_empty_columns_are_left_out(jobs):
    jobs.add("cadam", n=100, psnr=20.0)
    lines = tables.objectives_table(read(jobs.folder))
    assert "noise" not in lines[0]
    assert "fewer than baseline" not in lines[0]


def test_numbers_of_a_column_have_the_same_decimals():
    content = table([{"PSNR": 20.9, "n": 12345}, {"PSNR": 21.25, "n": 1}], align_decimals=True)
    assert content.lines == [["20.90", "12,345"], ["21.25", "1"]]


def test_text_is_aligned_to_the_left_and_percentages_like_numbers():
    content = table([{"arm": "cadam", "fewer": "94.2%", "n": 1}, {"arm": "none", "fewer": None, "n": None}])
    assert [column.is_text for column in content.columns] == [True, False, False]


def test_standings_need_a_frontier(jobs):
    jobs.add("cadam", n=100, psnr=20.0)
    jobs.add("baseline", n=1000, psnr=20.0)
    assert tables.standings_table(read(jobs.folder)) == []
