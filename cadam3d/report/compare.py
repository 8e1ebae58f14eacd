"""Compare: how any two arms of a sweep differ, first within cells and then over prompts.

All functions are pure.
"""

import math
import shlex
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.stats import ttest_1samp

from cadam3d.core.checks import fail
from cadam3d.core.number import Number, preferred
from cadam3d.report.estimate import CONFIDENCE, Estimate, holm
from cadam3d.report.formatting import number
from cadam3d.report.results import NOISE, ArmSetting, Cell, JobResult, arms_of, at_noise, levels_of, measured

Value = Callable[[JobResult], float | None]


@dataclass(frozen=True)
class Mean:
    """A mean over prompts, or a difference or a ratio of means, as in the paper's table."""

    value: float
    half: float | None  # half the width of its 95 % interval; None for a single prompt
    prompts: int


def mean(values: Mapping[str, float]) -> Mean | None:
    """Return the mean of one value per prompt with Student's t interval; None without values."""
    if not values:
        return None
    numbers = list(values.values())
    return Mean(float(np.mean(numbers)), _half(numbers), len(numbers))


def change(ours: Mapping[str, float], theirs: Mapping[str, float]) -> Mean | None:
    """Return by how many percent ``ours`` exceeds ``theirs`` on average; both have the same prompts.

    The interval is for the ratio of two paired means, by linearisation: the mean of ``ours - ratio *
    theirs`` is 0, and its interval is divided by the mean of ``theirs``. None without a prompt, and if the
    mean of ``theirs`` is 0.
    """
    base = sum(theirs.values()) / len(theirs) if theirs else 0.0
    if not base:
        return None
    ratio = sum(ours.values()) / len(ours) / base
    half = _half([ours[prompt] - ratio * theirs[prompt] for prompt in sorted(ours)])
    return Mean(100 * (ratio - 1), None if half is None else 100 * half / abs(base), len(ours))


def _half(values: Sequence[float]) -> float | None:
    """Return half the width of Student's t interval of the mean; None for a single value."""
    if len(values) < 2:
        return None
    if min(values) == max(values):
        return 0.0
    interval = ttest_1samp(values, 0).confidence_interval(CONFIDENCE)
    return float(interval.high - interval.low) / 2


# Two settings in the same cells.


@dataclass(frozen=True)
class PairedComparison:
    """Two settings in all cells that have both."""

    ours: ArmSetting
    theirs: ArmSetting
    pairs: list[tuple[JobResult, JobResult]]  # ours and theirs in one cell; at least one pair
    unpaired: int  # cells in which only one of the two left something to measure

    @property
    def count(self) -> Estimate:
        """Return by how many percent our count exceeds theirs; -90 means that a tenth of theirs remains.

        The logarithms are compared, so that exchanging the arms inverts the result.
        """
        ratios = {ours.cell: math.log(ours.count / theirs.count) for ours, theirs in self.pairs}
        return Estimate.of(ratios).mapped(lambda ratio: 100 * math.expm1(ratio))

    @property
    def early(self) -> int:
        """Return the number of cells in which one of the two stopped before its last step."""
        return sum(ours.ended_early or theirs.ended_early for ours, theirs in self.pairs)

    def difference(self, value: Value) -> Estimate | None:
        """Return our value minus theirs over the cells in which both have it; None without such a cell."""
        found = {ours.cell: (value(ours), value(theirs)) for ours, theirs in self.pairs}
        known = {cell: a - b for cell, (a, b) in found.items() if a is not None and b is not None}
        return Estimate.of(known) if known else None


def compare(results: Sequence[JobResult], ours: ArmSetting, theirs: ArmSetting) -> PairedComparison | None:
    """Compare two settings cell by cell; ``None`` if no cell has both."""
    of_ours, of_theirs = by_cell(results, ours), by_cell(results, theirs)
    pairs = [(of_ours[cell], of_theirs[cell]) for cell in sorted(of_ours.keys() & of_theirs.keys())]
    if not pairs:
        return None
    return PairedComparison(ours, theirs, pairs, len(of_ours.keys() ^ of_theirs.keys()))


def main_setting(results: Sequence[JobResult], arm: str) -> ArmSetting:
    """Return the setting that stands for an arm that was measured.

    This is the setting with the shipped thresholds, or else the one with the middle count.
    """
    own = [result for result in measured(results) if result.arm == arm]
    shipped = [result.setting for result in own if result.is_standard]
    if shipped:
        return shipped[0]
    counts: dict[ArmSetting, list[float]] = defaultdict(list)
    for result in own:
        counts[result.setting].append(result.count)
    ordered = sorted(counts, key=lambda setting: float(np.median(counts[setting])))
    return ordered[(len(ordered) - 1) // 2]


def named_settings(results: Sequence[JobResult], names: Sequence[str]) -> list[ArmSetting]:
    """Return the two settings of these names, which have a cell in common.

    An arm stands for its main setting. Raises ``UserError`` for other names, and without a common cell.
    """
    known = {arm: main_setting(results, arm) for arm in arms_of(results)}
    known |= {each.name: each for arm in arms_of(results) for each in settings_of(results, arm)}
    example = shlex.quote(f"arms=[{','.join(arms_of(results)[:2])}]")
    if len(names) != 2 or not known.keys() >= set(names):
        raise fail("arms", expected=f"two of {', '.join(known)}", got=", ".join(names), example=example)
    ours, theirs = (known[name] for name in names)
    if not compare(results, ours, theirs):
        raise fail("arms", expected="settings with a cell in common", got=", ".join(names), example=example)
    return [ours, theirs]


def baseline_of(results: Sequence[JobResult], baseline: str | None = None) -> str | None:
    """Return the arm that others are compared with: ``baseline``, or else the first one that adds Gaussians.

    Returns ``None`` if that arm left nothing to measure.
    """
    arms, still = arms_of(results), arms_without_growth(results)
    first = next((arm for arm in arms if arm not in still), None)
    chosen = first if baseline is None else baseline
    return chosen if chosen in arms else None


def arms_without_growth(results: Iterable[JobResult]) -> list[str]:
    """Return the arms whose densifier has declared that it adds no Gaussian."""
    return list(dict.fromkeys(result.arm for result in measured(results) if not result.grows))


@dataclass(frozen=True)
class CorrectedPair:
    """The difference in quality of two arms, as one of a family of comparisons."""

    noise: str
    comparison: PairedComparison
    number: Number  # the quality
    difference: Estimate
    p_value: float  # of the signed-rank test, corrected by Holm's method for all pairs of the family

    @property
    def is_certain(self) -> bool:
        """Return whether the arms differ, with an error of at most 5 % in the whole family."""
        return self.p_value <= 1 - CONFIDENCE


def every_pair(results: Sequence[JobResult]) -> list[CorrectedPair]:
    """Compare the main settings of every two arms at each noise level, by the preferred quality.

    All these pairs are the family for which the p-values are corrected.
    """
    found = []
    for quality in qualities(results)[:1]:
        for level in levels_of(results):
            here = at_noise(results, level)
            for theirs, ours in combinations([main_setting(here, arm) for arm in arms_of(here)], 2):
                comparison = compare(here, ours, theirs)
                if comparison and (difference := comparison.difference(value_of(quality))):
                    found.append(CorrectedPair(level, comparison, quality, difference, 1.0))
    corrected = holm([pair.difference.p_value for pair in found])
    return [replace(pair, p_value=p_value) for pair, p_value in zip(found, corrected, strict=True)]


def qualities(results: Iterable[JobResult]) -> list[Number]:
    """Return the numbers by which assets may be chosen, the most preferred one first."""
    return preferred(result.declared[name] for result in measured(results) for name in result.numbers)


def could_be_certain(pairs: Sequence[CorrectedPair]) -> bool:
    """Return whether a pair could be certain among so many, if all its prompts agreed."""
    return any(2 * len(pairs) / 2**each.difference.prompts <= 1 - CONFIDENCE for each in pairs)


def clock(results: Iterable[JobResult]) -> tuple[str, Value]:
    """Return the heading and the value of the training time: CPU seconds if all jobs have them."""
    has_cpu = all("cpu_seconds" in result.summary for result in measured(results))
    key, heading = ("cpu_seconds", "CPU seconds") if has_cpu else ("seconds", "seconds")
    return heading, lambda result: number(result.summary.get(key))


def value_of(declared: Number) -> Value:
    """Return the function that looks up a number of a result."""
    return lambda result: result.numbers.get(declared.name)


def by_cell(results: Iterable[JobResult], setting: ArmSetting) -> dict[Cell, JobResult]:
    """Return the measured result of a setting in each cell; of two in one cell the later one."""
    return {result.cell: result for result in measured(results) if result.setting == setting}


def settings_of(results: Iterable[JobResult], arm: str) -> list[ArmSetting]:
    """Return the settings of an arm that left something to measure."""
    found = {result.setting for result in measured(results) if result.arm == arm}
    return sorted(found, key=lambda setting: setting.order)


# The gain over no growth, and the frontier of an arm.


def gain_over(reference: Sequence[JobResult], value: Value) -> Value:
    """Return a function: the value of a result minus the value of its job without growth in ``reference``.

    The job without growth has the same prompt and seed. The function returns None where that job or the
    value is missing, and the plain value if ``reference`` holds no job without growth at all.
    """
    still = [result for result in measured(reference) if not result.grows]
    if not still:
        return value
    zeros = {result.cell.without(NOISE): value(result) for result in still}

    def gain(result: JobResult) -> float | None:
        here, zero = value(result), zeros.get(result.cell.without(NOISE))
        return None if here is None or zero is None else here - zero

    return gain


# The first quartile, the median and the third quartile: between the quartiles is the middle half.
Quartiles = tuple[float, float, float]


def quartiles(values: Iterable[float]) -> Quartiles:
    """Return the quartiles of at least one value."""
    low, median, high = np.quantile(list(values), (0.25, 0.5, 0.75)).tolist()
    return low, median, high


@dataclass(frozen=True)
class FrontierPoint:
    """One setting over all its cells with a count and a quality."""

    setting: ArmSetting
    is_standard: bool
    early: int  # cells whose job stopped before its last step
    count: Quartiles  # of the Gaussians
    gain: Quartiles  # of the quality


def frontier(results: Sequence[JobResult], arm: str, gain: Value) -> list[FrontierPoint]:
    """Return the settings of ``arm``, those with fewest Gaussians first.

    ``results`` belong to one noise level. ``gain`` returns the quality of a result, such as
    :func:`gain_over`; cells without it are left out.
    """
    points = []
    for setting in settings_of(results, arm):
        members = [(each, gain(each)) for each in by_cell(results, setting).values()]
        known = [(each, found) for each, found in members if found is not None]
        if known:
            points.append(
                FrontierPoint(
                    setting=setting,
                    is_standard=any(each.is_standard for each, _ in known),
                    early=sum(each.ended_early for each, _ in known),
                    count=quartiles(each.count for each, _ in known),
                    gain=quartiles(found for _, found in known),
                )
            )
    return sorted(points, key=lambda point: point.count[1])


def hull_of(points: Iterable[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return the best that an arm can do: the corners of the upper concave hull of quality over log10 count.

    ``points`` are count (> 0) and quality of at least one setting. Where more Gaussians only hurt, the hull
    stays level, because the arm could stop growing. It ends at the settings with fewest and most Gaussians.
    """
    best: dict[float, float] = {}
    for count, quality in points:
        best[math.log10(count)] = max(quality, best.get(math.log10(count), -math.inf))
    best[max(best)] = max(best.values())
    corners: list[tuple[float, float]] = []
    for point in sorted(best.items()):
        while len(corners) >= 2 and _slope(corners[-2], corners[-1]) <= _slope(corners[-1], point):
            corners.pop()
        corners.append(point)
    return corners


def _slope(a: tuple[float, float], b: tuple[float, float]) -> float:
    return (b[1] - a[1]) / (b[0] - a[0])


def quality_at(corners: Sequence[tuple[float, float]], count: float) -> float | None:
    """Return the height of a hull at ``count`` Gaussians; ``None`` outside the range of its settings."""
    x, (xs, ys) = math.log10(count), zip(*corners, strict=True)
    return float(np.interp(x, xs, ys)) if xs[0] - 1e-12 <= x <= xs[-1] + 1e-12 else None


def above_frontier(
    results: Sequence[JobResult], setting: ArmSetting, arm: str, value: Value
) -> dict[Cell, float]:
    """Return by how much a setting exceeds the best of another arm's settings at equal count, in each cell.

    The other arm may choose its setting in each cell separately. Cells in which the setting has fewer or more
    Gaussians than all settings of the other arm are left out, because nothing is extrapolated.
    """
    places: dict[Cell, list[tuple[float, float]]] = defaultdict(list)
    for result in measured(results):
        if result.arm == arm and (quality := value(result)) is not None:
            places[result.cell].append((result.count, quality))
    found = {}
    for cell, result in by_cell(results, setting).items():
        quality = value(result)
        best = quality_at(hull_of(places[cell]), result.count) if cell in places else None
        if quality is not None and best is not None:
            found[cell] = quality - best
    return found
