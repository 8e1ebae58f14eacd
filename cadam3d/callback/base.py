"""Callback: watches the loop. May look, may write files, may never change training."""

from abc import ABC

from cadam3d.state import Outcome, RefineReport, RunContext, StepReport, TrainState


class Callback(ABC):  # noqa: B024 (every hook has a sensible default: do nothing)
    """Override what you need; the order of calls is start, (refine?, step)*, end."""

    def on_start(self, context: RunContext, state: TrainState) -> None:  # noqa: B027
        """Before the first step, also after a resume (then ``state.step`` > 0)."""

    def on_step(self, context: RunContext, state: TrainState, report: StepReport) -> None:  # noqa: B027
        """After every step and its refinement, so ``state`` is ready to be saved."""

    def on_refine(self, context: RunContext, state: TrainState, report: RefineReport) -> None:  # noqa: B027
        """After every refinement or opacity reset, before ``on_step`` of the same step."""

    def on_end(self, context: RunContext, state: TrainState, outcome: Outcome) -> None:  # noqa: B027
        """After the last step, whatever the outcome."""

    def on_abort(self, context: RunContext) -> None:  # noqa: B027
        """When the loop raised: let go of the terminal. The state may be half done, so it is not shown."""
