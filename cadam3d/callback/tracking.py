"""Tracking: what TensorBoard and Weights & Biases have in common."""

import logging
from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from cadam3d.callback.base import Callback
from cadam3d.callback.metrics import step_numbers
from cadam3d.core.checks import Count, require_extra
from cadam3d.core.console import say
from cadam3d.io.image import step_picture
from cadam3d.io.run_folder import PREVIEWS
from cadam3d.state import RefineReport, RunContext, StepReport, TrainState


@dataclass(kw_only=True)
class Tracking(Callback):
    """Pass the numbers and the previews of a run on to a program that shows many runs.

    The numbers have the names of ``metrics.jsonl`` and ``summary.json``, with one of the prefixes ``train/``,
    ``refine/`` and ``result/``. No run depends on a tracker: if one raises any exception, it is switched off
    with a warning. A preview is recorded if the callback that draws it comes earlier in the list. Nothing
    here draws a random number or changes the run.
    """

    package: ClassVar[str]  # that pip installs; also the name of the callback and of the extra

    every: Count  # steps
    _works: bool = field(default=True, init=False, repr=False)
    # The numbers of a refinement, which are recorded with its step.
    _numbers: dict[str, float] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        require_extra(f"callback={self.package}", self.package, self.package)
        super().__post_init__()

    @abstractmethod
    def open(self, context: RunContext, step: int) -> None:
        """Begin to record, or continue after ``step`` of the same run."""

    @abstractmethod
    def record(self, step: int, numbers: Mapping[str, float], preview: Path | None) -> None:
        """Record the numbers and the picture of one step. Steps come in order."""

    @abstractmethod
    def conclude(self, context: RunContext, step: int, results: Mapping[str, float]) -> None:
        """Record the numbers of the finished run."""

    @abstractmethod
    def close(self, *, is_complete: bool) -> None:
        """Write what is left. ``is_complete`` is False if the run ended with an error."""

    def on_start(self, context: RunContext, state: TrainState) -> None:
        """Open the tracker at the current step."""
        self._works, self._numbers = True, {}
        self._attempt(lambda: self.open(context, state.step))

    def on_refine(self, context: RunContext, state: TrainState, report: RefineReport) -> None:
        """Keep the counts and the statistics of a refinement for :meth:`on_step` of the same step."""
        counts = {
            name: each for name, each in vars(report).items() if isinstance(each, int) and name != "step"
        }
        numbers = counts | report.statistics
        self._numbers = {f"refine/{name}": number for name, number in numbers.items()}

    def on_step(self, context: RunContext, state: TrainState, report: StepReport) -> None:
        """Record the numbers of a multiple of ``every``, and of the first and the last step."""
        numbers, self._numbers = self._numbers, {}
        if report.step % self.every == 0 or report.step in (1, context.total_steps):
            numbers |= {f"train/{name}": number for name, number in step_numbers(state, report).items()}
        picture = step_picture(context.folder / PREVIEWS, report.step)
        preview = picture if picture.is_file() else None
        if numbers or preview is not None:
            self._attempt(lambda: self.record(report.step, numbers, preview))

    def on_result(self, context: RunContext, summary: Mapping[str, Any]) -> None:
        """Record the numbers of the summary and close the tracker."""
        numbers = {f"result/{name}": each for name, each in summary.items() if type(each) in (int, float)}
        self._attempt(lambda: self.conclude(context, summary["steps"], numbers))
        self._attempt(lambda: self.close(is_complete=True))

    def on_abort(self, context: RunContext) -> None:
        """Close the tracker."""
        self._attempt(lambda: self.close(is_complete=False))

    def _attempt(self, action: Callable[[], None]) -> None:
        if not self._works:
            return
        try:
            action()
        except Exception as error:
            self._works = False
            reason = " ".join(f"{type(error).__name__}: {error}".split())[:300]
            say(
                f"Warning: callback.{self.package} has stopped ({reason}). The run continues.",
                logging.WARNING,
            )
