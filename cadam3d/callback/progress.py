"""Progress: a bar with step, number of Gaussians, loss, speed, time of the end and peak GPU memory."""

import time
from dataclasses import dataclass, field

import torch
from tqdm import tqdm

from cadam3d.callback.base import Callback
from cadam3d.state import Outcome, RunContext, StepReport, TrainState

DAY = 24 * 3600
GIB = 2**30


@dataclass(kw_only=True)
class Progress(Callback):
    """A tqdm bar on standard error; plain lines if that is not a terminal.

    ``done`` is the time of day at which the last step will end if steps keep the average duration that they
    have had since this process started training. ``VRAM``, on a CUDA device only, is the largest amount of
    memory that tensors have used at once; torch's cache and the driver use more.
    """

    refresh_seconds: float
    _bar: tqdm | None = field(default=None, init=False, repr=False)
    # Step and time, in seconds since the epoch, at which this process started training.
    _begun: tuple[int, float] = field(default=(0, 0.0), init=False, repr=False)

    def on_start(self, context: RunContext, state: TrainState) -> None:
        """Open the bar at the current step."""
        self._begun = state.step, time.time()
        self._bar = tqdm(
            total=context.total_steps,
            initial=state.step,
            desc=context.prompt[:32],
            unit="step",
            mininterval=self.refresh_seconds,
            dynamic_ncols=True,
        )

    def on_step(self, context: RunContext, state: TrainState, report: StepReport) -> None:
        """Advance the bar by one step."""
        if self._bar is None:
            return
        shown = {"N": report.num_gaussians, "loss": f"{report.loss:.3g}"}
        first_step, first_time = self._begun
        if first_step < report.step < context.total_steps:
            now = time.time()
            pace = (now - first_time) / (report.step - first_step)
            shown["done"] = clock(now, pace * (context.total_steps - report.step))
        if (peak := peak_memory(state.gaussians.device)) is not None:
            shown["VRAM"] = f"{peak / GIB:.1f}GiB"
        self._bar.set_postfix(shown, refresh=False)
        self._bar.update(1)

    def on_end(self, context: RunContext, state: TrainState, outcome: Outcome) -> None:
        """Close the bar and leave its last line on the screen."""
        self.on_abort(context)

    def on_abort(self, context: RunContext) -> None:
        """Close the bar, so that the next message starts on a new line."""
        if self._bar is not None:
            self._bar.close()


def clock(now: float, seconds: float) -> str:
    """Return the local time ``seconds`` after ``now`` (since the epoch), with the weekday if a day away."""
    pattern = "%H:%M" if seconds < DAY else "%a %H:%M"
    return time.strftime(pattern, time.localtime(now + seconds))


def peak_memory(device: torch.device) -> int | None:
    """Return the largest number of bytes that tensors on ``device`` have used at once; None without CUDA."""
    return torch.cuda.max_memory_allocated(device) if device.type == "cuda" else None
