"""Tables of a sweep as lists of plain lines, written as CSV and shown on its page and in the terminal."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cadam3d.core.number import COUNT, Number
from cadam3d.io.text_tables import write_csv
from cadam3d.report.compare import (
    Estimate,
    above_frontier,
    arms_without_growth,
    by_cell,
    compare,
    gain_over,
    main_setting,
    qualities,
    references,
    settings_of,
    value_of,
)
from cadam3d.report.results import (
    ArmSetting,
    JobResult,
    arms_of,
    at_noise,
    levels_of,
    measured,
    objective_axis,
)

Line = dict[str, Any]


def comparison_table(results: Sequence[JobResult], baseline: str | None = None) -> list[Line]:
    """Return how every setting differs from each reference arm, by noise level.

    The differences are paired within cells: an :class:`Estimate` of the count in percent, of the numbers by
    which assets are chosen, and of the seconds. The last estimate compares with the best setting of the
    reference arm at equal count, if it has several.
    """
    against = references(results, baseline)
    lines = []
    for level in levels_of(results):
        here = at_noise(results, level)
        for position, arm in enumerate(against):
            for other in (each for each in arms_of(here) if each not in against[: position + 1]):
                for setting in settings_of(here, other):
                    if line := _difference(here, setting, arm):
                        lines.append({"noise": level, **line})
    return _without_empty(lines)


def _difference(results: Sequence[JobResult], setting: ArmSetting, arm: str) -> Line | None:
    """Return how a setting differs from the main setting of an arm; None if no cell has both."""
    settings = settings_of(results, arm)
    found = compare(results, setting, main_setting(results, arm)) if settings else None
    if found is None:
        return None
    line: Line = {"setting": setting.name, "against": found.theirs.name, "cells": len(found.pairs)}
    line["Gaussians (%)"] = found.count
    for quality in qualities(results):
        line[quality.heading] = found.difference(value_of(quality))
    line["seconds"] = found.difference(lambda result: result.seconds)
    for quality in qualities(results)[:1] if len(settings) > 1 else []:
        above = above_frontier(results, setting, arm, value_of(quality))
        line[f"{quality.heading} at equal count"] = Estimate.of(above) if above else None
    return line | {"unpaired": found.unpaired or None, "ended early": found.early or None}


def shown_comparison(lines: Sequence[Line], results: Sequence[JobResult]) -> list[Line]:
    """Return the lines of main settings of a :func:`comparison_table`, with every estimate as text."""
    digits = {each.heading: each.digits for each in qualities(results)}
    digits |= {f"{heading} at equal count": count for heading, count in digits.items()}
    names = {main_setting(results, arm).name for arm in arms_of(results)}

    def text(key: str, value: Any) -> Any:
        return value.written(digits.get(key, 1)) if isinstance(value, Estimate) else value

    return [
        {key: text(key, value) for key, value in line.items()} for line in lines if line["setting"] in names
    ]


def medians_table(results: Sequence[JobResult]) -> list[Line]:
    """Return medians over cells of every setting by objective and noise (paper table 1)."""
    axis, numbers = objective_axis(results), _compared(results)
    gain = next((each for each in qualities(results) if arms_without_growth(results)), None)
    lines = []
    for objective in sorted({result.cell[axis] for result in measured(results)}):
        of_objective = [result for result in results if result.cell[axis] == objective]
        for level in levels_of(of_objective):
            here = at_noise(of_objective, level)
            for setting in (each for arm in arms_of(here) for each in settings_of(here, arm)):
                members = list(by_cell(here, setting).values())
                line: Line = {"objective": objective, "noise": level, "setting": setting.name}
                line["cells"] = len(members)
                for each in numbers:
                    line[each.heading] = _median(map(value_of(each), members), each.digits)
                if gain is not None:
                    gains = map(gain_over(here, value_of(gain)), members)
                    line[f"{gain.label} over no growth"] = _median(gains, gain.digits)
                line["seconds"] = _median((result.seconds for result in members), 1)
                line["ended early"] = sum(result.ended_early for result in members) or None
                lines.append(line)
    return _without_empty(lines)


def write(path: Path, lines: Sequence[Line]) -> None:
    """Write a table as CSV, atomically, an estimate as three columns."""
    plain = []
    for line in lines:
        plain.append({})
        for key, value in line.items():
            if isinstance(value, Estimate):
                plain[-1] |= {key: value.median, f"{key}: low": value.low, f"{key}: high": value.high}
            else:
                plain[-1][key] = value
    keys = list(dict.fromkeys(key for line in plain for key in line))
    write_csv(path, [keys, *([line.get(key) for key in keys] for line in plain)])


def _compared(results: Iterable[JobResult]) -> list[Number]:
    """Return the numbers of these results of which more or less is better, the count first."""
    found = {name: result.declared[name] for result in results for name in result.numbers}
    compared = [each for each in found.values() if each.is_more_better is not None]
    return sorted(compared, key=lambda each: each.name != COUNT.name)


def _median(values: Iterable[float | None], digits: int) -> float | int | None:
    known = [value for value in values if value is not None]
    # Without digits, the result is a whole number.
    return round(float(np.median(known)), digits or None) if known else None


def _without_empty(lines: list[Line]) -> list[Line]:
    """Return the lines without columns that are empty or at their default everywhere."""
    keys = dict.fromkeys(key for line in lines for key in line)
    kept = [key for key in keys if any(line.get(key) not in (None, "", "default") for line in lines)]
    return [{key: line.get(key) for key in kept} for line in lines]
