"""TrainState: everything that a run needs to continue, and the reports that callbacks see."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from cadam3d.core.checks import require
from cadam3d.core.edit import RowEdit, RowState
from cadam3d.core.gaussians import FIELDS, Gaussians
from cadam3d.core.outcome import Outcome
from cadam3d.core.render import RenderFn
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
# Limits of what a checkpoint may claim. Nothing real comes near them.
MOST_STEPS = 10**12
MOST_DIGITS = 4000  # of a seed; Python refuses to write much longer numbers
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
        payload: Any,
        optimizer: AdamSettings,
        densifier: Densifier,
        device: torch.device,
    ) -> "TrainState":
        """Return the state on ``device`` that :meth:`to_payload` described.

        Raises ``PayloadError`` if any entry is not what :meth:`to_payload` writes, and ``UserError`` if the
        checkpoint belongs to another kind of densifier.
        """
        gaussians = _checked(payload)
        _require_densifier(payload["densifier"], densifier, len(gaussians), payload["step"])
        gaussians = gaussians.to(device)
        owner = optimizer.start(gaussians)
        owner.load_state_dict(payload["optimizer"])
        blank = densifier.init_state(len(gaussians), device)
        generators = start_generators(payload["seed"])
        for name, generator in generators.items():
            try:
                generator.set_state(payload["generators"][name])
            except RuntimeError as error:
                raise PayloadError(f"generators.{name}: expected the state of a generator") from error
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


def _checked(payload: Any) -> Gaussians:
    """Check every entry of a checkpoint except the densifier's, and return its Gaussians on the CPU.

    This is the one place that declares what :meth:`TrainState.to_payload` writes. Raises ``PayloadError``.
    """
    _require_keys("the checkpoint", payload, [field.name for field in fields(TrainState)] + ["gaussians"])
    for name in ("step", "num_initial", "skipped", "dimmed"):
        _require_whole(name, payload[name], MOST_STEPS)
    for name in ("skipped", "dimmed"):
        _require_whole(name, payload[name], payload["step"])
    _require_whole("seed", payload["seed"], 10**MOST_DIGITS)
    seconds, note = payload["seconds"], payload["initial_note"]
    _require(type(seconds) is float and 0 <= seconds < math.inf, "seconds", "a finite number >= 0")
    _require(type(payload["refused"]) is bool, "refused", "true or false")
    is_note = note is None or (type(note) is str and len(note) <= LONGEST_NOTE and note.isprintable())
    _require(is_note, "initial_note", "a printable text or nothing")

    tensors = payload["gaussians"]
    _require_keys("gaussians", tensors, FIELDS)
    _require(type(tensors["sh"]) is Tensor and tensors["sh"].ndim == 3, "gaussians.sh", "a tensor of 3 axes")
    n, coefficients, _ = tensors["sh"].shape
    squares = [(degree + 1) ** 2 for degree in range(MAX_DEGREE + 1)]
    _require(coefficients in squares, "gaussians.sh", f"one of {squares} coefficients")
    shapes = {"means": (n, 3), "log_scales": (n, 3), "quats": (n, 4), "opacity_logits": (n,)}
    for name, shape in {**shapes, "sh": (n, coefficients, 3)}.items():
        _require_tensor(f"gaussians.{name}", tensors[name], torch.zeros(()).expand(shape))
    gaussians = Gaussians(**tensors)

    _require_keys("optimizer", payload["optimizer"], ("steps", *MOMENTS))
    _require_whole("optimizer.steps", payload["optimizer"]["steps"], payload["step"])
    parts = parts_of(gaussians)
    for kind in MOMENTS:
        moments = payload["optimizer"][kind]
        _require_keys(f"optimizer.{kind}", moments, parts)
        for name, part in parts.items():
            _require_tensor(f"optimizer.{kind}.{name}", moments[name], part)
    for name, squared in payload["optimizer"]["exp_avg_sq"].items():
        _require(bool((squared >= 0).all()), f"optimizer.exp_avg_sq.{name}", "numbers >= 0")

    _require_keys("generators", payload["generators"], GENERATORS)
    for name, state in payload["generators"].items():
        _require_tensor(f"generators.{name}", state, torch.Generator().get_state())
    return gaussians


def _require_densifier(rows: Any, densifier: Densifier, n: int, step: int) -> None:
    """Raise ``PayloadError`` for a damaged state, and ``UserError`` for that of another densifier."""
    _require(type(rows) is dict and all(type(name) is str for name in rows), "densifier", "names and tensors")
    blank = densifier.init_state(n, torch.device("cpu"))
    expected = {field.name for field in fields(blank)}
    require(
        expected == set(rows),
        "densifier",
        expected=f"the one of the checkpoint (state: {sorted(rows)})",
        got=sorted(expected),
        example="resume without densifier=...",
    )
    for name, like in blank.to_dict().items():
        _require_tensor(f"densifier.{name}", rows[name], like)
    state = type(blank)(**{name: rows[name] for name in expected})
    _require(state.is_possible(step), "densifier", f"numbers that {step} steps can lead to")


def _require(claim: bool, name: str, expected: str) -> None:
    if not claim:
        raise PayloadError(f"{name}: expected {expected}")


def _require_keys(name: str, entries: Any, expected: Iterable[str]) -> None:
    keys = sorted(expected)
    is_dict = type(entries) is dict and all(type(key) is str for key in entries)
    _require(is_dict and sorted(entries) == keys, name, f"the entries {', '.join(keys)}")


def _require_whole(name: str, value: Any, most: int) -> None:
    _require(type(value) is int and 0 <= value <= most, name, "a whole number in its range")


def _require_tensor(name: str, value: Any, like: Tensor) -> None:
    """Raise ``PayloadError`` unless ``value`` is a tensor of finite numbers with the form of ``like``."""
    wanted = f"{str(like.dtype).removeprefix('torch.')} of shape {tuple(like.shape)}"
    _require(type(value) is Tensor, name, wanted)
    is_dense = value.layout is torch.strided and value.device.type != "meta"
    _require(is_dense and value.dtype == like.dtype and value.shape == like.shape, name, wanted)
    _require(bool(value.isfinite().all()), name, "finite numbers")
