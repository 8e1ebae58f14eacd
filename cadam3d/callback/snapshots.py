"""Snapshots: records the Gaussians at some steps, so that the report can show how the object grows."""

import logging
from dataclasses import dataclass

from cadam3d.callback.row_history import RowHistory
from cadam3d.core.checks import Count, Whole
from cadam3d.core.errors import UserError
from cadam3d.io.atomic import replacing
from cadam3d.io.run_folder import SNAPSHOTS, snapshot_name, snapshots
from cadam3d.state import RunContext, StepReport, TrainState

log = logging.getLogger(__name__)


@dataclass(kw_only=True)
class Snapshots(RowHistory):
    """Write ``snapshots/step_0000050.bin`` and so on, in the format of ``viewer/pack.py``.

    The start, multiples of ``every`` and the last step are recorded. Nothing is rendered, so a snapshot of a
    few thousand Gaussians takes a few milliseconds. Populations above ``largest`` are left out. A snapshot
    that cannot be written does not stop the run.
    """

    every: Count  # steps
    largest: Whole  # Gaussians

    def on_start(self, context: RunContext, state: TrainState) -> None:
        """Record the start. Delete what a killed run recorded after its last checkpoint."""
        for step, path in snapshots(context.folder).items():
            if step > state.step:
                path.unlink()
        super().on_start(context, state)
        if state.step == 0:
            self._record(context, state)

    def on_step(self, context: RunContext, state: TrainState, report: StepReport) -> None:
        """Record the current Gaussians at multiples of ``every`` and after the last step."""
        if report.step % self.every == 0 or report.step == context.total_steps:
            self._record(context, state)

    def _record(self, context: RunContext, state: TrainState) -> None:
        if len(state.gaussians) > self.largest:
            return
        try:
            with replacing(context.folder / SNAPSHOTS / snapshot_name(state.step)) as temporary:
                temporary.write_bytes(self.snapshot(context, state))
        except UserError as error:
            log.warning("no snapshot of step %d: %s", state.step, error)
