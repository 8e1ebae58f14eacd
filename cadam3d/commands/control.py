"""Control: carries out what users request of a run that trains: to pause, resume, save and stop.

The requests are signals, and files (``io/live.py``), which the page of ``cadam3d view`` or a shell creates.
"""

import logging
import shlex
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from cadam3d.core.console import say
from cadam3d.core.errors import UserError
from cadam3d.io.checkpoint import save_checkpoint
from cadam3d.io.live import clear, is_asked, take_request
from cadam3d.io.ply import write_ply
from cadam3d.io.run_folder import LIVE_PAUSE, SAVED, checkpoint_name, saved_name, shown
from cadam3d.state import TrainState

LOOK_SECONDS = 0.25  # between two looks at the folder


@dataclass
class Control:
    """A function to call after every step. It waits while the run is paused, and returns whether to stop.

    A signal comes first: it also ends a pause. Requests to an earlier process are dropped.
    """

    run: Path
    state: TrainState
    # Returns whether a signal to stop has arrived.
    is_interrupted: Callable[[], bool]
    # Called several times a second while the run is paused.
    wait: Callable[[], None]
    # The reading of the monotonic clock at which the next look is due.
    _look_at: float = field(default=0.0, init=False)

    def __enter__(self) -> "Control":
        clear(self.run)
        return self

    def __exit__(self, *_: object) -> None:
        clear(self.run)

    def __call__(self) -> bool:
        """Carry out the requests, and return whether the run should stop."""
        now = time.monotonic()
        if now >= self._look_at and not self.is_interrupted():
            self._look_at = now + LOOK_SECONDS
            self._save_if_asked()
            if self._is_paused():
                self._pause()
            if take_request(self.run, "stop"):
                say("\nStopping, as requested. Everything will be saved.")
                return True
        return self.is_interrupted()

    def _is_paused(self) -> bool:
        return is_asked(self.run, "pause") and not is_asked(self.run, "stop") and not self.is_interrupted()

    def _pause(self) -> None:
        """Wait until the run may continue, or should stop."""
        file = shlex.quote(str(shown(self.run / LIVE_PAUSE)))
        step = self.state.step
        say(f"\nPaused after step {step}, as requested. To resume: rm {file}")
        while self._is_paused():
            self.wait()
            time.sleep(LOOK_SECONDS)
            self._save_if_asked()
        say("The pause has ended.")

    def _save_if_asked(self) -> None:
        """Save the asset and a state from which the run can continue. A failure costs only these files."""
        if not take_request(self.run, "save"):
            return
        folder, step = self.run / SAVED, self.state.step
        try:
            save_checkpoint(folder / checkpoint_name(step), self.state.to_payload())
            write_ply(folder / saved_name(step), self.state.gaussians, up="-y", pad_sh=0)
        except UserError as error:
            say(f"\nWarning: not saved: {error}", logging.WARNING)
        else:
            say(f"\nSaved {shown(folder / saved_name(step))}")
