"""Print what ``grid=learned`` shows about the densifiers, by prior and strength of guidance, as Markdown.

    python scripts/learned_study.py multirun/learned

All differences are within cells (one prompt, seed, prior and scale of guidance). A difference has its 95 %
interval and the p-value of the signed-rank test over prompts, as in the report of a sweep (docs/sweeps.md).
PSNR is that at the best turn.
"""

from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path

import measuring
import numpy as np

from cadam3d.io.records import read_metrics
from cadam3d.report.compare import (
    Value,
    above_frontier,
    arms_without_growth,
    compare,
    gain_over,
    main_setting,
    settings_of,
)
from cadam3d.report.estimate import Estimate
from cadam3d.report.results import JobResult, arms_of, measured, read

PRIOR, SCALE, SEED = "prior", "guidance.scale", "seed"
# Pairs of arms that answer a question each: does the first do better than the second?
QUESTIONS = (
    ("cadam", "none"),
    ("cadam", "baseline"),
    ("cadam_no_snr", "cadam"),
    ("cadam_annealed", "cadam"),
    ("cadam_no_reset", "cadam"),
    ("cadam_global_reset", "cadam"),
)
FRONTIER = "baseline"
# The seed that has all settings of the baseline.
FRONTIER_SEED = "0"
STATISTICS = ("snr_p10", "snr_p50", "snr_p90", "share_above_tau_SNR")


def table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    return "\n".join([measuring.header(columns), *map(measuring.line_of, rows)])


def part(results: Sequence[JobResult], prior: str, scale: str) -> list[JobResult]:
    """Return the results with one prior and one scale of guidance."""
    return [each for each in results if each.cell[PRIOR] == prior and each.cell[SCALE] == scale]


def values_of(results: Sequence[JobResult], key: str) -> list[str]:
    """Return the values of an axis of the cells."""
    return sorted({each.cell[key] for each in results})


def parts(results: Sequence[JobResult]) -> Iterator[tuple[str, list[JobResult]]]:
    """Yield the results of each prior and scale with a name, and then all results.

    What the sweep does not vary is not in the name.
    """
    for prior, scale in product(values_of(results, PRIOR), values_of(results, SCALE)):
        if own := part(results, prior, scale):
            names = (prior and f"`{prior}`", scale and f"scale {scale}")
            yield ", ".join(filter(None, names)), own
    yield "all", list(results)


def written(estimate: Estimate | None, digits: int) -> str:
    """Return an estimate with its interval and p-value; empty if there is none."""
    return "" if estimate is None else f"{estimate.written(digits)}, p = {estimate.p_value:.2g}"


def psnr(result: JobResult) -> float | None:
    """Return the PSNR of a result, at the best turn if its asset may face any side."""
    return result.numbers.get("psnr_turned", result.numbers.get("psnr"))


def median(numbers: Sequence[float | None]) -> float:
    """Return the median of the numbers that are known; NaN if none is."""
    known = [number for number in numbers if number is not None]
    return float(np.median(known)) if known else np.nan


def levels(results: Sequence[JobResult]) -> str:
    """Return a table of all settings: medians of the count, the PSNR, the gain over no growth and the IoU."""
    numbers: list[Value] = [
        lambda each: each.count,
        psnr,
        gain_over(results, psnr),
        lambda each: each.numbers.get("iou"),
    ]
    rows = []
    for arm in arms_of(results):
        for setting in settings_of(results, arm):
            own = [each for each in measured(results) if each.setting == setting]
            medians = [median([number(each) for each in own]) for number in numbers]
            early = sum(each.ended_early for each in own)
            cells = [f"{len(own)}" + (f" ({early} ended early)" if early else ""), f"{medians[0]:,.0f}"]
            rows.append(
                [setting.name, *cells, f"{medians[1]:.2f}", f"{medians[2]:+.2f}", f"{medians[3]:.3f}"]
            )
    return table(["setting", "jobs", "Gaussians", "PSNR (dB)", "gain over none (dB)", "IoU"], rows)


def differences(results: Sequence[JobResult]) -> str:
    """Return a table of the paired differences that answer the questions."""
    rows = []
    for ours, theirs in QUESTIONS:
        if not {ours, theirs} <= set(arms_of(results)):
            continue
        for name, own in parts(results):
            found = compare(own, main_setting(results, ours), main_setting(results, theirs))
            if found is not None:
                numbers = [f"{len(found.pairs)}", written(found.difference(psnr), 2), written(found.count, 1)]
                rows.append([f"`{ours}` over `{theirs}`", name, *numbers])
    return table(["comparison", "where", "cells", "PSNR (dB)", "Gaussians (%)"], rows)


def frontier(results: Sequence[JobResult]) -> str:
    """Return a table of how far the settings are above the frontier of the baseline, at equal count."""
    seeded = [each for each in results if each.cell[SEED] == FRONTIER_SEED]
    rows = []
    others = [arm for arm in arms_of(seeded) if arm != FRONTIER and arm not in arms_without_growth(seeded)]
    for arm in others:
        for name, own in parts(seeded):
            for setting in settings_of(own, arm):
                above = above_frontier(own, setting, FRONTIER, psnr)
                better = f", {sum(each > 0 for each in above.values())} of {len(above)}" if above else ""
                text = written(Estimate.of(above) if above else None, 2)
                rows.append([f"`{arm}`", name, f"{text}{better}"])
    return table(["arm", "where", "above the frontier (dB)"], rows)


def over_time(results: Sequence[JobResult], arm: str) -> str:
    """Return a table of the SNR and of the growth of an arm, by refinement: medians over jobs."""
    rows = []
    for name, own in parts(results):
        by_step: dict[int, list[list[float]]] = {}
        for job in measured(own):
            if job.arm != arm:
                continue
            for line in read_metrics(job.folder):
                if line.get("kind") == "refine" and "snr_p50" in line["statistics"]:
                    numbers = [line["statistics"][key] for key in STATISTICS]
                    numbers += [line["selected"] / max(1, line["before"])]
                    by_step.setdefault(line["step"], []).append(numbers)
        for step, lines in sorted(by_step.items()):
            p10, p50, p90, above, selected = np.median(lines, axis=0)
            snrs = [f"{value:.2f}" for value in (p10, p50, p90)]
            rows.append([name, f"{step}", *snrs, f"{100 * above:.0f} %", f"{100 * selected:.1f} %"])
    return table(["where", "step", "SNR 10 %", "median", "90 %", "above the gate", "selected"], rows)


def main(line: Sequence[str] | None = None) -> None:
    parser = measuring.parser_of(__doc__)
    parser.add_argument("sweep", type=Path, help="folder of the sweep")
    results = read(parser.parse_args(line).sweep)
    for name, own in parts(results):
        print(f"\n## {name}\n\n{levels(own)}")
    print(f"\n## Differences\n\n{differences(results)}")
    print(f"\n## Against the frontier of `{FRONTIER}` (seed {FRONTIER_SEED})\n\n{frontier(results)}")
    for arm in ("cadam", "cadam_no_snr"):
        print(f"\n## `{arm}` over time\n\n{over_time(results, arm)}")


if __name__ == "__main__":
    main()
