"""Metrics: writes metrics.jsonl, with one line per logged step and per refinement."""

from dataclasses import dataclass

from cadam3d.callback.base import Callback
from cadam3d.core.checks import Count
from cadam3d.io.jsonl import append_jsonl, truncate_after
from cadam3d.io.run_folder import METRICS
from cadam3d.state import RefineReport, RunContext, StepReport, TrainState


@dataclass(frozen=True, kw_only=True)
class Metrics(Callback):
    """Append to ``metrics.jsonl`` in the run folder; a resumed run first deletes what it will repeat."""

    every: Count  # steps

    def on_start(self, context: RunContext, state: TrainState) -> None:
        """Delete lines of steps that a killed run did after its last checkpoint."""
        truncate_after(context.folder / METRICS, state.step)

    def on_step(self, context: RunContext, state: TrainState, report: StepReport) -> None:
        """Write a line at multiples of ``every``, and for the first and the last step."""
        if report.step % self.every == 0 or report.step in (1, context.total_steps):
            numbers = step_numbers(state, report)
            append_jsonl(context.folder / METRICS, {"kind": "step", "step": report.step, **numbers})

    def on_refine(self, context: RunContext, state: TrainState, report: RefineReport) -> None:
        """Write a line for every refinement and reset, without the Gaussians themselves."""
        numbers = {name: each for name, each in vars(report).items() if name not in ("population", "edit")}
        append_jsonl(context.folder / METRICS, {"kind": "refine", **numbers})


def step_numbers(state: TrainState, report: StepReport) -> dict[str, float]:
    """Return the numbers of one step, as ``metrics.jsonl`` and the trackers record them."""
    return {
        "loss": report.loss,
        "num_gaussians": report.num_gaussians,
        "seconds": round(state.seconds, 3),
        **report.log,
    }
