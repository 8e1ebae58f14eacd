"""Progress: step, number of Gaussians, loss, speed and peak GPU memory.

In a terminal or a notebook this is a bar. Otherwise, as in a log file or the console of a sweep's job, it is
a line every few seconds.
"""

import os
import sys
import time
from dataclasses import dataclass, field

import torch
from tqdm import tqdm

from cadam3d.callback.base import Callback
from cadam3d.core.checks import AtLeastZero
from cadam3d.core.console import say, visible
from cadam3d.state import Outcome, RunContext, StepReport, TrainState

GIB = 2**30
TITLE = 32  # characters of the prompt


@dataclass(kw_only=True)
class Progress(Callback):
    """A tqdm bar on standard error if that is a terminal or the output of a notebook, else messages.

    ``VRAM``, on a CUDA device only, is the largest amount of memory that tensors have used at once; torch's
    cache and the driver use more. The environment variable ``TQDM_DISABLE`` turns off both the bar and the
    lines.
    """

    refresh_seconds: AtLeastZero
    line_seconds: AtLeastZero
    _bar: tqdm | None = field(default=None, init=False, repr=False)
    # The step and the seconds of training at which this process started.
    _begun: tuple[int, float] = field(default=(0, 0.0), init=False, repr=False)
    # The next line is due at this reading of the monotonic clock, in seconds.
    _due: float = field(default=0.0, init=False, repr=False)
    # The line of the last step; empty once it has been printed.
    _pending: str = field(default="", init=False, repr=False)

    def on_start(self, context: RunContext, state: TrainState) -> None:
        """Open the bar at the current step, if standard error can show one."""
        self._begun, self._due, self._pending = (state.step, state.seconds), 0.0, ""
        self._bar = None
        if shows_bars():
            self._bar = tqdm(
                total=context.total_steps,
                initial=state.step,
                desc=visible(context.prompt[:TITLE]),
                unit="step",
                mininterval=self.refresh_seconds,
                dynamic_ncols=True,
            )

    def on_step(self, context: RunContext, state: TrainState, report: StepReport) -> None:
        """Advance the bar by one step, or print a line if one is due."""
        shown = {"N": str(report.num_gaussians), "loss": f"{report.loss:.3g}"}
        if (peak := peak_memory(state.gaussians.device)) is not None:
            shown["VRAM"] = f"{peak / GIB:.1f}GiB"
        if self._bar is not None:
            self._bar.set_postfix(shown, refresh=False)
            self._bar.update(1)
            return
        steps, seconds = report.step - self._begun[0], state.seconds - self._begun[1]
        if seconds > 0:
            shown = {"speed": f"{steps / seconds:.3g} steps/s", **shown}
        facts = ", ".join(f"{name}={value}" for name, value in shown.items())
        self._pending = f"{context.prompt[:TITLE]}: step {report.step}/{context.total_steps}, {facts}"
        if time.monotonic() >= self._due or report.step == context.total_steps:
            self._print()

    def on_pause(self, context: RunContext, state: TrainState) -> None:
        """Leave the pause out of the averages of the bar."""
        if self._bar is not None:
            self._bar.unpause()

    def on_end(self, context: RunContext, state: TrainState, outcome: Outcome) -> None:
        """Close the bar and leave its last line on the screen, or print the line of the last step."""
        self.on_abort(context)

    def on_abort(self, context: RunContext) -> None:
        """Do the same, so that the next message starts on a new line."""
        if self._bar is not None:
            self._bar.close()
        elif self._pending:
            self._print()

    def _print(self) -> None:
        """Print the line of the last step."""
        if not os.environ.get("TQDM_DISABLE"):
            say(self._pending)
        self._pending, self._due = "", time.monotonic() + self.line_seconds


def shows_bars() -> bool:
    """Return whether standard error is a terminal, or the output of a cell in a notebook."""
    return sys.stderr.isatty() or type(sys.stderr).__module__ == "ipykernel.iostream"


def peak_memory(device: torch.device) -> int | None:
    """Return the largest number of bytes that tensors on ``device`` have used at once; None without CUDA."""
    return torch.cuda.max_memory_allocated(device) if device.type == "cuda" else None
