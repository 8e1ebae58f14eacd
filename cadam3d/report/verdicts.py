"""Verdicts: the findings of a sweep as sentences that are generated from numbers alone."""

import math
from collections.abc import Sequence

from cadam3d.report.claims import PairedComparison, Standing, compare, standard_setting, standing_of
from cadam3d.report.formatting import plural
from cadam3d.report.results import JobResult, arms_of, at_noise, level_title, levels_of, with_noise

OURS, THEIRS = "cadam", "baseline"
COMPARABLE = 0.3  # dB of PSNR; a smaller loss is hardly visible


def headline(results: Sequence[JobResult]) -> list[str]:
    """Return the verdict of a sweep; empty if nothing is comparable.

    The first sentence is the paper's claim over all levels of noise. Then each level is compared with the
    tuned baseline, and finally the variants of CAdam are.
    """
    sentences = []
    noisy = with_noise(results)
    ours, theirs = standard_setting(results, OURS), standard_setting(results, THEIRS)
    if ours and theirs and (comparison := compare(noisy, ours, theirs)):
        sentences.append(reduction_sentence(comparison))
    for level in levels_of(results):
        here = at_noise(results, level)
        if ours and (standing := standing_of(here, ours, THEIRS)) and standing.settings > 1:
            sentences.append(standing_sentence(standing, _where(level)))
    where = "At all levels of noise: " if len(levels_of(noisy)) > 1 else ""
    for arm in (arm for arm in arms_of(noisy) if arm.startswith(OURS) and arm != OURS):
        variant = standard_setting(noisy, arm)
        if variant and (standing := standing_of(noisy, variant, THEIRS)) and standing.settings > 1:
            sentences.append(standing_sentence(standing, where))
    return sentences


def reduction_sentence(comparison: PairedComparison) -> str:
    """Return the reduction in Gaussians, its cost in PSNR, the number of cells, and how many ended early."""
    fewer, psnr = comparison.reduction, comparison.psnr
    many, sign = ("fewer", 1) if fewer.median >= 0 else ("more", -1)
    spread = (fewer if sign > 0 else fewer.negated()).described(lambda value: f"{value:.1%}")
    sentence = (
        f"{comparison.ours.name} ends with {abs(fewer.median):.1%} {many} Gaussians than "
        f"{comparison.theirs.name} (median of {_cells(comparison.cells)}; {spread} {many}), "
        f"at {psnr.median:+.2f} dB PSNR ({psnr.described(lambda value: f'{value:+.2f}')}), "
        f"no more than {COMPARABLE} dB lower in {comparison.comparable(COMPARABLE)} of them"
    )
    if comparison.psnr_over_seeds is not None:
        sentence += f", with a spread of {comparison.psnr_over_seeds:.2f} dB over seeds"
    for name, early in (
        (comparison.ours.arm, comparison.early),
        (comparison.theirs.arm, comparison.theirs_early),
    ):
        if early:
            sentence += f"; {name} ended early in {_cells(early)}"
    for name, lacking in (
        (comparison.ours.arm, comparison.only_theirs),
        (comparison.theirs.arm, comparison.only_ours),
    ):
        if lacking:
            sentence += f"; {name} left nothing to measure in {plural(lacking, 'other cell')}"
    return sentence + "."


def standing_sentence(standing: Standing, where: str = "") -> str:
    """Compare a setting with the whole frontier of another arm; ``where`` begins the sentence."""
    ours, theirs = standing.setting.name, standing.arm
    outside = _outside(standing)
    if standing.psnr is None:
        needed = _needed_clause(standing)
        return f"{where}{ours} never ends within the range of {theirs}'s frontier: {outside}{needed}."
    estimate = standing.psnr
    side = "above" if estimate.median >= 0 else "below"
    share = f"{standing.above} of {_cells(estimate.cells)}"
    interval = "" if estimate.low is None else f" [{estimate.low:+.2f}, {estimate.high:+.2f}]"
    sentence = (
        f"{where}{ours} is {abs(estimate.median):.2f} dB{interval} {side} the best of {theirs}'s "
        f"{standing.settings} thresholds at equal count, above it in {share}"
    )
    if standing.psnr_over_seeds is not None:
        sentence += f", with a spread of {standing.psnr_over_seeds:.2f} dB over seeds"
    if not estimate.is_certain:
        sentence += f", which is not a certain difference ({plural(estimate.prompts, 'prompt')})"
    if outside:
        sentence += f"; {outside}"
    return sentence + _needed_clause(standing) + "."


def _needed_clause(standing: Standing) -> str:
    """Return how many Gaussians the other arm would need for the same quality; empty if that is unknown."""
    ratio, theirs = standing.count_ratio, standing.arm
    if ratio is None:
        return ""
    never = (
        f"{theirs} reaches that PSNR at no threshold in {_cells(standing.never)}" if standing.never else ""
    )
    always = (
        f"{theirs} exceeds that PSNR at every threshold in {_cells(standing.always)}"
        if standing.always
        else ""
    )
    known = f"for the same PSNR {theirs} needs {ratio:.2g} times as many" if 0 < ratio < math.inf else ""
    return "".join(
        f"; {part}" for part in (known, *((always, never) if ratio == 0 else (never, always))) if part
    )


def _outside(standing: Standing) -> str:
    parts = []
    if standing.fewer:
        parts.append(
            f"in {_cells(standing.fewer)} it has fewer Gaussians than any of {standing.arm}'s settings"
        )
    if standing.more:
        parts.append(f"in {_cells(standing.more)} it has more than any of them")
    return " and ".join(parts)


def _where(level: str) -> str:
    title = level_title(level)
    return f"{'Without noise' if title == 'no noise' else 'At ' + title}: " if title else ""


def _cells(count: int) -> str:
    return plural(count, "cell")
