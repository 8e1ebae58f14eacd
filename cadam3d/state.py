"""TrainState: everything that a run needs to continue, and the reports that callbacks see."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from cadam3d.core.checks import require
from cadam3d.core.edit import RowEdit, RowState
from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.outcome import Outcome
from cadam3d.core.rendering import RenderFn
from cadam3d.core.sh import MAX_DEGREE
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
# The entries of a checkpoint that are neither tensors nor dicts.
COUNTS = ("step", "num_initial", "skipped", "dimmed", "seed")
TIMES = ("seconds", "cpu_seconds")
PLAIN = (*COUNTS, *TIMES, "initial_note", "refused")
MOST = 10**4000  # Python refuses to write much longer numbers


class PayloadError(ValueError):
    """A checkpoint that training cannot have written."""


@dataclass
class TrainState:
    """Everything that changes while training; a checkpoint contains exactly this."""

    step: int  # steps done
    seconds: float  # wall-clock time spent on them
    cpu_seconds: float  # time that the CPU spent on them, summed over all threads of the process
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
            **{name: getattr(self, name) for name in PLAIN},
            "gaussians": self.gaussians.detach().tensors(),
            "optimizer": self.optimizer.state_dict(),
            "densifier": self.densifier.to_dict(),
            "generators": {name: generator.get_state() for name, generator in self.generators.items()},
        }

    @classmethod
    def restore(
        cls, payload: Any, optimizer: AdamSettings, densifier: Densifier, device: torch.device
    ) -> "TrainState":
        """Return the state on ``device`` that :meth:`to_payload` described.

        Raises ``PayloadError`` if its entries, types or shapes are not those that :meth:`to_payload` writes,
        and ``UserError`` if the checkpoint belongs to another kind of densifier.
        """
        # A damaged payload may raise anything.
        try:
            _require_sound(payload, optimizer, densifier)
            owner = optimizer.start(Gaussians(**payload["gaussians"]).to(device))
            owner.load_state_dict(payload["optimizer"])
            rows = {name: tensor.to(device) for name, tensor in payload["densifier"].items()}
            generators = start_generators(payload["seed"])
            for name, generator in generators.items():
                generator.set_state(payload["generators"][name])
            return cls(
                **{name: payload[name] for name in PLAIN},
                optimizer=owner,
                densifier=type(densifier.init_state(0, device))(**rows),
                generators=generators,
            )
        except UserError:
            raise
        except Exception as error:
            raise PayloadError(error) from error


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
    population: Population = field(repr=False)  # before the edit
    edit: RowEdit | None = field(repr=False)  # what happened to the rows; None if none was added or removed


@dataclass(frozen=True)
class RunContext:
    """The parts of a run that a callback may use."""

    folder: Path  # of the run; exists
    prompt: str
    total_steps: int
    render: RenderFn  # renders the current Gaussians, without gradient
    # Renders other Gaussians, such as those before a refinement.
    rasterizer: Rasterizer
    # Computes scores and statistics from the state of the densifier.
    densifier: Densifier


def start_generators(seed: int) -> dict[str, torch.Generator]:
    """Return every source of randomness in its state before the first draw."""
    children = np.random.SeedSequence(seed).spawn(len(GENERATORS))
    return {
        name: torch.Generator().manual_seed(int(child.generate_state(1, np.uint64)[0] >> 1))
        for name, child in zip(GENERATORS, children, strict=True)
    }


def _require_sound(payload: Any, optimizer: AdamSettings, densifier: Densifier) -> None:
    """Raise an exception unless a payload has the entries, types and shapes of a run of its size."""
    gaussians, note = Gaussians(**payload["gaussians"]), payload["initial_note"]
    n, k = len(gaussians), (min(gaussians.sh_degree, MAX_DEGREE) + 1) ** 2
    shapes = (n, 3), (n, 3), (n, 4), (n,), (n, k, 3)
    blank = Gaussians(*(torch.empty(shape, device="meta") for shape in shapes))
    rows = densifier.init_state(n, blank.device).to_dict()
    require(
        sorted(rows) == sorted(payload["densifier"]),
        "densifier",
        expected=f"the one of the checkpoint (state: {sorted(payload['densifier'])})",
        got=sorted(rows),
        example="resume without densifier=...",
    )
    template = {
        **dict.fromkeys(COUNTS, 0),
        **dict.fromkeys(TIMES, 0.0),
        "initial_note": note if isinstance(note, str) and note.isprintable() else None,
        "refused": False,
        "gaussians": blank.tensors(),
        "optimizer": optimizer.start(blank).state_dict(),
        "densifier": rows,
        "generators": {name: draw.get_state() for name, draw in start_generators(0).items()},
    }
    if _form(payload) != _form(template) or not all(0 <= payload[name] < MOST for name in (*COUNTS, *TIMES)):
        raise PayloadError("its entries are not those of a run")


def _form(value: Any) -> Any:
    """Return the structure of a payload: the names of its entries, and their types and shapes."""
    if isinstance(value, dict):
        return {name: _form(entry) for name, entry in value.items()}
    return (value.dtype, value.shape) if isinstance(value, Tensor) else type(value)
