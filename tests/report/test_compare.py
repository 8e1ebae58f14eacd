"""Comparisons of results made by hand: pairs of arms, frontiers, and settings against frontiers."""

from itertools import pairwise

import numpy as np
import pytest

from cadam3d.core.errors import UserError
from cadam3d.report.compare import (
    above_frontier,
    arms_without_growth,
    baseline_of,
    clock,
    compare,
    could_be_certain,
    every_pair,
    frontier,
    gain_over,
    hull_of,
    main_setting,
    named_settings,
    quality_at,
    settings_of,
)
from cadam3d.report.estimate import Estimate, holm, signed_rank_chances
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
    difference = found.difference(psnr)
    assert difference is not None
    assert difference.value == pytest.approx(-0.525)  # the difference of the medians would be -1


def test_exchanging_two_arms_inverts_their_comparison(jobs):
    for i, n in enumerate((1000, 200, 400, 300, 700, 150, 120)):
        pair(jobs, (100 + i, 20.0 + i % 3), (n, 21.0), prompt=f"object {i}")
    one, other = (compare(read(jobs.folder), *each) for each in ((OURS, THEIRS), (THEIRS, OURS)))
    assert one is not None
    assert other is not None
    for ends in (("value", "value"), ("low", "high"), ("high", "low")):
        ratios = [1 + getattr(each.count, end) / 100 for each, end in zip((one, other), ends, strict=True)]
        assert ratios[0] * ratios[1] == pytest.approx(1)
        gains = [getattr(each.difference(psnr), end) for each, end in zip((one, other), ends, strict=True)]
        assert sum(gains) == pytest.approx(0)


def test_time_is_that_of_the_processor_if_all_jobs_have_it(jobs):
    jobs.add("cadam", n=1, psnr=1.0, seconds=2.0, cpu_seconds=3.0)
    heading, value = clock(read(jobs.folder))
    assert (heading, value(read(jobs.folder)[0])) == ("CPU seconds", 3.0)
    jobs.add("baseline", n=1, psnr=1.0, seconds=2.0)
    assert clock(read(jobs.folder))[0] == "seconds"


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
    assert found.value == found.low == found.high == pytest.approx(2.5)


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
    assert found.value == 1.0


def values_of(*prompts: float) -> dict[Cell, float]:
    return {cell(f"object {i}", 0): value for i, value in enumerate(prompts)}


def test_an_estimate_has_the_numbers_of_the_published_signed_rank_tables():
    """Of 12 prompts, 13 is the largest sum of ranks with a two-sided p of at most 0.05 (Wilcoxon, 1945)."""
    chances = signed_rank_chances(12)
    assert 2 * chances[13] <= 0.05 < 2 * chances[14]
    assert chances[-1] == 1
    found = Estimate.of(values_of(1.0, -2.0, 3.0, -4.0, *range(5, 13)))
    assert found.p_value == pytest.approx(2 * chances[2 + 4])
    assert (found.above, found.below) == (10, 2)
    assert found.sign_p_value == pytest.approx(2 * (1 + 12 + 66) / 2**12)


@pytest.mark.parametrize("shift", [-1.0, -0.3, 0.0, 0.3, 1.0])
def test_an_interval_holds_exactly_the_values_that_the_test_does_not_exclude(shift):
    drawn = np.random.default_rng(3).standard_normal(9) + shift
    found = Estimate.of(values_of(*drawn))
    assert found.low is not None
    assert found.high is not None
    assert found.low < found.value < found.high
    for inside in (found.low + 1e-9, found.high - 1e-9):
        assert Estimate.of(values_of(*(drawn - inside))).p_value > 0.05
    for outside in (found.low - 1e-9, found.high + 1e-9):
        assert Estimate.of(values_of(*(drawn - outside))).p_value <= 0.05


def test_prompts_without_a_difference_make_nothing_certain():
    assert Estimate.of(values_of(*[0.0] * 12)).p_value == 1
    assert Estimate.of(values_of(*[0.0] * 12)).sign_p_value == 1
    assert Estimate.of(values_of(*[0.0] * 11, 1.0)).p_value == 1
    five = Estimate.of(values_of(*range(1, 6)))
    assert (five.low, five.high, five.p_value) == (None, None, pytest.approx(2 / 2**5))


def test_the_order_of_cells_does_not_matter():
    values = {cell(prompt, seed): float(ord(prompt) * seed % 7) for prompt in "abcdef" for seed in range(3)}
    assert Estimate.of(values) == Estimate.of(dict(reversed(values.items())))


def test_the_correction_of_holm_has_the_values_of_its_definition():
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.9, 0.6]) == [1, 1]
    assert holm([]) == []


def test_every_two_arms_are_compared_and_corrected_as_one_family(jobs):
    for level in ("none", "strong"):
        for i in range(8):
            for arm, gain in (("red", 0.0), ("green", 0.1 * (-1) ** i), ("blue", 5.0)):
                where = (f"prompt=object {i}", f"noise={level}")
                jobs.add("cadam", *where, n=100, psnr=20.0 + gain + 0.01 * i, arm=arm)
    pairs = every_pair(read(jobs.folder))
    found = [(each.noise, each.comparison.ours.name, each.comparison.theirs.name) for each in pairs]
    names = [("green", "red"), ("blue", "red"), ("blue", "green")]
    assert found == [(level, *pair) for level in ("none", "strong") for pair in names]
    assert [each.is_certain for each in pairs] == [False, True, True] * 2
    # Four of the six differences have the smallest possible p, so the first is multiplied by 6.
    assert pairs[1].p_value == pytest.approx(6 * 2 / 2**8)
    assert could_be_certain(pairs)
    assert not could_be_certain(pairs * 2)


def test_settings_have_the_names_of_the_tables_and_an_arm_means_its_main_setting(jobs):
    for tau in (0.001, 0.0002):
        jobs.add("baseline", f"densifier.tau_pos={tau}", n=100, psnr=20.0)
    jobs.add("cadam", n=100, psnr=20.0)
    jobs.add("cadam", "seed=1", n=100, psnr=20.0, arm="elsewhere")
    results = read(jobs.folder)
    named = named_settings(results, ["baseline (tau_pos 0.001)", "baseline"])
    assert [each.values for each in named] == ["0.001", "0.0002"]
    with pytest.raises(UserError, match="expected two of baseline, cadam, elsewhere, baseline "):
        named_settings(results, ["cadam", "missing"])
    with pytest.raises(UserError, match="a cell in common"):
        named_settings(results, ["cadam", "elsewhere"])


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


def test_the_baseline_is_the_first_arm_that_grows_or_the_one_that_is_named(jobs):
    for arm, densifier in (("zero", "none"), ("first", "cadam"), ("second", "baseline")):
        jobs.add(densifier, n=100, psnr=20.0, arm=arm)
    results = read(jobs.folder)
    assert [baseline_of(results, name) for name in (None, "second", "missing")] == ["first", "second", None]
