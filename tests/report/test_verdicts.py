"""The sentences of a verdict follow from the numbers and claim no more than these show."""

from cadam3d.report.results import read
from cadam3d.report.verdicts import headline

PROMPTS = ("a cube", "a torus", "a tower", "a castle", "a tree", "a ball")


def cells(jobs, ours, baseline, prompts=PROMPTS, noise="medium"):
    for prompt in prompts:
        for tau, (n, psnr) in baseline.items():
            jobs.add(
                "baseline", f"densifier.tau_pos={tau}", f"prompt={prompt}", f"noise={noise}", n=n, psnr=psnr
            )
        jobs.add("cadam", f"prompt={prompt}", f"noise={noise}", n=ours[0], psnr=ours[1])


def test_the_claim_of_the_paper_comes_first_then_the_tuned_baseline(jobs):
    cells(jobs, (1000, 17.5), {0.001: (100, 10.0), 0.0002: (10000, 20.0)})
    first, second = headline(read(jobs.folder))
    assert first.startswith(
        "cadam ends with 90.0% fewer Gaussians than baseline (tau_pos 0.0002) (median of 6"
    )
    assert "at -2.50 dB PSNR" in first
    assert second.startswith(
        "At medium noise: cadam is 2.50 dB [+2.50, +2.50] above the best of baseline's 2"
    )
    assert "above it in 6 of 6 cells; for the same PSNR baseline needs 3.2 times as many" in second


def test_a_larger_count_is_reported_as_more(jobs):
    cells(jobs, (2000, 20.0), {0.0002: (1000, 20.0)})
    sentence = headline(read(jobs.folder))[0]
    assert sentence.startswith("cadam ends with 100.0% more Gaussians than baseline (median of 6 cells")
    assert "quartiles 100.0% to 100.0% more" in sentence


def test_a_setting_below_the_frontier_is_reported_as_below(jobs):
    cells(jobs, (1000, 12.0), {0.001: (100, 10.0), 0.0002: (10000, 20.0)})
    assert "3.00 dB [-3.00, -3.00] below the best" in headline(read(jobs.folder))[1]


def test_a_difference_that_chance_explains_is_not_claimed(jobs):
    for prompt, psnr in zip(PROMPTS, (14.0, 15.1, 16.0, 14.5, 15.5, 15.2), strict=True):
        cells(jobs, (1000, psnr), {0.001: (100, 10.0), 0.0002: (10000, 20.0)}, prompts=[prompt])
    assert "not a certain difference" in headline(read(jobs.folder))[1]


def test_a_difference_in_five_of_six_prompts_is_not_claimed(jobs):
    """The interval excludes 0, the sign test does not."""
    for prompt, psnr in zip(PROMPTS, (14.9, *(5 * [19.0])), strict=True):
        cells(jobs, (1000, psnr), {0.001: (100, 10.0), 0.0002: (10000, 20.0)}, prompts=[prompt])
    assert "not a certain difference (6 prompts)" in headline(read(jobs.folder))[1]


def test_five_prompts_are_too_few_to_be_certain_at_any_number_of_levels(jobs):
    for noise in ("weak", "medium", "strong"):
        cells(jobs, (1000, 19.0), {0.001: (100, 10.0), 0.0002: (10000, 20.0)}, PROMPTS[:5], noise)
        for prompt in PROMPTS[:5]:
            jobs.add("cadam_strict", f"prompt={prompt}", f"noise={noise}", n=1000, psnr=19.0)
    for sentence in headline(read(jobs.folder))[1:]:
        assert "not a certain difference (5 prompts)" in sentence
        assert "[" not in sentence


def test_a_difference_comes_with_its_spread_over_seeds(jobs):
    for seed, psnr in enumerate((16.0, 16.2)):
        for tau, n, best in ((0.001, 100, 10.0), (0.0002, 10000, 20.0)):
            jobs.add("baseline", f"densifier.tau_pos={tau}", f"seed={seed}", n=n, psnr=best)
        jobs.add("cadam", f"seed={seed}", n=1000, psnr=psnr)
    assert "in 2 of 2 cells, with a spread of 0.14 dB over seeds" in headline(read(jobs.folder))[1]


def test_cells_without_a_partner_are_reported_for_each_arm(jobs):
    cells(jobs, (1000, 20.0), {0.0002: (2000, 20.0)})
    jobs.add("baseline", "noise=medium", "prompt=a seventh", n=2000, psnr=20.0)
    jobs.add("cadam", "noise=medium", "prompt=a seventh", n=10, psnr=None, outcome="vanished")
    for prompt in ("an eighth", "a ninth"):
        jobs.add("cadam", "noise=medium", f"prompt={prompt}", n=1000, psnr=20.0)
    assert headline(read(jobs.folder))[0].endswith(
        "; cadam left nothing to measure in 1 other cell; baseline left nothing to measure in 2 other cells."
    )


def test_a_quality_that_is_always_exceeded_is_reported(jobs):
    cells(jobs, (1000, 9.0), {0.001: (100, 10.0), 0.0002: (10000, 20.0)})
    sentence = headline(read(jobs.folder))[1]
    assert "; baseline exceeds that PSNR at every threshold in 6 cells" in sentence
    assert "times as many" not in sentence


def test_qualities_out_of_reach_are_reported_on_both_sides(jobs):
    for prompt, psnr in zip(PROMPTS, (9.0, 25.0, 15.0, 15.0, 15.0, 15.0), strict=True):
        cells(jobs, (1000, psnr), {0.001: (100, 10.0), 0.0002: (10000, 20.0)}, prompts=[prompt])
    assert headline(read(jobs.folder))[1].endswith(
        "; for the same PSNR baseline needs 1 times as many; "
        "baseline reaches that PSNR at no threshold in 1 cell; "
        "baseline exceeds that PSNR at every threshold in 1 cell."
    )


def test_an_early_end_is_reported(jobs):
    jobs.add("cadam", n=100, psnr=20.0)
    jobs.add("baseline", n=1000, psnr=19.0, outcome="out_of_memory")
    assert headline(read(jobs.folder))[0].endswith("; baseline ended early in 1 cell.")


def test_an_unreached_quality_is_reported(jobs):
    cells(jobs, (1000, 25.0), {0.001: (100, 10.0), 0.0002: (10000, 20.0)})
    assert "baseline reaches that PSNR at no threshold in 6 cells" in headline(read(jobs.folder))[1]


def test_a_range_that_does_not_overlap_is_reported(jobs):
    cells(jobs, (50, 25.0), {0.001: (100, 10.0), 0.0002: (10000, 20.0)})
    sentence = headline(read(jobs.folder))[1]
    assert "never ends within the range" in sentence
    assert sentence.endswith(
        ": in 6 cells it has fewer Gaussians than any of baseline's settings; "
        "baseline reaches that PSNR at no threshold in 6 cells."
    )


def test_a_level_without_noise_does_not_count_for_the_claim_of_the_paper(jobs):
    cells(jobs, (1000, 10.0), {0.0002: (2000, 20.0)}, noise="none")
    cells(jobs, (1000, 19.8), {0.0002: (10000, 20.0)}, noise="weak")
    [sentence] = headline(read(jobs.folder))
    assert sentence.startswith("cadam ends with 90.0% fewer Gaussians than baseline (median of 6 cells")


def test_without_any_noise_the_claim_is_about_all_cells(jobs):
    cells(jobs, (1000, 20.0), {0.0002: (2000, 20.0)}, noise="none")
    [sentence] = headline(read(jobs.folder))
    assert sentence.startswith("cadam ends with 50.0% fewer")


def test_cells_of_comparable_quality_are_counted_including_the_limit(jobs):
    for prompt, psnr in (("a cube", 19.71), ("a torus", 19.69), ("a tower", 25.0)):
        cells(jobs, (1000, psnr), {0.0002: (10000, 20.0)}, prompts=[prompt])
    assert "no more than 0.3 dB lower in 2 of them" in headline(read(jobs.folder))[0]


def test_variants_are_compared_over_all_noise_together(jobs):
    for noise, psnr in (("none", 10.0), ("weak", 17.0), ("strong", 17.0)):
        cells(jobs, (1000, 15.0), {0.001: (100, 10.0), 0.0002: (10000, 20.0)}, noise=noise)
        for prompt in PROMPTS:
            jobs.add("cadam_annealed", f"prompt={prompt}", f"noise={noise}", n=1000, psnr=psnr)
    *_, last = headline(read(jobs.folder))
    assert last.startswith("At all levels of noise: cadam_annealed is 2.00 dB [+2.00, +2.00] above")
    assert "above it in 12 of 12 cells" in last


def test_without_a_baseline_nothing_is_claimed(jobs):
    jobs.add("cadam", n=100, psnr=20.0)
    assert headline(read(jobs.folder)) == []
