"""Callback: watches the training loop. It may write files but never change training."""

from abc import ABC
from collections.abc import Mapping
from typing import Any

from cadam3d.core.checks import Declared
from cadam3d.state import Outcome, RefineReport, RunContext, StepReport, TrainState


class Callback(Declared, ABC):
    """Override the hooks that you need.

    The order of calls is ``start, (refine?, step, pause*)*, end, result``.
    """

    def on_start(self, context: RunContext, state: TrainState) -> None:
        """Called before the first step, also after a resume (then ``state.step`` > 0)."""

    def on_step(self, context: RunContext, state: TrainState, report: StepReport) -> None:
        """Called after every step and its refinement, so ``state`` is ready to be saved."""

    def on_refine(self, context: RunContext, state: TrainState, report: RefineReport) -> None:
        """Called after every refinement or opacity reset, before ``on_step`` of the same step."""

    def on_pause(self, context: RunContext, state: TrainState) -> None:
        """Called several times a second while the run waits between two steps, because a user paused it."""

    def on_end(self, context: RunContext, state: TrainState, outcome: Outcome) -> None:
        """Called after the last step, whatever the outcome."""

    def on_result(self, context: RunContext, summary: Mapping[str, Any]) -> None:
        """Called when the outputs of the run are written and measured. ``summary`` is ``summary.json``."""

    def on_abort(self, context: RunContext) -> None:
        """Called when the loop raised an exception, to release the terminal.

        The state is not passed, because it may be half updated.
        """
