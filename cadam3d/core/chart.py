"""Chart: what a component declares so that the report can draw the numbers it logs."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Curve:
    """One line of a chart: a number that is logged under ``key``."""

    key: str  # of a densifier's statistics, or of an objective's log
    label: str = ""  # in the legend; empty if the chart has one curve only
    is_threshold: bool = False  # drawn dashed: the value that the other curves are compared with


@dataclass(frozen=True, kw_only=True)
class Chart:
    """A chart over training steps, declared by the component that logs its numbers.

    A densifier declares charts of its ``statistics`` (one point per refinement), an objective charts of its
    ``log`` (one point per logged step). The report draws a chart if any of its keys was logged, so that a
    component from another package gets its charts without a change to the report.
    """

    title: str
    caption: str  # one sentence: what the numbers are and how to read them
    curves: tuple[Curve, ...]
    band: tuple[str, str] | None = None  # keys of a lower and an upper bound, shaded between
    band_label: str = ""  # in the legend, such as "10 to 90 %"
    log_y: bool = False
    percent: bool = False  # the logged numbers are shares in [0, 1] and are shown as percentages
