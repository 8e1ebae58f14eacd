"""Compare: how any two arms of a sweep differ, first within cells and then over all cells.

All functions are pure. An interval comes from a bootstrap that draws prompts with all their cells, because
the seeds, noise levels and objectives of one prompt are not independent samples. The sign test counts
prompts.
"""

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import binomtest, bootstrap, ttest_1samp

from cadam3d.core.number import Number, preferred
from cadam3d.report.results import NOISE, PROMPT, ArmSetting, Cell, JobResult, arms_of, measured

RESAMPLES = 2000
CONFIDENCE = 0.95
BOOTSTRAP_SEED = 0  # the same results give the same interval
# Prompts that an interval needs. With 4, a bootstrap of the median covers the true value in only 85 % of
# cases, and 5 cannot pass a sign test.
LEAST_FOR_INTERVAL = 6

Value = Callable[[JobResult], float | None]


@dataclass(frozen=True)
class Estimate:
    """The median of one value per cell, with its uncertainty."""

    median: float
    # Ends of the 95 % bootstrap interval; None with fewer than LEAST_FOR_INTERVAL prompts.
    low: float | None
    high: float | None
    # Two-sided sign test of "the median is 0" over prompts; None if all values are 0.
    p_value: float | None
    cells: int
    prompts: int

    @classmethod
    def of(cls, values: Mapping[Cell, float]) -> "Estimate":
        """Return the estimate from one value per cell, of which there must be at least one."""
        by_prompt: dict[str, list[float]] = defaultdict(list)
        for cell, value in sorted(values.items()):  # a fixed order makes the bootstrap reproducible
            by_prompt[cell[PROMPT]].append(value)
        groups = list(by_prompt.values())
        low, high = _interval(groups) if len(groups) >= LEAST_FOR_INTERVAL else (None, None)
        middles = [float(np.median(group)) for group in groups]
        ups, downs = sum(middle > 0 for middle in middles), sum(middle < 0 for middle in middles)
        p_value = float(binomtest(ups, ups + downs).pvalue) if ups + downs else None
        return cls(float(np.median(list(values.values()))), low, high, p_value, len(values), len(groups))

    def written(self, digits: int) -> str:
        """Return the median and its interval as text, such as ``+0.21 [+0.03, +0.36]``."""
        median = f"{self.median:+.{digits}f}"
        if self.low is None or self.high is None:
            return median
        return f"{median} [{self.low:+.{digits}f}, {self.high:+.{digits}f}]"


def _interval(groups: Sequence[Sequence[float]]) -> tuple[float, float]:
    """Return the interval of the median of all values when whole groups are drawn."""
    values = np.full((len(groups), max(map(len, groups))), np.nan)
    for line, group in zip(values, groups, strict=True):
        line[: len(group)] = group
    found = bootstrap(
        (np.arange(len(groups)),),
        lambda drawn, axis: np.nanmedian(values[drawn].reshape(*drawn.shape[:-1], -1), axis=axis),
        n_resamples=RESAMPLES,
        confidence_level=CONFIDENCE,
        method="percentile",
        rng=np.random.default_rng(BOOTSTRAP_SEED),
    ).confidence_interval
    return float(found.low), float(found.high)


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
        """Return by how many percent our count exceeds theirs; -90 means that a tenth of theirs remains."""
        return Estimate.of({ours.cell: 100 * (ours.count / theirs.count - 1) for ours, theirs in self.pairs})

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


def references(results: Sequence[JobResult], baseline: str | None = None) -> list[str]:
    """Return the arms that others are compared with: the baseline, and the arm without growth.

    The baseline is ``baseline``, or else the first arm of the sweep that adds Gaussians.
    """
    arms, still = arms_of(results), arms_without_growth(results)
    first = next((arm for arm in arms if arm not in still), None)
    chosen = [baseline if baseline is not None else first, *still[:1]]
    return [arm for arm in dict.fromkeys(chosen) if arm in arms]


def arms_without_growth(results: Iterable[JobResult]) -> list[str]:
    """Return the arms whose densifier has declared that it adds no Gaussian."""
    return list(dict.fromkeys(result.arm for result in measured(results) if not result.grows))


def qualities(results: Iterable[JobResult]) -> list[Number]:
    """Return the numbers by which assets may be chosen, the most preferred one first."""
    return preferred(result.declared[name] for result in measured(results) for name in result.numbers)


def value_of(number: Number) -> Value:
    """Return the function that looks up a number of a result."""
    return lambda result: result.numbers.get(number.name)


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
