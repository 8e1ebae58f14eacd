"""Claims: what the results of a sweep say about settings, first within cells, then over all cells.

All functions are pure. Medians run over cells. An interval comes from a bootstrap that draws prompts with
all their cells, because the seeds, noise levels and objectives of one prompt are not independent samples. The
sign test counts prompts.
"""

import math
from collections import defaultdict
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.stats import binomtest

from cadam3d.core.number import Number
from cadam3d.metric import fidelity
from cadam3d.report.results import NOISE, PROMPT, SEED, ArmSetting, Cell, JobResult, measured

NO_GROWTH = "none"  # the arm that gains are measured from
RESAMPLES = 2000
CONFIDENCE = 0.95
BOOTSTRAP_SEED = 0  # the same results give the same interval
# Prompts that an interval needs. With 4, a bootstrap of the median covers the true value in only 85 % of
# cases, and 5 cannot pass a sign test.
LEAST_FOR_INTERVAL = 6
SIGNIFICANT = 1 - CONFIDENCE  # of the sign test
# Prompts that quartiles need. Those of fewer would look like an interval, but say no more than the values do.
LEAST_FOR_QUARTILES = 5
MOST_LISTED = 4  # values that are listed one by one


@dataclass(frozen=True)
class Compared:
    """A quality by which settings are compared; more is better."""

    number: Number
    of: Callable[[JobResult], float | None]

    @property
    def digits(self) -> int:
        """Return the number of digits after the point, in tables."""
        return self.number.digits

    @property
    def unit(self) -> str:
        """Return the unit; empty if there is none."""
        return self.number.unit

    @property
    def axis(self) -> str:
        """Return the label of an axis: the name with its unit."""
        return self.number.heading

    @property
    def gain(self) -> str:
        """Return the label of the difference to the job without growth, with its unit."""
        return replace(self.number, label=f"{self.number.label} gained by growth").heading


PSNR = Compared(fidelity.PSNR, lambda result: result.psnr)
SSIM = Compared(fidelity.SSIM, lambda result: result.ssim)


@dataclass(frozen=True)
class Spread:
    """The median of numbers, one per cell, and how far they differ.

    This is the only place that decides how a page shows that: with quartiles if there are at least
    ``LEAST_FOR_QUARTILES`` prompts, else with the values themselves or the lowest and the highest.
    """

    values: tuple[float, ...]  # sorted
    has_quartiles: bool

    @classmethod
    def of(cls, values: Mapping[Cell, float]) -> "Spread":
        """Return the spread of one value per cell, of which there must be at least one."""
        prompts = {cell[PROMPT] for cell in values}
        return cls(tuple(sorted(values.values())), len(prompts) >= LEAST_FOR_QUARTILES)

    @property
    def median(self) -> float:
        """Return the median."""
        return float(np.median(self.values))

    @property
    def low(self) -> float:
        """Return the first quartile, or the lowest value if there are too few prompts."""
        return float(np.quantile(self.values, self.ends[0]))

    @property
    def high(self) -> float:
        """Return the third quartile, or the highest value if there are too few prompts."""
        return float(np.quantile(self.values, self.ends[1]))

    @property
    def ends(self) -> tuple[float, float]:
        """Return the probabilities of the quantiles ``low`` and ``high``."""
        return (0.25, 0.75) if self.has_quartiles else (0.0, 1.0)

    def negated(self) -> "Spread":
        """Return the spread of the negative values."""
        return Spread(tuple(-value for value in reversed(self.values)), self.has_quartiles)

    def described(self, written: Callable[[float], str]) -> str:
        """Return the spread in words; ``written`` turns a number into text."""
        if self.has_quartiles:
            return f"quartiles {written(self.low)} to {written(self.high)}"
        if len(self.values) == 1:
            return f"value {written(self.values[0])}"
        if len(self.values) <= MOST_LISTED:
            return f"values {', '.join(map(written, self.values))}"
        return f"lowest {written(self.low)}, highest {written(self.high)}"


@dataclass(frozen=True)
class Estimate:
    """A median over cells and its uncertainty."""

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
        groups = list(_grouped(values, lambda cell: cell[PROMPT]).values())
        low, high = _bootstrap(groups) if len(groups) >= LEAST_FOR_INTERVAL else (None, None)
        middles = [float(np.median(group)) for group in groups]
        ups, downs = sum(middle > 0 for middle in middles), sum(middle < 0 for middle in middles)
        p_value = float(binomtest(ups, ups + downs).pvalue) if ups + downs else None
        return cls(float(np.median(list(values.values()))), low, high, p_value, len(values), len(groups))

    @property
    def is_certain(self) -> bool:
        """Return whether the interval excludes 0 and the sign test agrees; False if either is missing."""
        if self.low is None or self.high is None or self.p_value is None:
            return False
        return (self.low > 0 or self.high < 0) and self.p_value < SIGNIFICANT


@dataclass(frozen=True)
class Pair:
    """The results of two settings in one cell."""

    cell: Cell
    ours: JobResult
    theirs: JobResult

    @property
    def reduction(self) -> float:
        """Return ``1 - N_ours / N_theirs``; 0.9 means that a tenth of the Gaussians remain."""
        assert self.ours.count is not None
        assert self.theirs.count
        return 1 - self.ours.count / self.theirs.count

    @property
    def psnr(self) -> float:
        """Return our PSNR minus theirs, in dB."""
        assert self.ours.psnr is not None
        assert self.theirs.psnr is not None
        return self.ours.psnr - self.theirs.psnr

    @property
    def ssim(self) -> float | None:
        """Return our SSIM minus theirs; ``None`` if either is unknown."""
        if self.ours.ssim is None or self.theirs.ssim is None:
            return None
        return self.ours.ssim - self.theirs.ssim


@dataclass(frozen=True, kw_only=True)
class PairedComparison:
    """Two settings, compared over all cells that have both."""

    ours: ArmSetting
    theirs: ArmSetting
    pairs: list[Pair]
    # Cells in which theirs left nothing to measure: it failed, vanished, is not done or was never planned.
    only_ours: int
    only_theirs: int
    reduction: Spread
    psnr: Spread
    ssim: Spread | None
    # Standard deviation over seeds, averaged; None without two seeds.
    psnr_over_seeds: float | None
    # Cells in which ours, or theirs, stopped before its last step.
    early: int
    theirs_early: int

    @property
    def cells(self) -> int:
        """Return the number of cells that were compared."""
        return len(self.pairs)

    @property
    def unpaired(self) -> int:
        """Return the number of cells in which only one of the two left something to measure."""
        return self.only_ours + self.only_theirs

    def comparable(self, loss: float) -> int:
        """Return the number of cells in which ours is at most ``loss`` dB of PSNR below theirs."""
        return sum(pair.psnr >= -loss for pair in self.pairs)


def compare(results: Sequence[JobResult], ours: ArmSetting, theirs: ArmSetting) -> PairedComparison | None:
    """Compare two settings cell by cell; ``None`` if no cell has both."""
    of_ours, of_theirs = by_cell(results, ours), by_cell(results, theirs)
    both = sorted(of_ours.keys() & of_theirs.keys())
    pairs = [Pair(cell, of_ours[cell], of_theirs[cell]) for cell in both]
    if not pairs:
        return None
    ssims = {pair.cell: pair.ssim for pair in pairs if pair.ssim is not None}
    return PairedComparison(
        ours=ours,
        theirs=theirs,
        pairs=pairs,
        only_ours=len(of_ours.keys() - of_theirs.keys()),
        only_theirs=len(of_theirs.keys() - of_ours.keys()),
        reduction=Spread.of({pair.cell: pair.reduction for pair in pairs}),
        psnr=Spread.of({pair.cell: pair.psnr for pair in pairs}),
        ssim=Spread.of(ssims) if ssims else None,
        psnr_over_seeds=over_seeds({pair.cell: pair.psnr for pair in pairs}),
        early=sum(pair.ours.ended_early for pair in pairs),
        theirs_early=sum(pair.theirs.ended_early for pair in pairs),
    )


@dataclass(frozen=True)
class FrontierPoint:
    """One setting over all its cells."""

    setting: ArmSetting
    is_standard: bool
    cells: int
    early: int  # cells whose job stopped before its last step
    count: Spread
    # Cells that lack the job without growth, or a measured quality.
    left_out: int
    # Quality minus that of the job without growth; plain quality if the sweep has no such job.
    gain: Spread
    count_over_seeds: float | None  # standard deviation of log10 count
    gain_over_seeds: float | None


def frontier(
    results: Sequence[JobResult],
    arm: str,
    reference: Sequence[JobResult] | None = None,
    quality: Compared = PSNR,
) -> list[FrontierPoint]:
    """Return the settings of ``arm``, those with fewest Gaussians first.

    ``results`` are those of one noise level. Gains are measured from the jobs without growth in
    ``reference``, which is ``results`` itself by default and may be another level. Cells without such a job
    are left out and counted. If there is no such job at all, the gain is the plain quality.
    """
    gain = gain_over(results if reference is None else reference, quality)
    points = []
    for setting in settings_of(results, arm):
        members = by_cell(results, setting)
        cells = {cell: result for cell, result in members.items() if math.isfinite(gain(result))}
        if not cells:
            continue
        counts = {cell: _count(result) for cell, result in cells.items()}
        gains = {cell: gain(result) for cell, result in cells.items()}
        points.append(
            FrontierPoint(
                setting=setting,
                is_standard=any(result.is_standard for result in cells.values()),
                cells=len(cells),
                early=sum(result.ended_early for result in cells.values()),
                left_out=len(members) - len(cells),
                count=Spread.of(counts),
                gain=Spread.of(gains),
                count_over_seeds=over_seeds({cell: math.log10(n) for cell, n in counts.items()}),
                gain_over_seeds=over_seeds(gains),
            )
        )
    return sorted(points, key=lambda point: point.count.median)


def has_no_growth(results: Sequence[JobResult]) -> bool:
    """Return whether there is a job without growth, from which gains can be measured."""
    return any(result.arm == NO_GROWTH for result in measured(results))


def gain_over(reference: Sequence[JobResult], quality: Compared = PSNR) -> Callable[[JobResult], float]:
    """Return a function: the quality of a result minus that of its job without growth in ``reference``.

    The job without growth has the same prompt and seed. The function returns NaN where that job or the
    quality is missing, and plain quality if ``reference`` holds no job without growth at all.
    """

    def measured_of(result: JobResult) -> float:
        value = quality.of(result)
        return math.nan if value is None else value

    if not has_no_growth(reference):
        return measured_of
    levels = {
        result.cell.without(NOISE): measured_of(result)
        for result in measured(reference)
        if result.arm == NO_GROWTH
    }
    return lambda result: measured_of(result) - levels.get(result.cell.without(NOISE), math.nan)


class Hull:
    """The best that an arm can do in one cell: the upper concave hull of PSNR over log count.

    The hull is straight between settings, in log count. Where more Gaussians only hurt it stays level,
    because the arm could stop growing. It ends at the settings with fewest and most Gaussians; nothing is
    extrapolated.
    """

    def __init__(self, points: Iterable[tuple[float, float]]) -> None:
        """Build the hull of ``points``: count (> 0) and PSNR of each setting, at least one."""
        best: dict[float, float] = {}
        for count, psnr in points:
            best[math.log10(count)] = max(psnr, best.get(math.log10(count), -math.inf))
        last = max(best)
        best[last] = max(best.values())  # level after the peak
        corners: list[tuple[float, float]] = []
        for point in sorted(best.items()):
            while len(corners) >= 2 and _turns_left(corners[-2], corners[-1], point):
                corners.pop()
            corners.append(point)
        self.corners = corners  # log10 count and PSNR, both rising

    def psnr_at(self, count: float) -> float | None:
        """Return the PSNR at ``count`` Gaussians; ``None`` outside the range of the arm."""
        x = math.log10(count)
        if not self.corners[0][0] - 1e-12 <= x <= self.corners[-1][0] + 1e-12:
            return None
        return float(np.interp(x, [x for x, _ in self.corners], [y for _, y in self.corners]))

    def count_for(self, psnr: float) -> float | None:
        """Return the fewest Gaussians with this PSNR; infinity: never reached, ``None``: always exceeded."""
        if psnr < self.corners[0][1]:
            return None
        if psnr > self.corners[-1][1]:
            return math.inf
        for (x0, y0), (x1, y1) in pairwise(self.corners):
            if psnr <= y0:
                return 10**x0
            if psnr <= y1:
                return 10 ** (x0 + (psnr - y0) / (y1 - y0) * (x1 - x0))
        return 10 ** self.corners[-1][0]

    def reaches_below(self, count: float) -> bool:
        """Return whether the arm has a setting with fewer than ``count`` Gaussians."""
        return self.corners[0][0] < math.log10(count)


def _turns_left(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]) -> bool:
    """Return whether ``b`` is on or below the line from ``a`` to ``c``."""
    return (b[0] - a[0]) * (c[1] - a[1]) >= (c[0] - a[0]) * (b[1] - a[1])


@dataclass(frozen=True)
class Standing:
    """One setting compared with the whole frontier of another arm, cell by cell."""

    setting: ArmSetting
    arm: str  # of the frontier
    # The largest number of settings that the arm has in one cell.
    settings: int
    # Cells in which only the setting or only the arm left something to measure.
    unpaired: int
    # How far the setting is above the frontier at equal count, in dB; None if no cell has an equal count.
    psnr: Estimate | None
    # The standard deviation of that over seeds, averaged; None without two seeds.
    psnr_over_seeds: float | None
    # Cells in which the setting is above the frontier at equal count.
    above: int
    # Cells in which the setting has fewer, or more, Gaussians than any setting of the arm.
    fewer: int
    more: int
    # The median of the count that the arm needs for the same PSNR, over the count of the setting.
    count_ratio: float | None
    # Cells in which no setting of the arm reaches that PSNR, which count as an infinite ratio.
    never: int
    # Cells in which every setting of the arm exceeds that PSNR, which count as a ratio of 0.
    always: int


def standing_of(results: Sequence[JobResult], setting: ArmSetting, arm: str) -> Standing | None:
    """Compare ``setting`` with the best of ``arm`` in the same cells; ``None`` if no cell has both."""
    hulls = {cell: (Hull(points), len(points)) for cell, points in _points_by_cell(results, arm).items()}
    ours = by_cell(results, setting)
    shared = {cell: result for cell, result in ours.items() if cell in hulls}
    if not shared:
        return None
    differences: dict[Cell, float] = {}
    ratios: list[float] = []
    fewer = more = always = 0
    for cell, result in shared.items():
        hull, count, psnr = hulls[cell][0], _count(result), _psnr(result)
        at_equal_count = hull.psnr_at(count)
        if at_equal_count is not None:
            differences[cell] = psnr - at_equal_count
        elif hull.reaches_below(count):
            more += 1
        else:
            fewer += 1
        needed = hull.count_for(psnr)
        if needed is None:
            always += 1
        ratios.append(0.0 if needed is None else needed / count)
    return Standing(
        setting=setting,
        arm=arm,
        settings=max(size for _, size in hulls.values()),
        unpaired=len(ours.keys() ^ hulls.keys()),
        psnr=Estimate.of(differences) if differences else None,
        psnr_over_seeds=over_seeds(differences),
        above=sum(difference > 0 for difference in differences.values()),
        fewer=fewer,
        more=more,
        count_ratio=_middle_ratio(ratios),
        never=sum(math.isinf(ratio) for ratio in ratios),
        always=always,
    )


def standings(results: Sequence[JobResult], arm: str, other: str) -> list[Standing]:
    """Compare every setting of ``arm`` with the frontier of ``other``."""
    found = [standing_of(results, setting, other) for setting in settings_of(results, arm)]
    return [standing for standing in found if standing is not None]


def settings_of(results: Iterable[JobResult], arm: str) -> list[ArmSetting]:
    """Return the settings of an arm that left something to measure."""
    return sorted(
        {result.setting for result in measured(results) if result.arm == arm}, key=lambda each: each.order
    )


def standard_setting(results: Iterable[JobResult], arm: str) -> ArmSetting | None:
    """Return the setting of ``arm`` with the shipped thresholds, or its only one, or else ``None``."""
    results = [result for result in measured(results) if result.arm == arm]
    shipped = {result.setting for result in results if result.is_standard}
    candidates = shipped or {result.setting for result in results}
    return candidates.pop() if len(candidates) == 1 else None


def by_cell(results: Iterable[JobResult], setting: ArmSetting) -> dict[Cell, JobResult]:
    """Return the measured result of a setting in each cell; of two in one cell the later one."""
    return {result.cell: result for result in measured(results) if result.setting == setting}


def over_seeds(values: Mapping[Cell, float]) -> float | None:
    """Return the standard deviation over seeds, averaged over cells that differ in nothing else.

    ``None`` if no such group has two seeds.
    """
    groups = [group for group in _grouped(values, lambda cell: cell.without(SEED)).values() if len(group) > 1]
    return float(np.mean([np.std(group, ddof=1) for group in groups])) if groups else None


def _grouped(
    values: Mapping[Cell, float], group_of: Callable[[Cell], Hashable]
) -> dict[Hashable, list[float]]:
    """Return the values of the cells of each group."""
    groups: dict[Hashable, list[float]] = defaultdict(list)
    # The order is fixed, so that the bootstrap is reproducible.
    for cell, value in sorted(values.items()):
        groups[group_of(cell)].append(value)
    return dict(groups)


def _bootstrap(groups: Sequence[Sequence[float]]) -> tuple[float, float]:
    """Return the interval of the median of all values when whole groups are drawn."""
    padded = np.full((len(groups), max(map(len, groups))), np.nan)
    for line, group in zip(padded, groups, strict=True):
        line[: len(group)] = group
    draws = np.random.default_rng(BOOTSTRAP_SEED).integers(len(groups), size=(RESAMPLES, len(groups)))
    medians = np.nanmedian(padded[draws].reshape(RESAMPLES, -1), axis=1)
    low, high = np.quantile(medians, ((1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2))
    return float(low), float(high)


def _points_by_cell(results: Iterable[JobResult], arm: str) -> dict[Cell, list[tuple[float, float]]]:
    points: dict[Cell, list[tuple[float, float]]] = defaultdict(list)
    for result in measured(results):
        if result.arm == arm:
            points[result.cell].append((_count(result), _psnr(result)))
    return dict(points)


def _middle_ratio(ratios: Sequence[float]) -> float | None:
    """Return the median of ratios; 0 and infinity stand for ratios below and above what the settings cover.

    Of an even number it is the mean of the two in the middle if both are known. Otherwise it is the lower
    one, which is in favour of the other arm.
    """
    if not ratios:
        return None
    ordered = sorted(ratios)
    low, high = ordered[(len(ordered) - 1) // 2], ordered[len(ordered) // 2]
    return (low + high) / 2 if low > 0 and high < math.inf else low


def _count(result: JobResult) -> float:
    assert result.count
    return result.count


def _psnr(result: JobResult) -> float:
    assert result.psnr is not None
    return result.psnr
