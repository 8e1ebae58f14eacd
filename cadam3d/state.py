"""TrainState: everything that a run needs to continue, and the reports that callbacks see."""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from cadam3d.core.checks import require
from cadam3d.core.edit import RowEdit, RowState
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.outcome import Outcome
from cadam3d.core.rendering import RenderFn
from cadam3d.core.sh import MAX_DEGREE
from cadam3d.densifier.base import Densifier
from cadam3d.optimizer import MOMENTS, AdamSettings, GaussianOptimizer, parts_of
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
PLAIN = ("step", "seconds", "num_initial", "initial_note", "skipped", "dimmed", "refused", "seed")
SH_SIZES = tuple((degree + 1) ** 2 for degree in range(MAX_DEGREE + 1))
# Limits of what a checkpoint may claim. Nothing real comes near them.
MOST_STEPS = 10**12
MOST = 10**4000  # for a seed too; Python refuses to write much longer numbers
LONGEST_NOTE = 10_000  # characters


class PayloadError(ValueError):
    """An entry of a checkpoint that training cannot have written; the text names it and what was expected."""


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

        Raises ``PayloadError`` if any entry is not what :meth:`to_payload` writes, and ``UserError`` if the
        checkpoint belongs to another kind of densifier.
        """
        blank = densifier.init_state(0, torch.device("cpu"))
        _require_like("", payload, _template(payload, densifier))
        rows = type(blank)(**payload["densifier"])
        _require_reachable(payload, rows)
        owner = optimizer.start(Gaussians(**payload["gaussians"]).to(device))
        owner.load_state_dict(payload["optimizer"])
        generators = start_generators(payload["seed"])
        for name, generator in generators.items():
            try:
                generator.set_state(payload["generators"][name])
            except RuntimeError as error:
                raise PayloadError(f"generators.{name}: expected the state of a generator") from error
        return cls(
            **{name: payload[name] for name in PLAIN},
            optimizer=owner,
            densifier=type(rows)(**{name: tensor.to(device) for name, tensor in rows.to_dict().items()}),
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


def _template(payload: Any, densifier: Densifier) -> dict[str, Any]:
    """Return what a checkpoint holds that is as large as ``payload`` claims to be: the types and the shapes.

    Raises ``PayloadError`` if it claims no size, and ``UserError`` if it belongs to another densifier.
    """
    sh, rows = _entry(_entry(payload, "gaussians"), "sh"), _entry(payload, "densifier")
    _require(type(sh) is Tensor and sh.ndim == 3, "gaussians.sh", "a tensor of 3 axes")
    n, coefficients, _ = sh.shape
    _require(coefficients in SH_SIZES, "gaussians.sh", f"one of {SH_SIZES} coefficients")
    shapes = {"means": (n, 3), "log_scales": (n, 3), "quats": (n, 4), "opacity_logits": (n,)}
    shapes["sh"] = (n, coefficients, 3)
    # One number, repeated without memory.
    gaussians = Gaussians(**{name: torch.zeros(()).expand(shape) for name, shape in shapes.items()})
    blank = densifier.init_state(n, torch.device("meta")).to_dict()
    _require(type(rows) is dict and all(type(name) is str for name in rows), "densifier", "names and tensors")
    require(
        sorted(blank) == sorted(rows),
        "densifier",
        expected=f"the one of the checkpoint (state: {sorted(rows)})",
        got=sorted(blank),
        example="resume without densifier=...",
    )
    return {
        **dict.fromkeys(("step", "num_initial", "skipped", "dimmed", "seed"), 0),
        "seconds": 0.0,
        "initial_note": None,
        "refused": False,
        "gaussians": gaussians.tensors(),
        "optimizer": {"steps": 0, **dict.fromkeys(MOMENTS, parts_of(gaussians))},
        "densifier": blank,
        "generators": dict.fromkeys(GENERATORS, torch.Generator().get_state()),
    }


def _entry(entries: Any, name: str) -> Any:
    _require(type(entries) is dict and name in entries, name, "an entry")
    return entries[name]


def _require_like(name: str, value: Any, like: Any) -> None:
    """Raise ``PayloadError`` unless ``value`` has the structure, the types and the shapes of ``like``.

    Numbers are finite, and those that are not in tensors are not negative.
    """
    if isinstance(like, dict):
        is_dict = type(value) is dict and all(type(key) is str for key in value)
        wanted = f"the entries {', '.join(sorted(like))}"
        _require(is_dict and sorted(value) == sorted(like), name or "the checkpoint", wanted)
        for key, each in like.items():
            _require_like(f"{name}.{key}".lstrip("."), value[key], each)
    elif isinstance(like, Tensor):
        wanted = f"{str(like.dtype).removeprefix('torch.')} of shape {tuple(like.shape)}, all finite"
        is_dense = type(value) is Tensor and value.layout is torch.strided and value.device.type != "meta"
        _require(is_dense and value.dtype == like.dtype and value.shape == like.shape, name, wanted)
        _require(bool(value.isfinite().all()), name, wanted)
    elif like is None:
        is_note = type(value) is str and len(value) <= LONGEST_NOTE and value.isprintable()
        _require(value is None or is_note, name, "a printable text or nothing")
    else:
        is_alike = type(value) is type(like) and 0 <= value < (math.inf if type(like) is float else MOST)
        _require(is_alike, name, f"a {type(like).__name__} in its range")


def _require_reachable(payload: dict[str, Any], rows: RowState) -> None:
    """Raise ``PayloadError`` unless as many steps as were done can lead to the other numbers."""
    step = payload["step"]
    _require(step <= MOST_STEPS, "step", "a number of steps")
    for name in ("skipped", "dimmed"):
        _require(payload[name] <= step, name, f"at most {step}")
    _require(payload["optimizer"]["steps"] <= step, "optimizer.steps", f"at most {step}")
    for name, squared in payload["optimizer"]["exp_avg_sq"].items():
        _require(bool((squared >= 0).all()), f"optimizer.exp_avg_sq.{name}", "numbers >= 0")
    _require(rows.is_possible(step), "densifier", f"numbers that {step} steps can lead to")


def _require(claim: bool, name: str, expected: str) -> None:
    if not claim:
        raise PayloadError(f"{name}: expected {expected}")
