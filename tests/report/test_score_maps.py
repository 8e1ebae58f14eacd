"""Score maps show what the densifiers of the jobs declare and nothing else."""

import numpy as np

from cadam3d.io.declarations import write_declarations
from cadam3d.report.results import at_noise, read
from cadam3d.report.score_maps import ScoreMap, declared_scores, score_figure
from cadam3d.report.style import styled


def draw(folder):
    results = read(folder)
    with styled():
        return score_figure(results, declared_scores(results)["shake"])


def test_every_arm_with_the_score_is_shown(jobs):
    arms = ["cadam", *(f"cadam_{letter}" for letter in "abc")]
    for i, arm in enumerate(arms):
        for noise in ("weak", "strong"):
            jobs.files(jobs.add(arm, f"noise={noise}", n=500, psnr=20.0), 500, shake=10.0**-i)
    figure = draw(jobs.folder)
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert titles == [f"{arm}, {noise} noise" for arm in arms for noise in ("weak", "strong")]
    low, high = figure.axes[0].get_ylim()
    assert low < 1e-3  # independent of the arm that was drawn last
    assert high > 1


def test_shares_of_a_map_add_to_one_at_every_step(bench_results):
    found = ScoreMap.of([each for each in at_noise(bench_results, "medium") if each.arm == "cadam"], "shake")
    assert found is not None
    assert found.steps == [40, 80, 120]
    assert np.allclose(found.shares.sum(axis=0), 1)


def test_declared_levels_are_drawn_with_their_values(jobs):
    jobs.files(jobs.add("cadam", n=500, psnr=20.0), 500)
    [axes] = draw(jobs.folder).axes
    assert [text.get_text() for text in axes.get_legend().texts] == ["tau_shake 0.1", "pure noise 0.229"]
    assert [line.get_ydata()[0] for line in axes.lines] == [0.1, 0.229]


def test_a_score_that_no_job_declares_has_no_map(jobs):
    folder = jobs.add("cadam", n=500, psnr=20.0)
    jobs.files(folder, 500)
    write_declarations(folder, [])
    assert declared_scores(read(jobs.folder)) == {}


def test_a_declared_score_without_histograms_has_no_map(jobs):
    folder = jobs.add("cadam", n=500, psnr=20.0)
    jobs.files(folder, 500)
    (folder / "candidates/histograms.jsonl").unlink()
    assert draw(jobs.folder) is None
