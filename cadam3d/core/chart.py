"""Chart: what a component declares so that the reports can draw the numbers it logs.

A chart is plain data. It travels in the folder of its run, so a report never needs the component itself.
"""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Curve:
    """One line of a chart: a number that is logged under ``key``."""

    key: str  # of a densifier's statistics, or of an objective's log
    label: str = ""  # in the legend; empty if the chart has one curve only
    is_threshold: bool = False  # drawn dashed: a value that the other curves are compared with


@dataclass(frozen=True, kw_only=True)
class Level:
    """A constant that the values of a score are compared with, such as a threshold."""

    label: str
    value: float  # in the unit of the score


@dataclass(frozen=True, kw_only=True)
class Chart:
    """A chart over training steps, declared by the component that logs its numbers.

    A densifier declares charts of its ``statistics`` (one point per refinement), an objective charts of its
    ``log`` (one point per logged step). The report of a run draws a chart if any of its keys was logged, so a
    component from another package gets its charts without a change to the report.

    A densifier may also name one of its ``scores``. The report of a sweep then draws how that score is
    distributed over the Gaussians, step by step, if the jobs ran with the ``candidates`` callback.
    """

    title: str
    caption: str  # one sentence: what the numbers are and how to read them
    curves: tuple[Curve, ...]
    band: tuple[str, str] | None = None  # keys of a lower and an upper bound, shaded between
    band_label: str = ""  # in the legend, such as "10 to 90 %"
    log_y: bool = False
    percent: bool = False  # the logged numbers are shares in [0, 1] and are shown as percentages
    score: str = ""  # one of the densifier's scores; empty if the chart is not about a score
    levels: tuple[Level, ...] = ()  # horizontal lines in the distribution of that score
