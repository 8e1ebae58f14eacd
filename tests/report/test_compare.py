"""Comparisons of results made by hand: pairs of arms, frontiers, and settings against frontiers."""

from itertools import pairwise

import numpy as np
import pytest

from cadam3d.report.compare import (
    Estimate,
    above_frontier,
    arms_without_growth,
    compare,
    frontier,
    gain_over,
    hull_of,
    main_setting,
    quality_at,
    references,
    settings_of,
)
from cadam3d.report.results import ArmSetting, Cell, JobResult, at_noise, read

OURS, THEIRS = ArmSetting("cadam"), ArmSetting("baseline")


def psnr(result: JobResult) -> float | None:
    return result.numbers.get("psnr")


def pair(jobs, ours, theirs, **cell):
    """Add one cell with both arms; ``ours`` and ``theirs`` are count and PSNR."""
    line = [f"{key}={value}" for key, value in cell.items()]
    for arm, (n, psnr) in (("cadam", ours), ("baseline", theirs)):
        jobs.add(arm, *line, n=n, psnr=psnr)


def cell(prompt: str, seed: int) -> Cell:
    return Cell((("prompt", prompt), ("seed", str(seed))))


def test_reduction_and_difference_are_paired_within_cells(jobs):
    pair(jobs, (100, 20.0), (1000, 21.0), prompt="a cube", seed=0)
    pair(jobs, (100, 30.0), (200, 30.5), prompt="a torus", seed=0)
    pair(jobs, (100, 10.0), (400, 10.1), prompt="a tower", seed=0)
    found = compare(read(jobs.folder), OURS, THEIRS)
    assert found is not None
    assert len(found.pairs) == 3
    assert found.count.median == pytest.approx(-75)
    difference = found.difference(psnr)
    assert difference is not None
    assert difference.median == pytest.approx(-0.5)  # the difference of the medians would be -1


def test_a_cell_without_its_partner_is_counted_not_compared(jobs):
    pair(jobs, (100, 20.0), (1000, 21.0), seed=0)
    jobs.add("cadam", "seed=1", n=100, psnr=20.0)
    jobs.add("baseline", "seed=1", n=100, psnr=20.0, outcome="failed")
    found = compare(read(jobs.folder), OURS, THEIRS)
    assert found is not None
    assert (len(found.pairs), found.unpaired) == (1, 1)


# Hulls: the best that an arm can reach.


@pytest.mark.parametrize("seed", range(5))
def test_a_hull_is_above_every_setting_rising_and_concave(seed):
    rng = np.random.default_rng(seed)
    points = [(float(10 ** rng.uniform(2, 5)), float(rng.uniform(10, 30))) for _ in range(9)]
    corners = hull_of(points)
    assert all(quality_at(corners, n) >= psnr - 1e-9 for n, psnr in points)
    slopes = [(y1 - y0) / (x1 - x0) for (x0, y0), (x1, y1) in pairwise(corners)]
    assert all(slope >= 0 for slope in slopes)
    assert slopes == sorted(slopes, reverse=True)


@pytest.mark.parametrize(
    ("points", "count", "expected"),
    [
        ([(100.0, 10.0), (10000.0, 20.0)], 1000.0, 15.0),  # straight in log count
        ([(100.0, 10.0), (1000.0, 11.0), (10000.0, 20.0)], 1000.0, 15.0),  # above the lowest setting
        ([(100.0, 10.0), (1000.0, 20.0), (10000.0, 5.0)], 10000.0, 20.0),  # level after the best
        ([(100.0, 10.0), (1000.0, 20.0)], 99.0, None),  # nothing is extrapolated
        ([(100.0, 10.0), (1000.0, 20.0)], 1001.0, None),
        ([(100.0, 10.0)], 100.0, 10.0),
        ([(100.0, 10.0)], 101.0, None),
    ],
)
def test_a_hull_is_straight_between_its_settings_and_ends_with_them(points, count, expected):
    assert quality_at(hull_of(points), count) == pytest.approx(expected)


# Frontier against frontier.


def baseline_frontier(jobs, settings, **where):
    line = [f"{key}={value}" for key, value in where.items()]
    for tau, (n, psnr) in settings.items():
        jobs.add("baseline", f"densifier.tau_pos={tau}", *line, n=n, psnr=psnr)


def test_a_setting_is_compared_with_the_best_of_the_other_arm_at_its_count(jobs):
    for prompt, shift in zip("abcdef", (0.0, 5.0, -5.0, 1.0, 2.0, 3.0), strict=True):
        where = {"prompt": prompt, "seed": 0}
        baseline_frontier(jobs, {0.001: (100, 10.0 + shift), 0.0002: (10000, 20.0 + shift)}, **where)
        jobs.add("cadam", f"prompt={prompt}", "seed=0", n=1000, psnr=17.5 + shift)
    found = Estimate.of(above_frontier(read(jobs.folder), OURS, "baseline", psnr))
    assert found.median == found.low == found.high == pytest.approx(2.5)


def test_cells_outside_the_range_are_left_out_and_not_extrapolated(jobs):
    for seed, n in enumerate((50, 1000, 50000)):
        baseline_frontier(jobs, {0.001: (100, 10.0), 0.0002: (10000, 20.0)}, seed=seed)
        jobs.add("cadam", f"seed={seed}", n=n, psnr=25.0)
    found = above_frontier(read(jobs.folder), OURS, "baseline", psnr)
    assert [cell["seed"] for cell in found] == ["1"]


def test_no_setting_is_above_the_frontier_of_its_arm(bench_results):
    results = at_noise(bench_results, "medium")
    for arm in ("baseline", "cadam"):
        for setting in settings_of(results, arm):
            assert all(above <= 1e-9 for above in above_frontier(results, setting, arm, psnr).values())


# Uncertainty.


def test_noise_levels_and_objectives_do_not_count_as_prompts():
    """They share the object: three levels of two prompts are two votes."""
    axes = [(noise, guidance) for noise in ("weak", "medium", "strong") for guidance in ("ism", "sds")]
    values = {
        Cell((("guidance", guidance), ("noise", noise), ("prompt", prompt), ("seed", "0"))): 1.0
        for prompt in "ab"
        for noise, guidance in axes
    }
    found = Estimate.of(values)
    assert (found.cells, found.prompts, found.low) == (12, 2, None)
    assert found.p_value == pytest.approx(0.5)


@pytest.mark.parametrize(("prompts", "seeds", "least"), [(6, 3, 0.87), (12, 1, 0.92)])
def test_an_interval_covers_the_truth_as_often_as_the_documentation_says(prompts, seeds, least):
    """The truth is 0; seeds vary half as much as prompts."""
    rng = np.random.default_rng(0)
    hits = 0
    for _ in range(400):
        values = {}
        for prompt in range(prompts):
            middle = rng.standard_normal()
            for seed in range(seeds):
                values[cell(str(prompt), seed)] = float(middle + 0.5 * (seeds > 1) * rng.standard_normal())
        found = Estimate.of(values)
        assert found.low is not None
        assert found.high is not None
        hits += found.low <= 0 <= found.high
    assert hits >= least * 400


def test_the_sign_test_counts_prompts_and_leaves_out_those_without_a_difference():
    far = {cell(prompt, 0): 1.0 for prompt in "abcdefgh"}
    assert Estimate.of(far).p_value == pytest.approx(2 / 2**8)
    one_against = Estimate.of({**far, cell("h", 0): -1.0})
    assert one_against.low == 1.0
    assert one_against.p_value == pytest.approx(2 * 9 / 2**8)
    assert Estimate.of(dict.fromkeys(far, 0.0)).p_value is None


def test_the_same_results_give_the_same_interval():
    values = {cell(prompt, seed): float(ord(prompt) * seed % 7) for prompt in "abcdef" for seed in range(3)}
    assert Estimate.of(values) == Estimate.of(dict(reversed(values.items())))


# Gains and frontiers over cells.


def test_gains_are_measured_from_the_same_cell_without_growth(jobs):
    for prompt, zero in (("a cube", 10.0), ("a torus", 30.0)):
        jobs.add("none", f"prompt={prompt}", n=100, psnr=zero, arm="still")
        jobs.add("cadam", f"prompt={prompt}", n=200, psnr=zero + 2.0, arm="ours")
    results = read(jobs.folder)
    assert arms_without_growth(results) == ["still"]
    [point] = frontier(results, "ours", gain_over(results, psnr))
    assert point.gain == (2.0, 2.0, 2.0)
    assert point.count[1] == 200


def test_a_cell_that_lacks_its_job_without_growth_is_left_out(jobs):
    jobs.add("none", "seed=0", n=100, psnr=10.0)
    for seed in (0, 1):
        jobs.add("cadam", f"seed={seed}", n=200, psnr=12.0 + 10 * seed)
    results = read(jobs.folder)
    [point] = frontier(results, "cadam", gain_over(results, psnr))
    assert point.gain[1] == 2.0


def test_an_arm_is_represented_by_its_shipped_setting_or_the_one_with_the_middle_count(jobs):
    for tau, n in ((0.001, 300), (0.004, 100), (0.002, 200)):
        jobs.add("baseline", f"densifier.tau_pos={tau}", n=n, psnr=20.0)
    assert main_setting(read(jobs.folder), "baseline").values == "0.002"
    jobs.add("baseline", "densifier.tau_pos=0.0002", n=1000, psnr=20.0)
    assert main_setting(read(jobs.folder), "baseline").values == "0.0002"


def test_arms_are_compared_with_the_first_that_grows_and_with_the_one_that_does_not(jobs):
    for arm, densifier in (("zero", "none"), ("first", "cadam"), ("second", "baseline")):
        jobs.add(densifier, n=100, psnr=20.0, arm=arm)
    results = read(jobs.folder)
    assert references(results) == ["first", "zero"]
    assert references(results, "second") == ["second", "zero"]
    assert references(results, "missing") == ["zero"]
