"""Figures show the given results, and without data there is no figure."""

import math
import re
from itertools import combinations

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from cadam3d.report import figures, pictures
from cadam3d.report.labels import Label, place_labels
from cadam3d.report.palette import ARMS, DARK, css
from cadam3d.report.results import read
from cadam3d.report.style import KNOWN, inline, looks, new_figure, spread_labels, styled, write_figure
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
    for expected in ("0.0002", "0.004", "baseline: tau_pos", "cadam: tau_Q, tau_SNR", "without noise"):
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
    assert marks == [(100.0, 0.0), (2000.0, 3.0)]


def test_a_frontier_of_ssim_shows_ssim(jobs):
    for seed, ssim in enumerate((0.8, 0.85, 0.95)):
        jobs.add("cadam", f"seed={seed}", n=1000, psnr=20.0, ssim=ssim)
        jobs.add("none", f"seed={seed}", n=100, psnr=18.0, ssim=0.7)
    jobs.add("cadam", "seed=3", n=1000, psnr=20.0, ssim=None)
    figure = draw("frontier_ssim", read(jobs.folder))
    marks = [
        tuple(round(float(x), 9) for x in (*line.get_xdata(), *line.get_ydata()))
        for line in figure.axes[0].lines
        if line.get_marker() not in (None, "None", "")
    ]
    assert marks == [(100.0, 0.0), (1000.0, 0.15)]
    assert figure.axes[0].get_ylabel() == "SSIM gained by growth"
    assert "PSNR" not in texts(figure)


def test_without_ssim_there_is_no_figure_of_it(jobs):
    for arm, n in (("cadam", 100), ("baseline", 1000)):
        jobs.add(arm, n=n, psnr=20.0, ssim=None)
    assert draw("frontier", read(jobs.folder)) is not None
    assert draw("frontier_ssim", read(jobs.folder)) is None


def test_a_setting_that_lacks_cells_is_hollow_and_an_early_end_has_a_dagger(jobs):
    for seed in (0, 1):
        jobs.add("baseline", "densifier.tau_pos=0.0002", f"seed={seed}", n=1000, psnr=20.0)
    jobs.add("baseline", "densifier.tau_pos=0.001", "seed=0", n=500, psnr=19.0, outcome="max_gaussians")
    figure = draw("frontier", read(jobs.folder))
    fills = {
        float(line.get_xdata()[0]): line.get_markerfacecolor()
        for line in figure.axes[0].lines
        if line.get_marker() == "o"
    }
    assert fills == {1000.0: "#d55e00", 500.0: "#ffffff"}
    assert "0.001\u2020" in texts(figure)
    assert "0.0002\u2020" not in texts(figure)


def test_growth_is_the_median_over_cells_at_each_step():
    steps, low, middle, high = figures.over_time(
        [[(0, 100), (50, 100), (50, 200)], [(0, 100), (50, 100), (50, 400)], [(0, 100), (100, 300)]],
        (0.0, 1.0),
    )
    assert steps.tolist() == [0, 50, 100]
    assert middle.tolist() == [100, 200, 300]
    assert low.tolist() == [100, 100, 200]
    assert high.tolist() == [100, 400, 400]


def test_a_job_that_ended_early_keeps_its_count():
    assert figures.over_time([[(0, 100), (10, 500)], [(0, 100), (20, 100)]], (0.25, 0.75))[2].tolist() == [
        100,
        300,
        300,
    ]


def test_the_thresholds_of_the_arm_that_varies_two_are_drawn(bench_results):
    assert figures.arm_of_two_thresholds(bench_results) == "cadam"
    figure = draw("thresholds", bench_results)
    assert len(figure.axes) == 6
    assert figure.axes[0].get_xlabel() == "tau_Q"


def test_masks_show_arms_by_steps(bench_results):
    figure = draw("masks", bench_results)
    assert len(figure.axes) == 9
    assert "10 of 100" in texts(figure)
    assert "medium noise" in texts(figure)


def test_a_mask_is_the_right_half_of_a_pair(bench_results):
    pair = np.arange(2 * 4 * 4 * 3).reshape(4, 8, 3)
    assert (pictures.mask_of(pair) == pair[:, 4:]).all()


def test_a_preview_is_cut_into_single_pictures(bench_results):
    result = next(result for result in bench_results if result.arm == "cadam")
    assert [picture.shape for picture in pictures.views(result)] == [(12, 12, 3)] * 3


def test_regimes_are_shown_in_a_cell_that_has_all_of_them(jobs):
    for seed, settings in ((0, {0.9: 500}), (1, {0.95: 400, 0.9: 500, 0.7: 900})):
        for tau, n in settings.items():
            keys = (f"densifier.tau_Q={tau}", f"densifier.tau_SNR={0.1 if tau == 0.9 else 0.3}")
            jobs.files(jobs.add("cadam", *keys, f"seed={seed}", n=n, psnr=20.0), n)
    shown = texts(draw("regimes", read(jobs.folder)))
    assert "seed 1" in shown
    assert "fewest: tau_Q 0.95" in shown
    assert "standard: tau_Q 0.9" in shown


def test_an_ablation_shows_count_quality_and_outcome(bench_results):
    shown = texts(draw("ablation", bench_results))
    assert shown.count("Gaussians\n") == 3
    assert "finished" in shown


def test_the_figure_of_objectives_needs_two_of_them(bench_results, jobs):
    assert draw("objectives", bench_results) is None
    for arm in ("baseline", "cadam"):
        for guidance in ("sds", "vfds"):
            jobs.files(jobs.add(arm, f"guidance={guidance}", n=500, psnr=21.0), 500)
    figure = draw("objectives", read(jobs.folder))
    assert len(figure.axes) == 4
    assert "VFDS" in texts(figure)
    assert "500, 21.00 dB" in texts(figure)


def test_an_arm_looks_the_same_in_every_figure_and_arms_look_different():
    few, many = looks(["cadam", "baseline"]), looks(["none", "cadam", "baseline", "cadam_calibrated", "mcmc"])
    assert few["cadam"] == many["cadam"]
    assert len({look.color for look in many.values()}) == len({look.marker for look in many.values()}) == 5


def test_a_dozen_unknown_arms_look_different_from_one_another_and_from_the_known():
    arms = [*KNOWN, *(f"mine_{i}" for i in range(12))]
    found = looks(iter(arms))
    assert len({(look.color, look.marker) for look in found.values()}) == len(arms)
    assert {look.color for look in found.values()} <= set(ARMS)
    assert len(set(ARMS.values())) == len(ARMS)


def test_common_arms_look_the_same_in_all_sweeps():
    for arm in ("none", "baseline", "cadam", "cadam_annealed", "cadam_selective", "random"):
        assert looks([arm])[arm] == looks([arm, "aaa"])[arm]


@pytest.mark.parametrize("name", ["masks", "ablation", "objectives"])
def test_unknown_arms_differ_in_pictures_too(jobs, name):
    for arm in ("aaa", "bbb", "ccc"):
        for guidance in ("sds", "ism"):
            jobs.files(jobs.add(arm, f"guidance={guidance}", n=500, psnr=20.0), 500)
    figure = draw(name, read(jobs.folder))
    words = figure.findobj(
        match=lambda each: hasattr(each, "get_text") and each.get_text() in ("aaa", "bbb", "ccc")
    )
    assert len({text.get_color() for text in words}) == 3


def test_labels_keep_their_distance_and_their_order():
    moved = spread_labels({"a": 0.0, "b": 0.1, "c": 5.0}, least=1.0)
    assert moved["b"] - moved["a"] >= 1.0 - 1e-12
    assert moved["c"] > moved["b"]
    assert sum(moved.values()) == pytest.approx(5.1)


def test_written_figures_keep_their_text_and_leave_colours_to_the_page(tmp_path, bench_results):
    results = bench_results
    with styled():
        svg = write_figure(draw("growth", results), tmp_path, "growth")
        again = write_figure(draw("growth", results), tmp_path, "growth")
    assert svg == again
    assert (tmp_path / "growth.png").stat().st_size > 1000
    assert re.search(r"<text[^>]*>\s*cadam\s*</text>", svg)
    page = inline(svg)
    assert page.startswith("<svg")
    assert "<?xml" not in page
    for color in DARK:
        assert color not in re.sub(r"var\([^)]*\)", "", page)
    named = set(re.findall(r"var\(--([\w-]+)", page))
    assert {"arm-0072b2", "ink", "soft"} <= named
    assert named <= set(re.findall(r"--([\w-]+):", css()))


def test_numbers_on_a_log_axis_are_plain(bench_results):
    figure = draw("growth", bench_results)
    labels = [label.get_text() for label in figure.axes[0].get_yticklabels()]
    assert "1k" in labels
    assert not any("10^" in label for label in labels)
    assert all(math.isfinite(value) for value in figure.axes[0].get_ylim())


def test_names_of_arms_at_the_same_place_do_not_overlap(jobs):
    for prompt in ("a cube", "a torus"):
        for arm, n, psnr in (("none", 300, 18.0), ("cadam", 1000, 20.0), ("cadam_annealed", 990, 20.0)):
            jobs.add(arm, f"prompt={prompt}", "noise=weak", n=n, psnr=psnr)
        for tau, n, psnr in ((2e-4, 20000, 20.5), (1.0, 1100, 19.9)):
            words = (f"densifier.tau_pos={tau}", f"prompt={prompt}", "noise=weak")
            jobs.add("baseline", *words, n=n, psnr=psnr)
    figure = draw("frontier", read(jobs.folder))
    [axes] = figure.axes
    renderer = FigureCanvasAgg(figure).get_renderer()
    names = [
        text for text in axes.texts if text.get_text() in ("none", "cadam", "cadam_annealed", "baseline")
    ]
    assert len(names) == 4
    boxes = [name.get_window_extent(renderer) for name in names]
    assert not any(one.overlaps(other) for one, other in combinations(boxes, 2))


def boxes_of(axes) -> tuple[list, list]:
    """Return the boxes of all texts in a panel, and the places of its marks in pixels."""
    figure = axes.get_figure()
    renderer = FigureCanvasAgg(figure).get_renderer()
    figure.draw_without_rendering()
    texts = [text.get_window_extent(renderer) for text in axes.texts if text.get_text()]
    lines = [line for line in axes.lines if line.get_marker() not in ("", "None", None)]
    marks = [mark for line in lines for mark in axes.transData.transform(np.column_stack(line.get_data()))]
    return texts, marks


def nasty(name: str, arm: int, i: int, rng) -> tuple[float, float]:
    """Return count and PSNR of setting ``i`` of an arm."""
    return {
        "all at one point": (1000.0, 20.0),
        "a diagonal": (1000.0 * 1.02 ** (i + 8 * arm), 20.0 + 0.01 * (i + 8 * arm)),
        "arms side by side": (1000.0 * 2**i, 20.0 + 0.3 * i + 0.001 * arm),
        "at random": (float(10 ** rng.uniform(2, 4)), float(rng.uniform(18, 22))),
        "a pile and an outlier": (1e6 if i == arm == 0 else 1000.0 + i, 30.0 if i == arm == 0 else 20.0),
    }[name]


@pytest.mark.parametrize("with_reference", [False, True])
@pytest.mark.parametrize(
    "name",
    ["all at one point", "a diagonal", "arms side by side", "at random", "a pile and an outlier"],
)
def test_no_label_of_a_frontier_covers_another_one_or_a_mark(jobs, name, with_reference):
    rng = np.random.default_rng(0)
    keys = {"baseline": "tau_pos", "absgrad": "tau_pos", "cadam_no_snr": "tau_Q"}
    for arm, key in enumerate(keys):
        for i in range(8):
            n, psnr = nasty(name, arm, i, rng)
            words = (f"densifier.{keys[key]}=0.{i + 1}234", "noise=weak")
            jobs.add(key, *words, n=n, psnr=psnr)
            if with_reference:
                jobs.add(key, words[0], "noise=none", n=n, psnr=psnr + 1)
    for arm in ("cadam", "cadam_calibrated", "mcmc"):
        jobs.add(arm, "noise=weak", n=1000, psnr=20.0)
    figure = draw("frontier", read(jobs.folder))
    assert "absgrad" in texts(figure)
    for axes in figure.axes:
        found, marks = boxes_of(axes)
        assert not any(one.overlaps(other) for one, other in combinations(found, 2))
        assert not any(box.contains(*mark) for box in found for mark in marks)
        frame = axes.get_window_extent(FigureCanvasAgg(figure).get_renderer())
        assert all(frame.x0 <= box.x0 and box.x1 <= frame.x1 for box in found)
    assert len(boxes_of(figure.axes[-1])[0]) >= 24 + 6  # nothing is left out


def test_labels_without_room_are_left_out():
    with styled():
        figure = new_figure(1)
        axes = figure.subplots()
        axes.plot([1], [1], marker="o")
        place_labels(axes, [Label(f"{i} and so on and on", (1, 1)) for i in range(60)])
    found, _ = boxes_of(axes)
    assert 10 < len(found) < 60
    assert not any(one.overlaps(other) for one, other in combinations(found, 2))
