"""Tables of a sweep as lists of plain lines, written as CSV and shown on its page and in the terminal."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cadam3d.core.number import COUNT, Number
from cadam3d.io.text_tables import write_csv
from cadam3d.report.compare import (
    CorrectedPair,
    PairedComparison,
    Value,
    above_frontier,
    arms_without_growth,
    baseline_of,
    by_cell,
    clock,
    compare,
    gain_over,
    main_setting,
    qualities,
    settings_of,
    value_of,
)
from cadam3d.report.estimate import Estimate
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
    """Return how every setting of the other arms differs from the baseline, by noise level.

    The differences are paired within cells: an :class:`Estimate` of the count in percent, of the numbers by
    which assets are chosen, and of the seconds. The last estimate compares with the best setting of the
    baseline at equal count, if it has several.
    """
    against = baseline_of(results, baseline)
    if against is None:
        return []
    lines = []
    for level in levels_of(results):
        here = at_noise(results, level)
        for other in (each for each in arms_of(here) if each != against):
            for setting in settings_of(here, other):
                if line := _difference(here, setting, against):
                    lines.append({"noise": level, **line})
    return _without_empty(lines)


def _difference(results: Sequence[JobResult], setting: ArmSetting, arm: str) -> Line | None:
    """Return how a setting differs from the main setting of an arm; None if no cell has both."""
    settings = settings_of(results, arm)
    found = compare(results, setting, main_setting(results, arm)) if settings else None
    if found is None:
        return None
    line: Line = {"setting": setting.name, "against": found.theirs.name, "cells": len(found.pairs)}
    line |= _estimates(results, found)
    for quality in qualities(results)[:1] if len(settings) > 1 else []:
        above = above_frontier(results, setting, arm, value_of(quality))
        line[f"{quality.heading} at equal count"] = Estimate.of(above) if above else None
    return line | {"unpaired": found.unpaired or None, "ended early": found.early or None}


def _estimates(results: Sequence[JobResult], found: PairedComparison) -> dict[str, Estimate | None]:
    """Return how two settings differ in count, in the numbers by which assets are chosen, and in time."""
    differences = {name: found.difference(value) for name, value in _values(results).items()}
    return {"Gaussians (%)": found.count, **differences}


def _values(results: Sequence[JobResult]) -> dict[str, Value]:
    return dict([*((each.heading, value_of(each)) for each in qualities(results)), clock(results)])


def two_settings(
    results: Sequence[JobResult], ours: ArmSetting, theirs: ArmSetting
) -> tuple[list[Line], list[Line]]:
    """Return how two settings differ at each noise level: a line per number, and a line per cell.

    Both lists are empty if no cell has both settings.
    """
    numbers: list[Line] = []
    cells: list[Line] = []
    for level in levels_of(results):
        if found := compare(at_noise(results, level), ours, theirs):
            estimates = _estimates(results, found).items()
            numbers += [_number_line(level, name, found, each) for name, each in estimates if each]
            cells += [_cell_line(_values(results), *pair) for pair in found.pairs]
    return _without_empty(numbers), _without_empty(cells)


def _number_line(level: str, name: str, found: PairedComparison, estimate: Estimate) -> Line:
    prompts = {"prompts": estimate.prompts, "above": estimate.above, "below": estimate.below}
    line = {"noise": level, "number": name, "difference": estimate, "cells": estimate.cells, **prompts}
    line |= {"p (signed ranks)": estimate.p_value, "p (signs)": estimate.sign_p_value}
    return line | {"unpaired": found.unpaired or None, "ended early": found.early or None}


def _cell_line(values: Mapping[str, Value], ours: JobResult, theirs: JobResult) -> Line:
    line: Line = {**dict(ours.cell.axes), "Gaussians (%)": 100 * (ours.count / theirs.count - 1)}
    for name, value in {"Gaussians": lambda each: each.count, **values}.items():
        pair = value(ours), value(theirs)
        line[f"{name}: difference"] = None if None in pair else pair[0] - pair[1]
        line |= {
            f"{name}: {each.setting.name}": found for each, found in zip((ours, theirs), pair, strict=True)
        }
    return line


def pairs_table(pairs: Sequence[CorrectedPair]) -> list[Line]:
    """Return a line per pair of arms, with its p-value before and after the correction."""
    lines = []
    for each in pairs:
        names = {"setting": each.comparison.ours.name, "against": each.comparison.theirs.name}
        found = {each.number.heading: each.difference, "p": each.difference.p_value}
        lines.append({"noise": each.noise, **names, "prompts": each.difference.prompts, **found})
        lines[-1]["p corrected"] = each.p_value
    return _without_empty(lines)


def shown_matrix(pairs: Sequence[CorrectedPair]) -> list[Line]:
    """Return a line per arm with its differences from the arms before it; a star marks a certain one."""
    lines: dict[tuple[str, str], Line] = {}
    for each in pairs:
        ours, theirs = each.comparison.ours.name, each.comparison.theirs.name
        line = lines.setdefault((each.noise, ours), {"noise": each.noise, "arm": ours})
        # The interval is below the difference, so that many arms fit on a page.
        difference, _, interval = each.difference.written(each.number.digits).partition(" ")
        line[f"minus {theirs}"] = f"{difference}{' *' * each.is_certain}\n{interval}".rstrip()
    return _without_empty(list(lines.values()))


def shown_comparison(lines: Sequence[Line], results: Sequence[JobResult]) -> list[Line]:
    """Return the lines of main settings of a :func:`comparison_table`, with every estimate as text."""
    names = {main_setting(results, arm).name for arm in arms_of(results)}
    return shown_estimates([line for line in lines if line["setting"] in names], results)


def shown_estimates(lines: Sequence[Line], results: Sequence[JobResult]) -> list[Line]:
    """Return the lines with every estimate as text.

    The number whose digits it has is named by its column, or by the ``number`` of its line.
    """
    digits = {each.heading: each.digits for each in qualities(results)}
    digits |= {f"{heading} at equal count": count for heading, count in digits.items()}

    def text(line: Line, key: str) -> Any:
        value = line[key]
        return value.written(digits.get(line.get("number", key), 1)) if isinstance(value, Estimate) else value

    return [{key: text(line, key) for key in line} for line in lines]


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
                plain[-1] |= {key: value.value, f"{key}: low": value.low, f"{key}: high": value.high}
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
