"""Tables of a sweep: lists of plain rows, written as CSV and as HTML."""

import csv
import math
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any
from urllib.parse import quote

from cadam3d.io.atomic import replacing
from cadam3d.report.claims import SSIM, by_cell, compare, frontier, has_no_growth, standard, standings
from cadam3d.report.figures import arms_of, levels_of
from cadam3d.report.page import show
from cadam3d.report.rows import GUIDANCE, Row, at_noise, measured
from cadam3d.report.words import OURS, THEIRS

Line = dict[str, Any]
NO_RATIO: dict[float | None, str] = {math.inf: "never", 0.0: "always"}  # reaches the quality; exceeds it


def objectives_table(rows: Sequence[Row]) -> list[Line]:
    """Each arm's standard setting by objective and noise: the paper's table 1, medians over cells."""
    lines = []
    for objective in sorted({row.cell[GUIDANCE] for row in measured(rows)}):
        of_objective = [row for row in rows if row.cell[GUIDANCE] == objective]
        for level in levels_of(of_objective):
            here = at_noise(of_objective, level)
            theirs = standard(here, THEIRS)
            for arm in arms_of(here):
                setting = standard(here, arm)
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
                        "PSNR (dB)": _median([row.psnr for row in members], 2),
                        "SSIM": _median([row.ssim for row in members], 4),
                        "Gaussians": _median([row.count for row in members], 0),
                        "MiB": _median([row.mib for row in members], 3),
                        "seconds": _median([row.seconds for row in members], 1),
                        f"fewer than {THEIRS}": f"{pair.reduction.median:.1%}" if pair else None,
                        "ended early": sum(row.ended_early for row in members),
                        "unpaired": (pair.unpaired or None) if pair else None,
                    }
                )
    return _without_empty(lines)


def frontier_table(rows: Sequence[Row]) -> list[Line]:
    """Every setting at every noise level: medians and quartiles over cells, spread over seeds."""
    lines = []
    for level in levels_of(rows):
        here = at_noise(rows, level)
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
                        "quartiles": f"{point.count.low:.0f} to {point.count.high:.0f}",
                        f"{quality} (dB)": round(point.gain.median, 2),
                        f"{quality} quartiles": f"{point.gain.low:.2f} to {point.gain.high:.2f}",
                        "over seeds (dB)": _rounded(point.gain_over_seeds, 2),
                        ssim_title: _rounded(ssim.median if ssim else None, SSIM.digits),
                        "left out": point.left_out or None,
                    }
                )
    return _without_empty(lines)


def standings_table(rows: Sequence[Row]) -> list[Line]:
    """Every setting of our arms against the whole frontier of the baseline, by noise level."""
    lines = []
    for level in levels_of(rows):
        here = at_noise(rows, level)
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


def jobs_table(rows: Sequence[Row]) -> list[Line]:
    """Every job, as it ended."""
    return [
        {
            "job": row.folder.name,
            "setting": row.setting.name,
            **{key: value for key, value in row.cell.axes if value},
            "outcome": row.outcome,
            "Gaussians": None if row.count is None else round(row.count),
            "PSNR (dB)": _rounded(row.psnr, 2),
            "SSIM": _rounded(row.ssim, 4),
            "seconds": row.seconds,
        }
        for row in rows
    ]


def write_csv(path: Path, lines: Sequence[Line]) -> None:
    """Write a table, atomically; an empty one writes nothing."""
    if not lines:
        return
    columns = list(dict.fromkeys(key for line in lines for key in line))
    with replacing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(lines)


def as_html(lines: Sequence[Line], links: str = "") -> str:
    """A table; values of the column ``links`` are folders with a report.html in them. All is escaped."""
    columns = list(dict.fromkeys(key for line in lines for key in line))
    is_text = {key: any(isinstance(line.get(key), str) for line in lines) for key in columns}
    digits = {key: max((_digits(line.get(key)) for line in lines), default=0) for key in columns}
    head = "".join(f"<th{_left(is_text[key])}>{escape(key)}</th>" for key in columns)
    body = "".join(
        "<tr>"
        + "".join(
            f"<td{_left(is_text[key])}>{_cell(line.get(key), digits[key], key == links)}</td>"
            for key in columns
        )
        + "</tr>"
        for line in lines
    )
    return f'<div class="scroll"><table class="numbers"><tr>{head}</tr>{body}</table></div>'


def _cell(value: Any, digits: int, is_link: bool) -> str:
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    text = escape(f"{value:,.{digits}f}" if is_number else show(value))
    return f'<a href="{quote(str(value))}/report.html">{text}</a>' if is_link else text


def _digits(value: Any) -> int:
    """Decimals of a number: a column shows as many as its longest has."""
    return len(repr(value).partition(".")[2]) if isinstance(value, float) else 0


def _left(is_text: bool) -> str:
    return ' class="left"' if is_text else ""


def _median(values: Sequence[float | None], digits: int) -> float | int | None:
    known = sorted(value for value in values if value is not None)
    if not known:
        return None
    middle = (known[(len(known) - 1) // 2] + known[len(known) // 2]) / 2
    return round(middle) if digits == 0 else round(middle, digits)


def _rounded(value: float | None, digits: int) -> float | None:
    return None if value is None else round(value, digits)


def _without_empty(lines: list[Line]) -> list[Line]:
    """Columns that say nothing anywhere are left out."""
    keys = dict.fromkeys(key for line in lines for key in line)
    kept = [key for key in keys if any(line.get(key) not in (None, "", "default") for line in lines)]
    return [{key: line.get(key) for key in kept} for line in lines]
