"""Live: writes the current Gaussians and a few numbers for the page of ``cadam3d view``, while one is open.

The other parts of a live view are elsewhere: ``io/live.py`` has the files, ``commands/control.py`` carries
out what the buttons request, and ``cadam3d/live/`` has the server and the page.
"""

import logging
import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from cadam3d.callback.row_history import RowHistory
from cadam3d.core.checks import within
from cadam3d.io.live import Watch, begin, publish, publish_state
from cadam3d.io.run_folder import LIVE_SNAPSHOT
from cadam3d.state import Outcome, RunContext, StepReport, TrainState

log = logging.getLogger(__name__)


@dataclass(kw_only=True)
class Live(RowHistory):
    """Write ``live/snapshot.bin`` and ``live/state.json`` while a page shows the run, and nothing otherwise.

    A snapshot has the layers of ``callback/row_history.py``. This callback never draws a random number, and
    a full disk ends the live view but not the run.
    """

    seconds: Annotated[float, within(low=0.1)]  # between two snapshots
    share: Annotated[float, within(above=0, high=1)]  # share of the training time
    # Whether files can be written. Becomes False after the first failure.
    _works: bool = field(default=False, init=False, repr=False)
    _watch: Watch = field(default_factory=lambda: Watch(Path()), init=False, repr=False)
    # The reading of the monotonic clock at which the next snapshot is due.
    _due: float = field(default=0.0, init=False, repr=False)
    # The step of the last snapshot, and whether the run was paused then.
    _shown: tuple[int, bool] = field(default=(-1, False), init=False, repr=False)
    _loss: float | None = field(default=None, init=False, repr=False)

    def on_start(self, context: RunContext, state: TrainState) -> None:
        """Create ``live/`` and write the first numbers, so that a page finds them."""
        super().on_start(context, state)
        self._watch, self._works = Watch(context.folder), True
        self._due, self._shown, self._loss = 0.0, (-1, False), None
        with self._writing():
            begin(context.folder)
            self._write_state(context, state)

    def on_step(self, context: RunContext, state: TrainState, report: StepReport) -> None:
        """Write a snapshot if a page is open and one is due."""
        self._loss = report.loss
        self._show(context, state, is_paused=False)

    def on_pause(self, context: RunContext, state: TrainState) -> None:
        """Write a snapshot of the step after which the run is paused."""
        self._show(context, state, is_paused=True)

    def on_end(self, context: RunContext, state: TrainState, outcome: Outcome) -> None:
        """Write the last numbers, with which a page can show that the outputs are being written."""
        if self._works and outcome is not Outcome.OUT_OF_MEMORY:
            with self._writing():
                self._write_state(context, state, has_ended=True)

    def _show(self, context: RunContext, state: TrainState, *, is_paused: bool) -> None:
        now = time.monotonic()
        is_news = is_paused != self._shown[1]
        if not self._works or (now < self._due and not is_news) or not self._watch.is_watched():
            return
        with self._writing():
            if state.step != self._shown[0]:
                publish(context.folder / LIVE_SNAPSHOT, self.snapshot(context, state))
            self._write_state(context, state, is_paused=is_paused)
        self._shown = (state.step, is_paused)
        ended = time.monotonic()
        # A snapshot that took long is followed by a long time without one.
        self._due = max(now + self.seconds, ended + (ended - now) / self.share)

    def _write_state(
        self, context: RunContext, state: TrainState, *, is_paused: bool = False, has_ended: bool = False
    ) -> None:
        statistics = context.densifier.statistics(state.densifier, state.step)
        entries: dict[str, Any] = {
            "step": state.step,
            "total_steps": context.total_steps,
            "num_gaussians": len(state.gaussians),
            "seconds": round(state.seconds, 3),
            "loss": self._loss,
            "is_paused": is_paused,
            "has_ended": has_ended,
            "statistics": {name: number for name, number in statistics.items() if math.isfinite(number)},
        }
        publish_state(context.folder, entries)

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """End the live view, but not the run, if a file cannot be written."""
        try:
            yield
        except OSError as error:
            self._works = False
            log.warning("the live view has ended, because its files cannot be written: %s", error)
