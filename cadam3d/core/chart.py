"""Chart: what a component declares so that the reports can draw the numbers it logs.

A chart is plain data. It travels in the folder of its run, so a report never needs the component itself.
"""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Curve:
    """One line of a chart: a number that is logged under ``key``."""

    # Key of a densifier's statistics or of an objective's log.
    key: str
    # Entry in the legend; empty if the chart has one curve only.
    label: str = ""
    # Whether the other curves are compared with this one, which is then dashed.
    is_threshold: bool = False


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
    # One sentence about what the numbers are and how to read them.
    caption: str
    curves: tuple[Curve, ...]
    # Keys of a lower and an upper bound, with the area between them shaded, and its entry in the legend.
    band: tuple[str, str] | None = None
    band_label: str = ""
    log_y: bool = False
    # Whether the logged numbers are shares in [0, 1] that are shown as percentages.
    percent: bool = False
    # One of the densifier's scores, or empty, and horizontal lines in the distribution of that score.
    score: str = ""
    levels: tuple[Level, ...] = ()
