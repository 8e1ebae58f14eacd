"""Claims: what rows say about settings, within cells first, then over cells. Pure functions of rows.

Medians run over cells. An interval comes from a bootstrap that draws prompts with all their cells, because
the seeds, noise levels and objectives of one prompt are no independent witnesses; a sign test counts prompts.
"""

import math
from collections import defaultdict
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.stats import binomtest

from cadam3d.report.rows import NOISE, PROMPT, SEED, Cell, Row, Setting, measured

NO_GROWTH = "none"  # the arm that gains are counted from
RESAMPLES = 2000
CONFIDENCE = 0.95
BOOTSTRAP_SEED = 0  # same rows, same interval
# Prompts: with 4 a bootstrap of the median covers 85 % only, and 5 prove nothing by signs.
LEAST_FOR_INTERVAL = 6
SIGNIFICANT = 1 - CONFIDENCE  # of the sign test


@dataclass(frozen=True)
class Quality:
    """A number by which assets are judged: more is better."""

    name: str
    unit: str  # empty: none
    digits: int  # after the point, in tables
    of: Callable[[Row], float | None]

    @property
    def axis(self) -> str:
        """Its name with its unit."""
        return self.with_unit(self.name)

    @property
    def gain(self) -> str:
        """What its difference to the job without growth is called, with its unit."""
        return self.with_unit(f"{self.name} gained by growth")

    def with_unit(self, words: str) -> str:
        """``words`` and the unit, if there is one."""
        return f"{words} ({self.unit})" if self.unit else words


PSNR = Quality("PSNR", "dB", 2, lambda row: row.psnr)
SSIM = Quality("SSIM", "", 4, lambda row: row.ssim)


@dataclass(frozen=True)
class Spread:
    """Median and quartiles of numbers, one per cell."""

    low: float  # first quartile
    median: float
    high: float  # third quartile

    @classmethod
    def of(cls, values: Iterable[float]) -> "Spread":
        """Of at least one value."""
        low, median, high = np.quantile(np.fromiter(values, dtype=float), (0.25, 0.5, 0.75))
        return cls(float(low), float(median), float(high))


@dataclass(frozen=True)
class Estimate:
    """A median over cells and how sure it is."""

    median: float
    low: float | None  # ends of the 95 % bootstrap interval; None with fewer than LEAST_FOR_INTERVAL prompts
    high: float | None
    p_value: float | None  # two-sided sign test of "the median is 0" over prompts; None if all are 0
    cells: int
    prompts: int

    @classmethod
    def of(cls, values: Mapping[Cell, float]) -> "Estimate":
        """Of one value per cell, at least one."""
        groups = list(_grouped(values, lambda cell: cell[PROMPT]).values())
        low, high = _bootstrap(groups) if len(groups) >= LEAST_FOR_INTERVAL else (None, None)
        middles = [float(np.median(group)) for group in groups]
        ups, downs = sum(middle > 0 for middle in middles), sum(middle < 0 for middle in middles)
        p_value = float(binomtest(ups, ups + downs).pvalue) if ups + downs else None
        return cls(float(np.median(list(values.values()))), low, high, p_value, len(values), len(groups))

    @property
    def is_certain(self) -> bool:
        """Whether the interval excludes 0 and the sign test agrees; without either nothing is certain."""
        if self.low is None or self.high is None or self.p_value is None:
            return False
        return (self.low > 0 or self.high < 0) and self.p_value < SIGNIFICANT


@dataclass(frozen=True)
class Pair:
    """Ours and theirs in one cell."""

    cell: Cell
    ours: Row
    theirs: Row

    @property
    def reduction(self) -> float:
        """``1 - N_ours / N_theirs``: 0.9 means that nine in ten Gaussians are gone."""
        assert self.ours.count is not None
        assert self.theirs.count
        return 1 - self.ours.count / self.theirs.count

    @property
    def psnr(self) -> float:
        """PSNR of ours less that of theirs, dB."""
        assert self.ours.psnr is not None
        assert self.theirs.psnr is not None
        return self.ours.psnr - self.theirs.psnr

    @property
    def ssim(self) -> float | None:
        """SSIM of ours less that of theirs."""
        if self.ours.ssim is None or self.theirs.ssim is None:
            return None
        return self.ours.ssim - self.theirs.ssim


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Two settings over all cells that have both."""

    ours: Setting
    theirs: Setting
    pairs: list[Pair]
    only_ours: int  # cells in which theirs left nothing to measure: failed, vanished, not done, never planned
    only_theirs: int
    reduction: Spread
    psnr: Spread
    ssim: Spread | None
    reduction_over_seeds: float | None  # standard deviation over seeds, averaged; None without two seeds
    psnr_over_seeds: float | None
    early: int  # cells in which ours stopped before its last step
    theirs_early: int

    @property
    def cells(self) -> int:
        """How many cells were compared."""
        return len(self.pairs)

    @property
    def unpaired(self) -> int:
        """Cells in which only one of the two left something to measure."""
        return self.only_ours + self.only_theirs

    def comparable(self, loss: float) -> int:
        """In how many cells ours has lost no more than ``loss``, dB of PSNR."""
        return sum(pair.psnr >= -loss for pair in self.pairs)


def compare(rows: Sequence[Row], ours: Setting, theirs: Setting) -> Comparison | None:
    """How ``ours`` stands against ``theirs``; ``None`` if no cell has both."""
    of_ours, of_theirs = by_cell(rows, ours), by_cell(rows, theirs)
    both = sorted(of_ours.keys() & of_theirs.keys())
    pairs = [Pair(cell, of_ours[cell], of_theirs[cell]) for cell in both]
    if not pairs:
        return None
    ssims = [pair.ssim for pair in pairs if pair.ssim is not None]
    return Comparison(
        ours=ours,
        theirs=theirs,
        pairs=pairs,
        only_ours=len(of_ours.keys() - of_theirs.keys()),
        only_theirs=len(of_theirs.keys() - of_ours.keys()),
        reduction=Spread.of(pair.reduction for pair in pairs),
        psnr=Spread.of(pair.psnr for pair in pairs),
        ssim=Spread.of(ssims) if ssims else None,
        reduction_over_seeds=over_seeds({pair.cell: pair.reduction for pair in pairs}),
        psnr_over_seeds=over_seeds({pair.cell: pair.psnr for pair in pairs}),
        early=sum(pair.ours.ended_early for pair in pairs),
        theirs_early=sum(pair.theirs.ended_early for pair in pairs),
    )


@dataclass(frozen=True)
class FrontierPoint:
    """One setting over all its cells."""

    setting: Setting
    is_standard: bool
    cells: int
    early: int  # of them, stopped before the last step
    count: Spread
    left_out: int  # cells that have no job without growth, or whose quality nobody measured
    gain: Spread  # quality over the cell's job without growth; plain quality where the sweep has none
    count_over_seeds: float | None  # standard deviation of log10 count
    gain_over_seeds: float | None


def frontier(
    rows: Sequence[Row], arm: str, zero: Sequence[Row] | None = None, quality: Quality = PSNR
) -> list[FrontierPoint]:
    """The settings of ``arm``, those with fewest Gaussians first.

    ``rows`` are those of one noise level. Gains are counted from the jobs without growth among ``zero``
    (``rows`` itself, or another level); cells that have no such job are left out, and counted. Without any:
    plain quality.
    """
    gain = gain_over(rows if zero is None else zero, quality)
    points = []
    for setting in settings_of(rows, arm):
        members = by_cell(rows, setting)
        cells = {cell: row for cell, row in members.items() if math.isfinite(gain(row))}
        if not cells:
            continue
        counts = {cell: _count(row) for cell, row in cells.items()}
        gains = {cell: gain(row) for cell, row in cells.items()}
        points.append(
            FrontierPoint(
                setting=setting,
                is_standard=any(row.is_standard for row in cells.values()),
                cells=len(cells),
                early=sum(row.ended_early for row in cells.values()),
                left_out=len(members) - len(cells),
                count=Spread.of(counts.values()),
                gain=Spread.of(gains.values()),
                count_over_seeds=over_seeds({cell: math.log10(n) for cell, n in counts.items()}),
                gain_over_seeds=over_seeds(gains),
            )
        )
    return sorted(points, key=lambda point: point.count.median)


def has_no_growth(rows: Sequence[Row]) -> bool:
    """Whether there is a job without growth, so that gains exist."""
    return any(row.arm == NO_GROWTH for row in measured(rows))


def gain_over(zero: Sequence[Row], quality: Quality = PSNR) -> Callable[[Row], float]:
    """Quality over that of the same prompt and seed without growth in ``zero``; NaN where it has none.

    Plain quality if ``zero`` has no job without growth at all; NaN where nobody measured it.
    """

    def measured_of(row: Row) -> float:
        value = quality.of(row)
        return math.nan if value is None else value

    if not has_no_growth(zero):
        return measured_of
    levels = {row.cell.without(NOISE): measured_of(row) for row in measured(zero) if row.arm == NO_GROWTH}
    return lambda row: measured_of(row) - levels.get(row.cell.without(NOISE), math.nan)


class Hull:
    """The best that an arm can do in one cell: the upper concave hull of PSNR over log count.

    Straight lines between settings, in log count; where more Gaussians only hurt, the hull stays level, for
    the arm could stop growing. It ends at the settings with fewest and most Gaussians; nothing is
    extrapolated.
    """

    def __init__(self, points: Iterable[tuple[float, float]]) -> None:
        """``points``: count (> 0) and PSNR of each setting, at least one."""
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
        """PSNR at ``count`` Gaussians; ``None`` outside the arm's range."""
        x = math.log10(count)
        if not self.corners[0][0] - 1e-12 <= x <= self.corners[-1][0] + 1e-12:
            return None
        return float(np.interp(x, [x for x, _ in self.corners], [y for _, y in self.corners]))

    def count_for(self, psnr: float) -> float | None:
        """The fewest Gaussians with this PSNR; infinity: never reached, ``None``: always exceeded."""
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
        """Whether the arm has a setting with fewer Gaussians than this."""
        return self.corners[0][0] < math.log10(count)


def _turns_left(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]) -> bool:
    """Whether ``b`` lies on or below the line from ``a`` to ``c``."""
    return (b[0] - a[0]) * (c[1] - a[1]) >= (c[0] - a[0]) * (b[1] - a[1])


@dataclass(frozen=True)
class Standing:
    """One setting against the whole frontier of another arm, cell by cell."""

    setting: Setting
    arm: str  # whose frontier
    settings: int  # on that frontier, at most, in one cell
    unpaired: int  # cells in which only the setting or only the arm left something to measure
    psnr: Estimate | None  # dB above the frontier at equal count; None if no cell has an equal count
    psnr_over_seeds: float | None  # its standard deviation over seeds, averaged; None without two seeds
    above: int  # cells, of those in psnr, in which the setting lies above
    fewer: int  # cells with fewer Gaussians than any setting of the arm
    more: int  # cells with more
    count_ratio: float | None  # median of (count the arm needs for the same PSNR) / (count of the setting)
    never: int  # cells in which no setting of the arm reaches that PSNR; they count as an infinite ratio
    always: int  # cells in which every setting of the arm exceeds it; they count as a ratio of 0


def stand(rows: Sequence[Row], setting: Setting, arm: str) -> Standing | None:
    """Where ``setting`` lies against the best of ``arm`` in the same cells; ``None`` if no cell has both."""
    hulls = {cell: (Hull(points), len(points)) for cell, points in _points_by_cell(rows, arm).items()}
    ours = by_cell(rows, setting)
    shared = {cell: row for cell, row in ours.items() if cell in hulls}
    if not shared:
        return None
    differences: dict[Cell, float] = {}
    ratios: list[float] = []
    fewer = more = always = 0
    for cell, row in shared.items():
        hull, count, psnr = hulls[cell][0], _count(row), _psnr(row)
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


def standings(rows: Sequence[Row], arm: str, other: str) -> list[Standing]:
    """Every setting of ``arm`` against the frontier of ``other``."""
    found = [stand(rows, setting, other) for setting in settings_of(rows, arm)]
    return [standing for standing in found if standing is not None]


def settings_of(rows: Iterable[Row], arm: str) -> list[Setting]:
    """The settings of an arm that left something to measure."""
    return sorted({row.setting for row in measured(rows) if row.arm == arm}, key=lambda each: each.order)


def standard(rows: Iterable[Row], arm: str) -> Setting | None:
    """The setting of ``arm`` with the shipped thresholds, else its only one, else ``None``."""
    rows = [row for row in measured(rows) if row.arm == arm]
    shipped = {row.setting for row in rows if row.is_standard}
    candidates = shipped or {row.setting for row in rows}
    return candidates.pop() if len(candidates) == 1 else None


def by_cell(rows: Iterable[Row], setting: Setting) -> dict[Cell, Row]:
    """The measured row of a setting in each cell; of two, the one that came last."""
    return {row.cell: row for row in measured(rows) if row.setting == setting}


def over_seeds(values: Mapping[Cell, float]) -> float | None:
    """Standard deviation over the seeds of cells that are one otherwise, averaged; ``None`` without two."""
    groups = [group for group in _grouped(values, lambda cell: cell.without(SEED)).values() if len(group) > 1]
    return float(np.mean([np.std(group, ddof=1) for group in groups])) if groups else None


def _grouped(
    values: Mapping[Cell, float], group_of: Callable[[Cell], Hashable]
) -> dict[Hashable, list[float]]:
    """The values of the cells of each group."""
    groups: dict[Hashable, list[float]] = defaultdict(list)
    for cell, value in sorted(values.items()):  # in an order of their own: same rows, same bootstrap
        groups[group_of(cell)].append(value)
    return dict(groups)


def _bootstrap(groups: Sequence[Sequence[float]]) -> tuple[float, float]:
    """The interval of the median of all values when whole groups are drawn."""
    padded = np.full((len(groups), max(map(len, groups))), np.nan)
    for row, group in zip(padded, groups, strict=True):
        row[: len(group)] = group
    draws = np.random.default_rng(BOOTSTRAP_SEED).integers(len(groups), size=(RESAMPLES, len(groups)))
    medians = np.nanmedian(padded[draws].reshape(RESAMPLES, -1), axis=1)
    low, high = np.quantile(medians, ((1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2))
    return float(low), float(high)


def _points_by_cell(rows: Iterable[Row], arm: str) -> dict[Cell, list[tuple[float, float]]]:
    points: dict[Cell, list[tuple[float, float]]] = defaultdict(list)
    for row in measured(rows):
        if row.arm == arm:
            points[row.cell].append((_count(row), _psnr(row)))
    return dict(points)


def _middle_ratio(ratios: Sequence[float]) -> float | None:
    """The median of ratios of which 0 and infinity stand for "less" and "more than there are settings for".

    The mean of the two in the middle if both are known, else the lower of them: in doubt for the other arm.
    """
    if not ratios:
        return None
    ordered = sorted(ratios)
    low, high = ordered[(len(ordered) - 1) // 2], ordered[len(ordered) // 2]
    return (low + high) / 2 if low > 0 and high < math.inf else low


def _count(row: Row) -> float:
    assert row.count
    return row.count


def _psnr(row: Row) -> float:
    assert row.psnr is not None
    return row.psnr
