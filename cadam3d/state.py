"""TrainState: everything that a run needs to continue, and the reports that callbacks see."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from cadam3d.core.checks import require
from cadam3d.core.edit import RowState
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.outcome import Outcome
from cadam3d.core.render import RenderFn
from cadam3d.densifier.base import Densifier
from cadam3d.optimizer import AdamSettings, GaussianOptimizer
from cadam3d.rasterizer.base import Rasterizer

__all__ = ["Outcome", "Population", "RefineReport", "RunContext", "StepReport", "TrainState"]

# Each source of randomness has its own generator, so that two densifiers with one seed see the same views and
# noise. The position of a name decides which stream a seed gives it. New names go to the end, so that no
# other stream moves.
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
    """Everything that changes while training; a checkpoint contains exactly this."""

    step: int  # steps done
    seconds: float  # wall-clock time spent on them
    num_initial: int  # Gaussians at step 0
    # Which fallback replaced the chosen initializer, and why; None if the chosen one was used.
    initial_note: str | None
    # Steps without an update, because a gradient was not finite.
    skipped: int
    # Steps after which the exposure guard dimmed all colours.
    dimmed: int
    # Whether the refinement after the last step was refused, because it would have exceeded max_gaussians.
    refused: bool
    seed: int  # of all generators
    optimizer: GaussianOptimizer  # owns the Gaussians
    densifier: RowState
    generators: dict[str, torch.Generator]  # one per source of randomness, on the CPU

    @property
    def gaussians(self) -> Gaussians:
        """Return the current Gaussians: the leaf tensors of the optimizer."""
        return self.optimizer.gaussians

    def to_payload(self) -> dict[str, Any]:
        """Return the content of a checkpoint file: plain tensors, numbers and dicts."""
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

    @classmethod
    def restore(
        cls,
        payload: Mapping[str, Any],
        optimizer: AdamSettings,
        densifier: Densifier,
        device: torch.device,
    ) -> "TrainState":
        """Return the state on ``device`` that :meth:`to_payload` described.

        Raises ``UserError`` if the checkpoint belongs to another kind of densifier, or if its parts disagree
        about the number of Gaussians.
        """
        gaussians = Gaussians(**payload["gaussians"]).to(device)
        owner = optimizer.start(gaussians)
        owner.load_state_dict(payload["optimizer"])
        blank = densifier.init_state(len(gaussians), device)
        expected = {field.name for field in fields(blank)}
        require(
            expected == set(payload["densifier"]),
            "densifier",
            expected=f"the one of the checkpoint (state: {sorted(payload['densifier'])})",
            got=sorted(expected),
            example="resume without densifier=...",
        )
        require(
            all(len(rows) == len(gaussians) for rows in payload["densifier"].values()),
            "resume",
            expected="a checkpoint whose densifier state has one row per Gaussian",
            got=f"{len(gaussians)} Gaussians and another number of rows",
            example="resume=RUN/checkpoints/<an earlier one>",
        )
        generators = start_generators(payload["seed"])
        for name, generator in generators.items():
            generator.set_state(payload["generators"][name])
        return cls(
            step=payload["step"],
            seconds=payload["seconds"],
            num_initial=payload["num_initial"],
            initial_note=payload["initial_note"],
            skipped=payload["skipped"],
            dimmed=payload["dimmed"],
            refused=payload["refused"],
            seed=payload["seed"],
            optimizer=owner,
            densifier=type(blank)(**{name: rows.to(device) for name, rows in payload["densifier"].items()}),
            generators=generators,
        )


@dataclass(frozen=True)
class StepReport:
    """Result of one training step."""

    step: int  # 1 after the first step
    # A surrogate: half the squared norm of the guidance gradient, plus regularizers.
    loss: float
    log: dict[str, float]  # of the guidance and the regularizers
    num_gaussians: int


@dataclass(frozen=True)
class Population:
    """The Gaussians on which a refinement or reset was decided, for pictures of the decision.

    These are references, not copies, and valid until the next step; after a reset without refinement the
    opacities are the lowered ones. While callbacks use them, they keep the replaced tensors in memory: per
    Gaussian 56 bytes at SH degree 0, 1 byte of the mask and 4 bytes per score (CAdam has three).
    """

    gaussians: Gaussians  # before the edit, without gradient
    is_selected: Bool[Tensor, "n"]  # Gaussians that the densifier chose to grow
    scores: dict[str, Float[Tensor, "n"]]  # of the densifier


@dataclass(frozen=True)
class RefineReport:
    """Result of one refinement or opacity reset, in counts of Gaussians, with the statistics before it."""

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
    """The parts of a run that a callback may use."""

    folder: Path  # of the run; exists
    prompt: str
    total_steps: int
    render: RenderFn  # renders the current Gaussians, without gradient
    # Renders other Gaussians, such as those before a refinement.
    rasterizer: Rasterizer


def start_generators(seed: int) -> dict[str, torch.Generator]:
    """Return every source of randomness in its state before the first draw."""
    children = np.random.SeedSequence(seed).spawn(len(GENERATORS))
    return {
        name: torch.Generator().manual_seed(int(child.generate_state(1, np.uint64)[0] >> 1))
        for name, child in zip(GENERATORS, children, strict=True)
    }
