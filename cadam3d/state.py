"""TrainState: everything a run needs to go on, and the reports that callbacks see."""

from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import torch

from cadam3d.core.edit import RowState
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.render import RenderFn
from cadam3d.optimizer import GaussianOptimizer


class Outcome(StrEnum):
    """How a run ended. Running out of memory is an outcome, written down, not a crash."""

    FINISHED = "finished"
    INTERRUPTED = "interrupted"
    MAX_GAUSSIANS = "max_gaussians"
    OUT_OF_MEMORY = "out_of_memory"
    VANISHED = "vanished"  # every Gaussian was pruned
    FAILED = "failed"


@dataclass
class TrainState:
    """All that changes while training; a checkpoint is exactly this."""

    step: int  # steps done
    optimizer: GaussianOptimizer  # owns the Gaussians
    densifier: RowState
    generators: dict[str, torch.Generator]  # one per source of randomness, on the CPU

    @property
    def gaussians(self) -> Gaussians:
        """The Gaussians as they stand."""
        return self.optimizer.gaussians


@dataclass(frozen=True)
class StepReport:
    """What one training step did."""

    step: int  # 1 after the first step
    loss: float
    log: dict[str, float]  # of the guidance and the regularizers
    num_gaussians: int


@dataclass(frozen=True)
class RefineReport:
    """What one refinement did, in counts of Gaussians, and what the densifier saw."""

    step: int
    before: int
    after: int
    selected: int
    cloned: int
    split: int
    pruned: int
    reset: int  # opacities lowered at this step
    statistics: dict[str, float]  # of the densifier


@dataclass(frozen=True)
class RunContext:
    """What a callback may look at."""

    prompt: str
    total_steps: int
    config: dict[str, Any]
    render: RenderFn
