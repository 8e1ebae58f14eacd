"""metrics.jsonl: one line per logged step and per refinement."""

from dataclasses import dataclass

from cadam3d.callback.base import Callback
from cadam3d.core.checks import require_whole
from cadam3d.io.jsonl import append_jsonl, truncate_after
from cadam3d.state import RefineReport, RunContext, StepReport, TrainState

FILE_NAME = "metrics.jsonl"


@dataclass(frozen=True, kw_only=True)
class Metrics(Callback):
    """Appends to ``metrics.jsonl`` in the run folder; a resumed run first drops what it will write again."""

    every: int  # steps between step lines; refinements are always written

    def __post_init__(self) -> None:
        require_whole("callback.metrics.every", self.every, low=1, example=10)

    def on_start(self, context: RunContext, state: TrainState) -> None:
        """Forget lines of steps that a killed run had done after its last checkpoint."""
        truncate_after(context.folder / FILE_NAME, state.step)

    def on_step(self, context: RunContext, state: TrainState, report: StepReport) -> None:
        """Write every ``every``-th step, the first and the last."""
        if report.step % self.every == 0 or report.step in (1, context.total_steps):
            line = {
                "kind": "step",
                "step": report.step,
                "loss": report.loss,
                "num_gaussians": report.num_gaussians,
                "seconds": round(state.seconds, 3),
                **report.log,
            }
            append_jsonl(context.folder / FILE_NAME, line)

    def on_refine(self, context: RunContext, state: TrainState, report: RefineReport) -> None:
        """Write every refinement and reset, without the Gaussians themselves."""
        numbers = {name: value for name, value in vars(report).items() if name != "population"}
        append_jsonl(context.folder / FILE_NAME, {"kind": "refine", **numbers})
