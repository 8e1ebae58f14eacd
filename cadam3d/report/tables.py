"""Tables of a sweep as lists of plain lines, written as CSV and shown on its page."""

import csv
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from cadam3d.io.atomic import replacing
from cadam3d.metric.fidelity import PSNR_START
from cadam3d.metric.outline import COLOUR_ERROR, IOU, IOU_START
from cadam3d.report.claims import (
    PSNR,
    SSIM,
    by_cell,
    compare,
    frontier,
    has_no_growth,
    standard_setting,
    standings,
)
from cadam3d.report.results import JobResult, arms_of, at_noise, levels_of, measured, objective_axis
from cadam3d.report.verdicts import OURS, THEIRS

Line = dict[str, Any]
# Infinite: the other arm never reaches the quality; 0: it always exceeds it.
NO_RATIO: dict[float | None, str] = {math.inf: "never", 0.0: "always"}

# Columns of results that are compared with a named truth: the field of the result, and its decimal places.
OF_TRUTH = {
    number.heading: (number.name, number.digits) for number in (PSNR_START, IOU, IOU_START, COLOUR_ERROR)
}


def objectives_table(results: Sequence[JobResult]) -> list[Line]:
    """Return the standard setting of each arm by objective and noise, medians over cells (paper table 1)."""
    lines, axis = [], objective_axis(results)
    for objective in sorted({result.cell[axis] for result in measured(results)}):
        of_objective = [result for result in results if result.cell[axis] == objective]
        for level in levels_of(of_objective):
            here = at_noise(of_objective, level)
            theirs = standard_setting(here, THEIRS)
            for arm in arms_of(here):
                setting = standard_setting(here, arm)
                if setting is None:
                    continue
                members = list(by_cell(here, setting).values())
                pair = compare(here, setting, theirs) if theirs and theirs != setting else None
                lines.append(
                    {
                        "objective": objective,
                        "noise": level,
                        "arm": arm,
                        "cells": len(members),
                        PSNR.axis: _median([result.psnr for result in members], PSNR.digits),
                        SSIM.axis: _median([result.ssim for result in members], SSIM.digits),
                        **{
                            title: _median([getattr(result, name) for result in members], digits)
                            for title, (name, digits) in OF_TRUTH.items()
                        },
                        "Gaussians": _median([result.count for result in members], 0),
                        "MiB": _median([result.mib for result in members], 3),
                        "seconds": _median([result.seconds for result in members], 1),
                        f"fewer than {THEIRS}": f"{pair.reduction.median:.1%}" if pair else None,
                        "ended early": sum(result.ended_early for result in members),
                        "unpaired": (pair.unpaired or None) if pair else None,
                    }
                )
    return _without_empty(lines)


def frontier_table(results: Sequence[JobResult]) -> list[Line]:
    """Return every setting at every noise level: medians and spreads over cells and over seeds."""
    lines = []
    for level in levels_of(results):
        here = at_noise(results, level)
        gains = has_no_growth(here)
        quality, ssim_title = ("gain", "SSIM gain") if gains else ("PSNR", "SSIM")
        for arm in arms_of(here):
            ssims = {point.setting: point.gain for point in frontier(here, arm, quality=SSIM)}
            for point in frontier(here, arm):
                ssim = ssims.get(point.setting)
                lines.append(
                    {
                        "noise": level,
                        "setting": point.setting.name,
                        "cells": point.cells,
                        "ended early": point.early,
                        "Gaussians": round(point.count.median),
                        "over cells": point.count.described(lambda value: f"{value:.0f}"),
                        f"{quality} (dB)": round(point.gain.median, 2),
                        f"{quality} over cells (dB)": point.gain.described(lambda value: f"{value:.2f}"),
                        "over seeds (dB)": _rounded(point.gain_over_seeds, 2),
                        ssim_title: _rounded(ssim.median if ssim else None, SSIM.digits),
                        "left out": point.left_out or None,
                    }
                )
    return _without_empty(lines)


def standings_table(results: Sequence[JobResult]) -> list[Line]:
    """Return every setting of our arms compared with the whole frontier of the baseline, by noise level."""
    lines = []
    for level in levels_of(results):
        here = at_noise(results, level)
        for arm in (arm for arm in arms_of(here) if arm.startswith(OURS)):
            for each in standings(here, arm, THEIRS):
                estimate = each.psnr
                lines.append(
                    {
                        "noise": level,
                        "setting": each.setting.name,
                        "dB above at equal count": _rounded(estimate.median if estimate else None, 2),
                        "low (95 %)": _rounded(estimate.low if estimate else None, 2),
                        "high": _rounded(estimate.high if estimate else None, 2),
                        "sign test p": _rounded(estimate.p_value if estimate else None, 3),
                        "over seeds (dB)": _rounded(each.psnr_over_seeds, 2),
                        "above in": f"{each.above} of {estimate.cells if estimate else 0}",
                        "fewer than any": each.fewer,
                        "more than any": each.more,
                        f"{THEIRS} needs times": NO_RATIO.get(
                            each.count_ratio, _rounded(each.count_ratio, 2)
                        ),
                        "never reaches": each.never,
                        "always exceeds": each.always,
                        "unpaired": each.unpaired or None,
                    }
                )
    return _without_empty(lines) if any(line["dB above at equal count"] is not None for line in lines) else []


def jobs_table(results: Sequence[JobResult]) -> list[Line]:
    """Return every job with its outcome. The columns of a named truth are left out if no job has one."""
    known = {
        title: column
        for title, column in OF_TRUTH.items()
        if any(getattr(result, column[0]) is not None for result in results)
    }
    return [
        {
            "job": result.folder.name,
            "setting": result.setting.name,
            **{key: value for key, value in result.cell.axes if value},
            "outcome": result.outcome,
            "Gaussians": None if result.count is None else round(result.count),
            PSNR.axis: _rounded(result.psnr, PSNR.digits),
            SSIM.axis: _rounded(result.ssim, SSIM.digits),
            **{title: _rounded(getattr(result, name), digits) for title, (name, digits) in known.items()},
            "seconds": result.seconds,
        }
        for result in results
    ]


def write_csv(path: Path, lines: Sequence[Line]) -> None:
    """Write a table atomically; an empty one writes no file."""
    if not lines:
        return
    columns = list(dict.fromkeys(key for line in lines for key in line))
    with replacing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(lines)


def _median(values: Sequence[float | None], digits: int) -> float | int | None:
    known = sorted(value for value in values if value is not None)
    if not known:
        return None
    middle = (known[(len(known) - 1) // 2] + known[len(known) // 2]) / 2
    return round(middle) if digits == 0 else round(middle, digits)


def _rounded(value: float | None, digits: int) -> float | None:
    return None if value is None else round(value, digits)


def _without_empty(lines: list[Line]) -> list[Line]:
    """Return the lines without columns that are empty or at their default everywhere."""
    keys = dict.fromkeys(key for line in lines for key in line)
    kept = [key for key in keys if any(line.get(key) not in (None, "", "default") for line in lines)]
    return [{key: line.get(key) for key in kept} for line in lines]
