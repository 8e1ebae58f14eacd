"""TrainState: everything a run needs to go on, and the reports that callbacks see."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from cadam3d.core.edit import RowState
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.outcome import Outcome
from cadam3d.core.render import RenderFn
from cadam3d.optimizer import GaussianOptimizer
from cadam3d.rasterizer.base import Rasterizer

__all__ = ["Outcome", "Population", "RefineReport", "RunContext", "StepReport", "TrainState"]

# Each source of randomness has its own generator: two densifiers with one seed see the same views and noise.
# New names go to the end: a seed gives each the stream of its place.
GENERATORS = (
    "initializer",
    "camera",
    "background",
    "guidance",
    "refine",
    "densifier",
    "augmentation",
)


@dataclass
class TrainState:
    """All that changes while training; a checkpoint is exactly this."""

    step: int  # steps done
    seconds: float  # wall-clock time spent on them
    num_initial: int  # Gaussians at step 0
    initial_note: str | None  # where they are not from the initializer that was asked for: why, and from what
    skipped: int  # steps without an update, because a gradient was not finite
    dimmed: int  # steps after which the exposure guard dimmed all colours
    refused: bool  # the refinement of the last step would exceed max_gaussians; it waits for a larger one
    seed: int  # what the generators descend from
    optimizer: GaussianOptimizer  # owns the Gaussians
    densifier: RowState
    generators: dict[str, torch.Generator]  # one per source of randomness, on the CPU

    @property
    def gaussians(self) -> Gaussians:
        """The Gaussians as they stand."""
        return self.optimizer.gaussians

    def to_payload(self) -> dict[str, Any]:
        """Plain tensors, numbers and dicts: what a checkpoint file holds."""
        return {
            "step": self.step,
            "seconds": self.seconds,
            "num_initial": self.num_initial,
            "initial_note": self.initial_note,
            "skipped": self.skipped,
            "dimmed": self.dimmed,
            "refused": self.refused,
            "seed": self.seed,
            "gaussians": self.gaussians.detach().tensors(),
            "optimizer": self.optimizer.state_dict(),
            "densifier": self.densifier.to_dict(),
            "generators": {name: generator.get_state() for name, generator in self.generators.items()},
        }


@dataclass(frozen=True)
class StepReport:
    """What one training step did."""

    step: int  # 1 after the first step
    loss: float  # surrogate value: half the squared norm of the guidance gradient, plus regularizers
    log: dict[str, float]  # of the guidance and the regularizers
    num_gaussians: int


@dataclass(frozen=True)
class Population:
    """The Gaussians that a refinement or reset was decided on, for pictures of the decision.

    References, not copies, good until the next step; at a reset without refinement the opacities are those
    after it. While callbacks look, they keep alive what the edit replaced: per Gaussian 56 bytes at SH degree
    0, 1 of the mask and 4 per score (CAdam has three).
    """

    gaussians: Gaussians  # before the edit, without gradient
    is_selected: Bool[Tensor, "n"]  # by the densifier, to grow
    scores: dict[str, Float[Tensor, "n"]]  # of the densifier


@dataclass(frozen=True)
class RefineReport:
    """What one refinement or opacity reset did, in counts of Gaussians, and what the densifier saw."""

    step: int
    before: int
    after: int
    selected: int
    cloned: int
    split: int
    pruned: int
    reset: int  # opacities lowered
    statistics: dict[str, float]  # of the densifier
    population: Population  # before the edit


@dataclass(frozen=True)
class RunContext:
    """What a callback may look at."""

    folder: Path  # of the run; exists
    prompt: str
    total_steps: int
    render: RenderFn  # the Gaussians as they stand, without gradient
    rasterizer: Rasterizer  # for other Gaussians, such as those before a refinement


def start_generators(seed: int) -> dict[str, torch.Generator]:
    """Every source of randomness as it is before the first draw."""
    children = np.random.SeedSequence(seed).spawn(len(GENERATORS))
    return {
        name: torch.Generator().manual_seed(int(child.generate_state(1, np.uint64)[0] >> 1))
        for name, child in zip(GENERATORS, children, strict=True)
    }
