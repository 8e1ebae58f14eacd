"""Score maps: how a score of the densifier is distributed over the Gaussians, refinement by refinement.

Which scores have a map, and which constants they are compared with, is declared by the densifiers of the jobs
(``charts.json``). The distributions come from the candidates callback.
"""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cadam3d.core.chart import Chart, Level
from cadam3d.io.declarations import read_declarations
from cadam3d.report.compare import by_cell, main_setting
from cadam3d.report.results import JobResult, arms_of, at_noise, histograms, level_title, levels_of, measured
from cadam3d.report.style import label_axis, new_figure

LEAST_SHARE = 0.002  # of the Gaussians; emptier bins do not widen the axis
# The map is light on dark pages too, so that darker always means more. None of these colours may be one that
# palette.py replaces on dark pages.
BACKGROUND = "#f7fbff"
LEVEL_COLORS = ("#c85a00", "#111111", "#00805c")


def declared_scores(results: Iterable[JobResult]) -> dict[str, Chart]:
    """Return the charts about a score that any of the jobs declares, by the name of the score."""
    charts = [chart for result in measured(results) for chart in read_declarations(result.folder)]
    return {chart.score: chart for chart in reversed(charts) if chart.score}


@dataclass(frozen=True)
class ScoreMap:
    """Shares of Gaussians by score and refinement, averaged over jobs, and the levels they declare."""

    steps: list[float]
    edges: np.ndarray  # of the bins of the score, one more than there are bins
    shares: np.ndarray  # a line per bin, a column per step
    levels: list[Level]

    @classmethod
    def of(cls, results: Sequence[JobResult], score: str) -> "ScoreMap | None":
        """Return the map of a score over jobs; None if none of them has its histograms."""
        lines = [line for result in results for line in histograms(result, score) if sum(line["counts"])]
        lines = [line for line in lines if line["bins_per_decade"] == lines[0]["bins_per_decade"]]
        if not lines:
            return None
        first = min(line["first"] for line in lines)
        bins = max(line["first"] + len(line["counts"]) for line in lines) - first
        by_step = defaultdict(list)
        for line in lines:
            counts = np.array(line["counts"])
            before = line["first"] - first
            after = bins - before - len(counts)
            by_step[line["step"]].append(np.pad(counts / counts.sum(), (before, after)))
        steps = sorted(by_step)
        declared = [each for each in read_declarations(results[0].folder) if each.score == score]
        return cls(
            steps=steps,
            edges=10 ** ((first + np.arange(bins + 1)) / lines[0]["bins_per_decade"]),
            shares=np.stack([np.mean(by_step[step], axis=0) for step in steps], axis=1),
            levels=[level for chart in declared for level in chart.levels if level.value > 0],
        )

    @property
    def shown(self) -> list[float]:
        """Return the scores that an axis must include: the filled bins and the levels."""
        filled = self.edges[:-1][self.shares.max(axis=1) > LEAST_SHARE]
        return [*filled.tolist(), *(level.value for level in self.levels)]


def score_figure(results: Sequence[JobResult], chart: Chart) -> Figure | None:
    """Draw a map per arm and noise level of the score of ``chart``, each arm at its main setting.

    Arms whose jobs have no such score are left out. ``None`` if none has.
    """
    levels, maps = levels_of(results), defaultdict(dict)
    for arm in arms_of(results):
        for level in levels:
            members = by_cell(at_noise(results, level), main_setting(results, arm))
            if found := ScoreMap.of(list(members.values()), chart.score):
                maps[arm][level] = found
    if not maps:
        return None
    figure = new_figure(max(len(levels), 2), len(maps), height=2.4)
    panels = figure.subplots(len(maps), len(levels), squeeze=False, sharex=True, sharey=True)
    for line, (arm, found) in zip(panels, maps.items(), strict=True):
        for axes, level in zip(line, levels, strict=True):
            axes.set_title(f"{arm}, {level_title(level)}".removesuffix(", "))
            if level in found:
                _draw(axes, found[level])
    shown = [value for found in maps.values() for each in found.values() for value in each.shown]
    panels[0, 0].set_ylim(min(shown) / 1.5, max(shown) * 2)
    label_axis(panels[0, 0].yaxis)
    figure.supxlabel("step", fontsize=9)
    figure.supylabel(chart.score, fontsize=9)
    return figure


def _draw(axes: Axes, found: ScoreMap) -> None:
    axes.set_facecolor(BACKGROUND)
    axes.grid(visible=False)
    axes.set_yscale("log")
    shares = np.ma.masked_less_equal(found.shares, 0)
    centres = np.sqrt(found.edges[:-1] * found.edges[1:])
    axes.pcolormesh(
        found.steps, centres, shares, cmap="Blues", vmin=-0.02, shading="nearest", rasterized=True
    )
    for i, level in enumerate(found.levels):
        color = LEVEL_COLORS[i % len(LEVEL_COLORS)]
        axes.axhline(level.value, color=color, lw=1.1, ls="--", label=f"{level.label} {level.value:.3g}")
    if found.levels:
        axes.legend(fontsize=7.5, loc="upper right", frameon=False, labelcolor="linecolor")
