"""Claims about results made by hand: comparisons, frontiers, and settings compared with frontiers."""

import math

import numpy as np
import pytest

from cadam3d.report.claims import (
    Estimate,
    Hull,
    Spread,
    compare,
    frontier,
    has_no_growth,
    over_seeds,
    settings_of,
    standard_setting,
    standing_of,
    standings,
)
from cadam3d.report.results import ArmSetting, Cell, at_noise, read

OURS, THEIRS = ArmSetting("cadam"), ArmSetting("baseline")


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
    assert found.cells == 3
    assert found.reduction.median == pytest.approx(0.75)
    assert found.psnr.median == pytest.approx(-0.5)  # the difference of the medians would be -1
    assert found.ssim is not None
    assert found.ssim.median == pytest.approx(0)


def test_a_cell_without_its_partner_is_counted_not_compared(jobs):
    pair(jobs, (100, 20.0), (1000, 21.0), seed=0)
    jobs.add("cadam", "seed=1", n=100, psnr=20.0)
    jobs.add("baseline", "seed=1", n=100, psnr=20.0, outcome="failed")
    found = compare(read(jobs.folder), OURS, THEIRS)
    assert found is not None
    assert (found.cells, found.unpaired, found.only_ours, found.only_theirs) == (1, 1, 1, 0)


def test_an_early_end_is_compared_and_counted(jobs):
    jobs.add("cadam", n=100, psnr=20.0)
    jobs.add("baseline", n=1000, psnr=19.0, outcome="max_gaussians")
    found = compare(read(jobs.folder), OURS, THEIRS)
    assert found is not None
    assert (found.early, found.theirs_early) == (0, 1)


def test_without_a_common_cell_nothing_is_compared(jobs):
    jobs.add("cadam", "seed=0", n=100, psnr=20.0)
    jobs.add("baseline", "seed=1", n=100, psnr=20.0)
    assert compare(read(jobs.folder), OURS, THEIRS) is None


def test_the_spread_over_seeds_leaves_out_that_of_prompts():
    values = {cell("a", 0): 1.0, cell("a", 1): 3.0, cell("b", 0): 101.0, cell("b", 1): 105.0}
    assert over_seeds(values) == pytest.approx((math.sqrt(2) + 2 * math.sqrt(2)) / 2)
    assert over_seeds({cell("a", 0): 1.0, cell("b", 0): 2.0}) is None


def test_five_prompts_have_quartiles():
    spread = Spread.of({cell(prompt, 0): float(i) for i, prompt in enumerate("abcde")})
    assert (spread.low, spread.median, spread.high) == (1.0, 2.0, 3.0)
    assert spread.described("{:g}".format) == "quartiles 1 to 3"
    assert spread.negated().described("{:g}".format) == "quartiles -3 to -1"


@pytest.mark.parametrize(
    ("prompts", "seeds", "expected"),
    [
        ("a", 1, "value 0"),
        ("ab", 1, "values 0, 1"),
        ("ab", 2, "values 0, 1, 10, 11"),
        ("ab", 9, "lowest 0, highest 81"),
        ("abcd", 9, "lowest 0, highest 83"),
    ],
)
def test_few_prompts_have_values_or_named_extremes_whatever_the_number_of_seeds(prompts, seeds, expected):
    spread = Spread.of(
        {cell(p, seed): i + 10.0 * seed for i, p in enumerate(prompts) for seed in range(seeds)}
    )
    assert spread.described("{:g}".format) == expected
    assert (spread.low, spread.high) == (min(spread.values), max(spread.values))


# Hulls: the best that an arm can reach.


@pytest.mark.parametrize("seed", range(5))
def test_a_hull_is_above_every_setting_rising_and_concave(seed):
    rng = np.random.default_rng(seed)
    points = [(float(10 ** rng.uniform(2, 5)), float(rng.uniform(10, 30))) for _ in range(9)]
    hull = Hull(points)
    assert all(hull.psnr_at(n) >= psnr - 1e-9 for n, psnr in points)
    slopes = [
        (y1 - y0) / (x1 - x0) for (x0, y0), (x1, y1) in zip(hull.corners, hull.corners[1:], strict=False)
    ]
    assert all(slope >= 0 for slope in slopes)
    assert slopes == sorted(slopes, reverse=True)


def test_a_hull_touches_settings_only():
    points = [(100.0, 10.0), (1000.0, 20.0), (10000.0, 22.0)]
    assert [10**x for x, _ in Hull(points).corners] == pytest.approx([n for n, _ in points])


def test_between_settings_a_hull_is_straight_in_log_count():
    hull = Hull([(100.0, 10.0), (10000.0, 20.0)])
    assert hull.psnr_at(1000.0) == pytest.approx(15.0)
    assert hull.count_for(15.0) == pytest.approx(1000.0)


def test_a_setting_below_the_line_between_others_does_not_lower_a_hull():
    assert Hull([(100.0, 10.0), (1000.0, 11.0), (10000.0, 20.0)]).psnr_at(1000.0) == pytest.approx(15.0)


def test_a_hull_stays_level_where_more_gaussians_lower_the_quality():
    hull = Hull([(100.0, 10.0), (1000.0, 20.0), (10000.0, 5.0)])
    assert hull.psnr_at(10000.0) == pytest.approx(20.0)
    assert hull.count_for(20.0) == pytest.approx(1000.0)


def test_nothing_is_extrapolated():
    hull = Hull([(100.0, 10.0), (1000.0, 20.0)])
    assert hull.psnr_at(99.0) is None
    assert hull.psnr_at(1001.0) is None
    assert hull.count_for(9.0) is None
    assert hull.count_for(21.0) == math.inf
    assert hull.psnr_at(100.0) == pytest.approx(10.0)
    assert hull.psnr_at(1000.0) == pytest.approx(20.0)


def test_one_setting_is_a_hull_of_one_point():
    hull = Hull([(100.0, 10.0)])
    assert hull.psnr_at(100.0) == pytest.approx(10.0)
    assert hull.psnr_at(101.0) is None


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
    found = standing_of(read(jobs.folder), OURS, "baseline")
    assert found is not None
    assert found.psnr is not None
    assert found.psnr.median == pytest.approx(2.5)
    assert found.psnr.low == found.psnr.high == pytest.approx(2.5)
    assert (found.above, found.fewer, found.more, found.never) == (6, 0, 0, 0)
    assert found.count_ratio == pytest.approx(10**0.5)


def test_cells_outside_the_range_are_counted_not_extrapolated(jobs):
    for seed, n in enumerate((50, 1000, 50000)):
        baseline_frontier(jobs, {0.001: (100, 10.0), 0.0002: (10000, 20.0)}, seed=seed)
        jobs.add("cadam", f"seed={seed}", n=n, psnr=25.0)
    found = standing_of(read(jobs.folder), OURS, "baseline")
    assert found is not None
    assert found.psnr is not None
    assert (found.psnr.cells, found.fewer, found.more) == (1, 1, 1)
    assert found.never == 3
    assert found.count_ratio == math.inf


def test_no_setting_is_above_the_frontier_of_its_arm(bench_results):
    results = at_noise(bench_results, "medium")
    for arm in ("baseline", "cadam"):
        for found in standings(results, arm, arm):
            assert found.psnr is not None
            assert found.psnr.median <= 1e-9


def test_a_ratio_of_counts_does_not_depend_on_their_scale(jobs):
    for seed, scale in enumerate((1, 7)):
        baseline_frontier(jobs, {0.001: (100 * scale, 10.0), 0.0002: (10000 * scale, 20.0)}, seed=seed)
        jobs.add("cadam", f"seed={seed}", n=1000 * scale, psnr=16.0)
    found = standing_of(read(jobs.folder), OURS, "baseline")
    assert found is not None
    assert found.count_ratio == pytest.approx(10**0.2)
    assert found.psnr is not None
    assert found.psnr.median == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("qualities", "ratio"),
    [
        ((9.0, 25.0, 15.0), 1.0),  # one always exceeded, one never reached
        ((9.0, 9.0, 15.0), 0.0),
        ((25.0, 25.0, 15.0), math.inf),
        ((10.0, 20.0), (0.1 + 10) / 2),  # the mean of the two in the middle, both known
        ((9.0, 15.0), 0.0),  # the lower one, because one of the two is unknown
        ((15.0, 25.0), 1.0),
    ],
)
def test_qualities_out_of_reach_count_as_zero_and_infinite_ratios(jobs, qualities, ratio):
    for seed, psnr in enumerate(qualities):
        baseline_frontier(jobs, {0.001: (100, 10.0), 0.0002: (10000, 20.0)}, seed=seed)
        jobs.add("cadam", f"seed={seed}", n=1000, psnr=psnr)
    found = standing_of(read(jobs.folder), OURS, "baseline")
    assert found is not None
    assert found.count_ratio == pytest.approx(ratio)
    assert (found.always, found.never) == (qualities.count(9.0), qualities.count(25.0))


def test_the_spread_over_seeds_is_that_of_the_difference(jobs):
    for seed, psnr in enumerate((16.0, 18.0)):
        baseline_frontier(jobs, {0.001: (100, 10.0), 0.0002: (10000, 20.0)}, seed=seed)
        jobs.add("cadam", f"seed={seed}", n=1000, psnr=psnr)
    found = standing_of(read(jobs.folder), OURS, "baseline")
    assert found is not None
    assert found.psnr_over_seeds == pytest.approx(math.sqrt(2))


def test_cells_without_a_frontier_and_frontiers_without_the_setting_are_counted(jobs):
    for seed in (0, 1):
        baseline_frontier(jobs, {0.001: (100, 10.0), 0.0002: (10000, 20.0)}, seed=seed)
    for seed in (1, 2, 3):
        jobs.add("cadam", f"seed={seed}", n=1000, psnr=15.0)
    found = standing_of(read(jobs.folder), OURS, "baseline")
    assert found is not None
    assert found.unpaired == 3


# Uncertainty.


def test_a_constant_has_an_interval_of_no_width():
    found = Estimate.of({cell(prompt, 0): 1.0 for prompt in "abcdef"})
    assert (found.median, found.low, found.high) == (1.0, 1.0, 1.0)
    assert found.p_value == pytest.approx(2 * 0.5**6)


def test_seeds_do_not_count_as_prompts():
    """Many seeds of two prompts are two prompts: no interval, and a sign test with two votes."""
    found = Estimate.of({cell(prompt, seed): 1.0 for prompt in "ab" for seed in range(50)})
    assert found.low is found.high is None
    assert found.p_value == pytest.approx(0.5)


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


def test_noise_levels_do_not_count_as_seeds():
    values = {
        Cell((("noise", noise), ("prompt", "a"), ("seed", str(seed)))): level + seed
        for noise, level in (("weak", 0.0), ("strong", 100.0))
        for seed in (0, 1)
    }
    assert over_seeds(values) == pytest.approx(math.sqrt(0.5))


@pytest.mark.parametrize("prompts", [3, 4, 5])
def test_with_few_prompts_there_is_no_interval(prompts):
    found = Estimate.of({cell(str(prompt), 0): 1.0 + prompt for prompt in range(prompts)})
    assert found.low is found.high is None
    assert not found.is_certain


@pytest.mark.parametrize(
    ("prompts", "seeds", "least"), [(6, 1, 0.91), (6, 3, 0.87), (12, 1, 0.92), (12, 3, 0.9)]
)
def test_an_interval_covers_the_truth_as_often_as_the_documentation_says(prompts, seeds, least):
    """The truth is 0; seeds vary half as much as prompts."""
    rng = np.random.default_rng(0)
    hits = mistakes = 0
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
        mistakes += found.is_certain
    assert hits >= least * 400
    assert mistakes <= 0.05 * 400


def test_a_difference_is_certain_if_interval_and_sign_test_agree():
    far = {cell(prompt, 0): 1.0 for prompt in "abcdefgh"}
    assert Estimate.of(far).is_certain
    one_against = Estimate.of({**far, cell("h", 0): -1.0})  # seven against one: p = 0.07
    assert one_against.low == 1.0
    assert not one_against.is_certain
    assert not Estimate.of(dict.fromkeys(far, 0.0)).is_certain


def test_the_same_results_give_the_same_interval():
    values = {cell(prompt, seed): float(ord(prompt) * seed % 7) for prompt in "abcdef" for seed in range(3)}
    assert Estimate.of(values) == Estimate.of(dict(reversed(values.items())))


# Frontiers over cells.


def test_gains_are_measured_from_the_same_cell_without_growth(jobs):
    for prompt, zero in (("a cube", 10.0), ("a torus", 30.0)):
        jobs.add("none", f"prompt={prompt}", n=100, psnr=zero)
        jobs.add("cadam", f"prompt={prompt}", n=200, psnr=zero + 2.0)
    results = read(jobs.folder)
    assert has_no_growth(results)
    point = frontier(results, "cadam")[0]
    assert point.gain.values == (2.0, 2.0)
    assert (point.count.median, point.cells) == (200, 2)


def test_if_no_job_is_without_growth_the_gain_is_plain_psnr(jobs):
    jobs.add("cadam", n=200, psnr=12.0)
    assert frontier(read(jobs.folder), "cadam")[0].gain.median == 12.0


def test_a_cell_that_lacks_its_job_without_growth_is_left_out(jobs):
    jobs.add("none", "seed=0", n=100, psnr=10.0)
    for seed in (0, 1):
        jobs.add("cadam", f"seed={seed}", n=200, psnr=12.0 + 10 * seed)
    point = frontier(read(jobs.folder), "cadam")[0]
    assert (point.cells, point.gain.median) == (1, 2.0)


def test_gains_of_one_level_can_be_measured_from_another(jobs):
    """This puts the curve without noise into the panels with noise."""
    jobs.add("none", "noise=strong", n=100, psnr=10.0)
    jobs.add("none", "noise=none", n=100, psnr=15.0)
    jobs.add("cadam", "noise=none", n=200, psnr=18.0)
    results = read(jobs.folder)
    clean, noisy = at_noise(results, "none"), at_noise(results, "strong")
    assert frontier(clean, "cadam")[0].gain.median == pytest.approx(3.0)
    assert frontier(clean, "cadam", reference=noisy)[0].gain.median == pytest.approx(8.0)


def test_the_standard_setting_is_the_shipped_one_or_the_only_one(jobs):
    jobs.add("baseline", "densifier.tau_pos=0.001", n=100, psnr=20.0)
    assert standard_setting(read(jobs.folder), "baseline") == ArmSetting("baseline")
    jobs.add("baseline", "densifier.tau_pos=0.004", n=100, psnr=20.0)
    assert standard_setting(read(jobs.folder), "baseline") is None
    jobs.add("baseline", "densifier.tau_pos=0.0002", n=100, psnr=20.0)
    assert standard_setting(read(jobs.folder), "baseline") == ArmSetting("baseline", (("tau_pos", 0.0002),))
    assert len(settings_of(read(jobs.folder), "baseline")) == 3
