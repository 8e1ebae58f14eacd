"""Figures show the given results, and without data there is no figure."""

import re

import pytest

from cadam3d.core.palette import ARMS, DARK, css
from cadam3d.report import figures
from cadam3d.report.compare import qualities
from cadam3d.report.results import measured, read
from cadam3d.report.style import inline, looks, styled, write_figure
from cadam3d.report.sweep_page import KINDS


def texts(figure) -> str:
    return " | ".join(
        text.get_text() for text in figure.findobj(match=lambda each: hasattr(each, "get_text"))
    )


def draw(name, results):
    with styled():
        return KINDS[name].draw(results)


@pytest.mark.parametrize("name", KINDS)
def test_without_jobs_there_is_no_figure(name):
    assert draw(name, []) is None


@pytest.mark.parametrize("name", KINDS)
def test_jobs_that_failed_before_they_wrote_anything_make_no_figure(name, jobs):
    jobs.add("cadam", n=0, psnr=None, outcome="failed")
    assert draw(name, read(jobs.folder)) is None


@pytest.mark.parametrize("name", KINDS)
def test_jobs_with_nothing_but_a_summary_raise_no_error(name, jobs):
    for arm in ("cadam", "baseline"):
        for guidance in ("sds", "ism"):
            jobs.add(arm, f"guidance={guidance}", n=100, psnr=20.0)
    draw(name, read(jobs.folder))


def test_a_frontier_has_a_panel_per_noise_level_and_names_thresholds(bench_results):
    figure = draw("frontier", bench_results)
    assert [axes.get_title(loc="left") for axes in figure.axes] == [
        "no noise",
        "medium noise",
        "strong noise",
    ]
    shown = texts(figure)
    for expected in ("0.0002", "0.004", "baseline: tau_pos", "cadam: tau_Q, tau_SNR", "none"):
        assert expected in shown


def test_a_frontier_puts_each_setting_where_its_median_is(jobs):
    for seed, psnr in enumerate((20.0, 21.0, 22.0)):
        jobs.add("cadam", f"seed={seed}", n=1000 * (seed + 1), psnr=psnr)
        jobs.add("none", f"seed={seed}", n=100, psnr=18.0)
    marks = [
        tuple(float(x) for x in (*line.get_xdata(), *line.get_ydata()))
        for line in draw("frontier", read(jobs.folder)).axes[0].lines
        if line.get_marker() not in (None, "None", "")
    ]
    assert marks == [(2000.0, 3.0), (100.0, 0.0)]


def test_any_declared_number_has_a_frontier(jobs):
    for seed, ssim in enumerate((0.8, 0.85, 0.95)):
        jobs.add("cadam", f"seed={seed}", n=1000, psnr=20.0, ssim=ssim)
        jobs.add("none", f"seed={seed}", n=100, psnr=18.0, ssim=0.7)
    jobs.add("cadam", "seed=3", n=1000, psnr=20.0, ssim=None)
    results = read(jobs.folder)
    with styled():
        figure = figures.frontier_figure(results, measured(results)[0].declared["ssim"])
    assert figure is not None
    marks = [
        tuple(round(float(x), 9) for x in (*line.get_xdata(), *line.get_ydata()))
        for line in figure.axes[0].lines
        if line.get_marker() not in (None, "None", "")
    ]
    assert marks == [(1000.0, 0.15), (100.0, 0.0)]
    assert figure.axes[0].get_ylabel() == "SSIM, gain over no growth"
    assert "PSNR" not in texts(figure)


def test_assets_without_a_truth_are_compared_by_a_score(jobs):
    for arm, n in (("cadam", 100), ("baseline", 1000)):
        jobs.add(arm, n=n, psnr=None, ssim=None, clip_score=30.0)
    results = read(jobs.folder)
    assert [number.name for number in qualities(results)] == ["clip_score"]
    assert draw("frontier", results).axes[0].get_ylabel() == "CLIP score"


def test_a_setting_with_an_early_end_has_a_dagger(jobs):
    jobs.add("baseline", "densifier.tau_pos=0.0002", n=1000, psnr=20.0)
    jobs.add("baseline", "densifier.tau_pos=0.001", n=500, psnr=19.0, outcome="max_gaussians")
    shown = texts(draw("frontier", read(jobs.folder)))
    assert "0.001\u2020" in shown
    assert "0.0002\u2020" not in shown


def test_growth_is_the_median_over_cells_at_each_step():
    steps, low, middle, high = figures.over_time(
        [[(0, 100), (50, 100), (50, 200)], [(0, 100), (50, 100), (50, 400)], [(0, 100), (100, 300)]]
    )
    assert steps.tolist() == [0, 50, 100]
    assert middle.tolist() == [100, 200, 300]
    assert low.tolist() == [100, 150, 250]
    assert high.tolist() == [100, 300, 350]


def test_the_thresholds_of_the_arm_that_varies_two_are_drawn(bench_results):
    assert figures.arm_of_two_thresholds(bench_results) == "cadam"
    figure = draw("thresholds", bench_results)
    assert len(figure.axes) == 3
    assert figure.axes[0].get_xlabel() == "tau_Q"


def test_masks_show_arms_by_steps(bench_results):
    figure = draw("masks", bench_results)
    assert len(figure.axes) == 9
    assert "10 of 100" in texts(figure)
    assert "medium noise" in texts(figure)


def test_assets_show_objectives_by_arms_with_count_and_quality(bench_results, jobs):
    assert len(draw("assets", bench_results).axes) == 3
    for arm in ("baseline", "cadam"):
        for guidance in ("sds", "vfds"):
            jobs.files(jobs.add(arm, f"guidance={guidance}", n=500, psnr=21.0), 500)
    figure = draw("assets", read(jobs.folder))
    assert len(figure.axes) == 4
    assert "vfds" in texts(figure)
    assert "500 Gaussians\n21.00 dB" in texts(figure)


def test_arms_look_different_and_have_the_colours_of_the_palette_in_order():
    arms = [f"mine_{i}" for i in range(30)]
    found = looks(iter(arms))
    assert len({(look.color, look.marker) for look in found.values()}) == len(arms)
    assert [found[arm].color for arm in arms[: len(ARMS)]] == list(ARMS)
    assert len(set(ARMS.values())) == len(ARMS)


@pytest.mark.parametrize("name", ["masks", "assets"])
def test_unknown_arms_differ_in_pictures_too(jobs, name):
    for arm in ("aaa", "bbb", "ccc"):
        for guidance in ("sds", "ism"):
            jobs.files(jobs.add(arm, f"guidance={guidance}", n=500, psnr=20.0), 500)
    figure = draw(name, read(jobs.folder))
    words = figure.findobj(
        match=lambda each: hasattr(each, "get_text") and each.get_text() in ("aaa", "bbb", "ccc")
    )
    assert len({text.get_color() for text in words}) == 3


def test_written_figures_keep_their_text_and_leave_colours_to_the_page(tmp_path, bench_results):
    results = bench_results
    with styled():
        svg = write_figure(draw("growth", results), tmp_path, "growth")
        again = write_figure(draw("growth", results), tmp_path, "growth")
    assert svg == again
    assert (tmp_path / "growth.png").stat().st_size > 1000
    assert re.search(r"<text[^>]*>\s*cadam \(tau_Q 0.9, tau_SNR 0.1\)\s*</text>", svg)
    page = inline(svg)
    assert page.startswith("<svg")
    assert "<?xml" not in page
    for color in DARK:
        assert color not in re.sub(r"var\([^)]*\)", "", page)
    named = set(re.findall(r"var\(--([\w-]+)", page))
    assert {"arm-0072b2", "ink", "soft"} <= named
    assert named <= set(re.findall(r"--([\w-]+):", css()))
