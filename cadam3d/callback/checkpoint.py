"""Checkpoint: writes the state every so many steps and at the end, so that a killed run can be resumed."""

from dataclasses import dataclass

from cadam3d.callback.base import Callback
from cadam3d.core.checks import Count
from cadam3d.io.checkpoint import drop_after, prune_checkpoints, save_checkpoint
from cadam3d.io.run_folder import CHECKPOINTS, checkpoint_name
from cadam3d.state import Outcome, RunContext, StepReport, TrainState


@dataclass(frozen=True, kw_only=True)
class Checkpoint(Callback):
    """Save the whole :class:`TrainState`, atomically, into ``checkpoints/`` of the run folder."""

    every: Count  # steps
    keep: Count  # files

    def on_start(self, context: RunContext, state: TrainState) -> None:
        """Delete checkpoints of later steps, because this run will write its own."""
        drop_after(context.folder / CHECKPOINTS, state.step)

    def on_step(self, context: RunContext, state: TrainState, report: StepReport) -> None:
        """Save at every multiple of ``every``."""
        if state.step % self.every == 0:
            self._save(context, state)

    def on_end(self, context: RunContext, state: TrainState, outcome: Outcome) -> None:
        """Save the last step, unless it is saved already.

        After running out of memory nothing is saved: the step was left half done, and the last file stays
        valid.
        """
        if state.step % self.every != 0 and outcome is not Outcome.OUT_OF_MEMORY:
            self._save(context, state)

    def _save(self, context: RunContext, state: TrainState) -> None:
        folder = context.folder / CHECKPOINTS
        save_checkpoint(folder / checkpoint_name(state.step), state.to_payload())
        prune_checkpoints(folder, keep=self.keep)
