"""The progress bar: step, Gaussians, loss scale, steps per second, time left."""

from dataclasses import dataclass, field

from tqdm import tqdm

from cadam3d.callback.base import Callback
from cadam3d.state import Outcome, RunContext, StepReport, TrainState


@dataclass(kw_only=True)
class Progress(Callback):
    """A tqdm bar on standard error; plain lines where that is not a terminal."""

    refresh_seconds: float  # at most one redraw in this time
    _bar: tqdm | None = field(default=None, init=False, repr=False)

    def on_start(self, context: RunContext, state: TrainState) -> None:
        """Open the bar where the run stands."""
        self._bar = tqdm(
            total=context.total_steps,
            initial=state.step,
            desc=context.prompt[:32],
            unit="step",
            mininterval=self.refresh_seconds,
            dynamic_ncols=True,
        )

    def on_step(self, context: RunContext, state: TrainState, report: StepReport) -> None:
        """Advance by one."""
        if self._bar is not None:
            self._bar.set_postfix(N=report.num_gaussians, loss=f"{report.loss:.3g}", refresh=False)
            self._bar.update(1)

    def on_end(self, context: RunContext, state: TrainState, outcome: Outcome) -> None:
        """Close the bar, leaving its last line."""
        self.on_abort(context)

    def on_abort(self, context: RunContext) -> None:
        """Close the bar, so that what follows starts on a line of its own."""
        if self._bar is not None:
            self._bar.close()
