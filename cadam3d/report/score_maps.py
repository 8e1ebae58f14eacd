"""Score maps: how a score of the densifier is distributed over the Gaussians, refinement by refinement.

Which scores have a map, and which constants they are compared with, is declared by the densifiers of the jobs
(``charts.json``). The distributions come from the candidates callback.
"""

import math
from collections.abc import Iterable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cadam3d.core.chart import Chart, Level
from cadam3d.report.compare import by_cell, main_setting
from cadam3d.report.declarations import read_declarations
from cadam3d.report.results import JobResult, arms_of, at_noise, histograms, level_title, levels_of, measured
from cadam3d.report.style import label_axis, new_figure

MAX_COLUMNS = 3  # maps in one line, unless there are more noise levels
LEAST_SHARE = 0.002  # of the Gaussians; emptier bins do not widen the axis
# The map is light on dark pages too, so that darker always means more. None of these colours may be one that
# palette.py replaces on dark pages.
BACKGROUND = "#f7fbff"
LEVEL_COLORS = ("#c85a00", "#111111", "#00805c")


def declared_scores(results: Iterable[JobResult]) -> dict[str, Chart]:
    """Return the charts about a score that any of the jobs declares, by the name of the score."""
    found: dict[str, Chart] = {}
    for result in measured(results):
        for chart in read_declarations(result.folder):
            if chart.score:
                found.setdefault(chart.score, chart)
    return found


def score_figure(results: Sequence[JobResult], chart: Chart) -> Figure | None:
    """Draw a map per arm and noise level of the score of ``chart``, each arm at its main setting.

    There is a column per level and a line per arm; if there is room, several arms share a line. Arms whose
    jobs have no such score are left out. ``None`` if none has.
    """
    levels = levels_of(results)
    chosen = {arm: main_setting(results, arm) for arm in arms_of(results)}
    maps = {
        (arm, level): found
        for arm, setting in chosen.items()
        for level in levels
        if (found := ScoreMap(list(by_cell(at_noise(results, level), setting).values()), chart.score)).steps
    }
    arms = [arm for arm in chosen if any(key[0] == arm for key in maps)]
    if not maps:
        return None
    arms_per_line = min(max(MAX_COLUMNS // len(levels), 1), len(arms))
    columns, lines = arms_per_line * len(levels), math.ceil(len(arms) / arms_per_line)
    figure = new_figure(columns, lines, height=2.7 if lines < 4 else 2.1)
    panels = figure.subplots(lines, columns, squeeze=False, sharex=True, sharey=True)
    places = [(arm, level) for arm in arms for level in levels]
    for axes, (arm, level) in zip(panels.flat, places, strict=False):
        axes.set_title(f"{arm}, {level_title(level)}".removesuffix(", "))
        axes.set_yscale("log")
        if found := maps.get((arm, level)):
            _draw(axes, found)
    shown = [found.shown for found in maps.values()]
    panels[0, 0].set_ylim(min(low for low, _ in shown) / 1.5, max(high for _, high in shown) * 2)
    label_axis(panels[0, 0].yaxis)
    sides = [found.sides for found in maps.values()]
    panels[0, 0].set_xlim(min(low for low, _ in sides), max(high for _, high in sides))
    for axes in panels[:, 0]:
        axes.set_ylabel(chart.score)
    for axes in panels.flat[len(places) :]:
        axes.set_visible(False)
    # The lowest panel of each column.
    for axes in panels.flat[len(places) - columns : len(places)]:
        axes.set_xlabel("step")
        axes.tick_params(labelbottom=True)
    return figure


class ScoreMap:
    """Shares of Gaussians by score and refinement, averaged over jobs, and the levels they declare."""

    def __init__(self, results: Sequence[JobResult], score: str) -> None:
        lines = [line for result in results for line in histograms(result, score) if line.counts]
        self.steps = sorted({line.step for line in lines})
        self.per_decade = lines[0].bins_per_decade if lines else 1
        lines = [line for line in lines if line.bins_per_decade == self.per_decade]
        self.first = min((line.first for line in lines), default=0)
        last = max((line.first + len(line.counts) for line in lines), default=0)
        shares = np.zeros((last - self.first, len(self.steps)))
        for line in lines:
            at, total = line.first - self.first, sum(line.counts)
            jobs = sum(other.step == line.step for other in lines)
            if total:
                column = self.steps.index(line.step)
                shares[at : at + len(line.counts), column] += np.array(line.counts) / total / jobs
        self.shares = shares
        charts = read_declarations(results[0].folder) if results else ()
        levels = next((chart.levels for chart in charts if chart.score == score), ())
        self.levels: list[Level] = [level for level in levels if level.value > 0]

    @property
    def edges(self) -> np.ndarray:
        """Return the edges of the bins, one more than there are bins."""
        return 10 ** (np.arange(self.first, self.first + len(self.shares) + 1) / self.per_decade)

    @property
    def half(self) -> float:
        """Return half the width of a column, in steps."""
        return float(np.diff(self.steps).min() if len(self.steps) > 1 else 10.0) / 2

    @property
    def sides(self) -> tuple[float, float]:
        """Return the left side of the first column and the right side of the last, in steps."""
        return self.steps[0] - self.half, self.steps[-1] + self.half

    @property
    def shown(self) -> tuple[float, float]:
        """Return the range of scores worth showing: the filled bins and the levels."""
        filled = self.edges[:-1][self.shares.max(axis=1) > LEAST_SHARE]
        values = [*filled, *(level.value for level in self.levels)] or list(self.edges)
        return float(min(values)), float(max(values))


def _draw(axes: Axes, found: ScoreMap) -> None:
    axes.set_facecolor(BACKGROUND)
    axes.grid(visible=False)
    for column, step in enumerate(found.steps):
        axes.pcolormesh(
            [step - found.half, step + found.half],
            found.edges,
            np.ma.masked_less_equal(found.shares[:, column : column + 1], 0),
            cmap="Blues",
            vmin=-0.02,
            vmax=max(found.shares.max(), 1e-9),
            rasterized=True,
        )
    top = max((level.value for level in found.levels), default=0.0)
    for i, level in enumerate(found.levels):
        color = LEVEL_COLORS[i % len(LEVEL_COLORS)]
        # The label of the highest level is above its line, the others are below theirs.
        side = 1 if level.value == top else -1
        axes.axhline(level.value, color=color, lw=1.1, ls="--")
        axes.annotate(
            f"{level.label} {level.value:.3g}",
            (1, level.value),
            xycoords=("axes fraction", "data"),
            xytext=(-3, 3 * side),
            textcoords="offset points",
            ha="right",
            va="bottom" if side > 0 else "top",
            fontsize=7.5,
            color=color,
            bbox={"facecolor": BACKGROUND, "alpha": 0.85, "lw": 0, "pad": 0.5},
        )
