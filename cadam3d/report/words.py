"""Verdicts in words, generated from numbers alone: what a reader should take home, and how sure it is."""

import math
from collections.abc import Sequence

from cadam3d.report.claims import Comparison, Standing, compare, stand, standard
from cadam3d.report.figures import arms_of, level_title, levels_of
from cadam3d.report.rows import Row, at_noise, with_noise

OURS, THEIRS = "cadam", "baseline"
COMPARABLE = 0.3  # dB of PSNR; a smaller loss is hardly seen


def headline(rows: Sequence[Row]) -> list[str]:
    """The paper's claim over all noise; by its level, where the tuned baseline stands; then the variants."""
    sentences = []
    noisy = with_noise(rows)
    ours, theirs = standard(rows, OURS), standard(rows, THEIRS)
    if ours and theirs and (comparison := compare(noisy, ours, theirs)):
        sentences.append(reduction_sentence(comparison))
    for level in levels_of(rows):
        here = at_noise(rows, level)
        if ours and (standing := stand(here, ours, THEIRS)) and standing.settings > 1:
            sentences.append(standing_sentence(standing, _where(level)))
    where = "At all levels of noise: " if len(levels_of(noisy)) > 1 else ""
    for arm in (arm for arm in arms_of(noisy) if arm.startswith(OURS) and arm != OURS):
        variant = standard(noisy, arm)
        if variant and (standing := stand(noisy, variant, THEIRS)) and standing.settings > 1:
            sentences.append(standing_sentence(standing, where))
    return sentences


def reduction_sentence(comparison: Comparison) -> str:
    """How many Gaussians fewer, at which price, over how many cells, and what ended early."""
    fewer, psnr = comparison.reduction, comparison.psnr
    many = "fewer" if fewer.median >= 0 else "more"
    sentence = (
        f"{comparison.ours.name} ends with {abs(fewer.median):.1%} {many} Gaussians than "
        f"{comparison.theirs.name} (median of {_cells(comparison.cells)}; quartiles {fewer.low:.1%} to "
        f"{fewer.high:.1%} fewer), at {psnr.median:+.2f} dB PSNR ({psnr.low:+.2f} to {psnr.high:+.2f}), "
        f"no more than {COMPARABLE} dB lower in {comparison.comparable(COMPARABLE)} of them"
    )
    if comparison.psnr_over_seeds is not None:
        sentence += f", {comparison.psnr_over_seeds:.2f} dB spread over seeds"
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
            further = "1 further cell" if lacking == 1 else f"{lacking} further cells"
            sentence += f"; {name} left nothing to measure in {further}"
    return sentence + "."


def standing_sentence(standing: Standing, where: str = "") -> str:
    """Where a setting lies against the whole frontier of another arm; ``where`` begins the sentence."""
    who, whom = standing.setting.name, standing.arm
    outside = _outside(standing)
    if standing.psnr is None:
        return f"{where}{who} has no equal count on {whom}'s frontier: {outside}{needed_clause(standing)}."
    estimate = standing.psnr
    side = "above" if estimate.median >= 0 else "below"
    share = f"{standing.above} of {_cells(estimate.cells)}"
    interval = "" if estimate.low is None else f" [{estimate.low:+.2f}, {estimate.high:+.2f}]"
    sentence = (
        f"{where}{who} lies {abs(estimate.median):.2f} dB{interval} {side} the best of {whom}'s "
        f"{standing.settings} thresholds at equal count, above it in {share}"
    )
    if standing.psnr_over_seeds is not None:
        sentence += f", {standing.psnr_over_seeds:.2f} dB spread over seeds"
    if not is_certain(standing):
        prompts = f"{estimate.prompts} prompt{'s' if estimate.prompts > 1 else ''}"
        sentence += f", which is no certain difference ({prompts})"
    if outside:
        sentence += f"; {outside}"
    return sentence + needed_clause(standing) + "."


def needed_clause(standing: Standing) -> str:
    """How many Gaussians the other arm would need for the same quality; empty where that is unknown."""
    ratio, whom = standing.count_ratio, standing.arm
    if ratio is None:
        return ""
    never = f"{whom} reaches that PSNR at no threshold in {_cells(standing.never)}" if standing.never else ""
    always = (
        f"{whom} exceeds that PSNR at every threshold in {_cells(standing.always)}" if standing.always else ""
    )
    known = f"for the same PSNR {whom} needs {ratio:.2g} times as many" if 0 < ratio < math.inf else ""
    return "".join(
        f"; {part}" for part in (known, *((always, never) if ratio == 0 else (never, always))) if part
    )


def is_certain(standing: Standing) -> bool:
    """Whether the interval excludes 0 and the sign test agrees; without either nothing is certain."""
    return standing.psnr is not None and standing.psnr.is_certain


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
    return "1 cell" if count == 1 else f"{count} cells"
