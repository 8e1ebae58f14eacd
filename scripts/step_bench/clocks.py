"""Clocks around the parts of a training step."""

import copy
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

# Methods of components by part. A part also contains what its methods call, except other parts.
METHODS = {
    "camera": ("camera", ["sample"]),
    "background": ("background", ["sample"]),
    "augmentation": ("augmentation", ["perturb", "show"]),
    "rasterizer": ("render", ["render", "render_ahead"]),
    "prior": ("prior", ["encode", "decode", "predict"]),
    "guidance": ("guidance", ["__call__"]),
    "densifier": ("observe", ["observe", "perturb"]),
    "exposure": ("exposure", ["dimming"]),
}
ORDER = (
    *("camera", "background", "augmentation", "render", "condition", "prior", "guidance", "regularizers"),
    *("backward", "observe", "readback", "optimizer", "exposure", "refinement", "callbacks", "rest"),
)


class Watch:
    """Adds up seconds by part; a part inside another one is subtracted from it."""

    def __init__(self, device: Any) -> None:
        self.device = device
        self.is_on = False
        self.seconds = defaultdict[str, float](float)
        self.calls = defaultdict[str, int](int)
        # The parts that are running, and the seconds of parts inside them.
        self.running: list[str] = []
        self.inside: list[float] = [0.0]

    def __call__(self, part: str, work: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*args: Any, **kwargs: Any) -> Any:
            self.calls[part] += 1
            self.running.append(part)
            self.inside.append(0.0)
            started = self.now()
            try:
                return work(*args, **kwargs)
            finally:
                taken = self.now() - started
                self.seconds[part] += taken - self.inside.pop()
                self.inside[-1] += taken
                self.running.pop()

        return timed

    def now(self) -> float:
        """Return the CPU time of this process, or on CUDA the wall clock once the device is idle."""
        if not self.is_on:
            return 0.0
        if self.device.type == "cuda":
            import torch

            torch.cuda.synchronize(self.device)
            return time.perf_counter()
        return time.process_time()


def timed(component: Any, methods: list[str], part: str, watch: Watch) -> Any:
    """Return a copy of a component with a clock around some of its methods."""
    kind = type(component)
    around = {name: watch(part, getattr(kind, name)) for name in methods if hasattr(kind, name)}
    copied = copy.copy(component)
    object.__setattr__(copied, "__class__", type(kind.__name__, (kind,), around))
    return copied


def split(trainer: Any, watch: Watch) -> Any:
    """Return the trainer with a clock around each component."""
    parts = {
        name: timed(getattr(trainer, name), methods, part, watch) for name, (part, methods) in METHODS.items()
    }
    regularizers = {
        name: timed(penalty, ["__call__"], "regularizers", watch)
        for name, penalty in trainer.regularizers.items()
    }
    return replace(trainer, regularizers=regularizers, **parts)


def clocks_around_functions(watch: Watch) -> list[tuple[Any, str, Any]]:
    """Return the functions of a step that belong to no component, with clocks around them."""
    import torch

    from cadam3d import trainer
    from cadam3d.core import rendering
    from cadam3d.optimizer import GaussianOptimizer

    # Older checkouts have functions that this one lacks, and lack some that it has.
    owners = {
        torch.Tensor: {"backward": "backward"},
        GaussianOptimizer: {
            "step": "optimizer",
            "finite_gradients": "optimizer",
            "extreme_gradients": "optimizer",
            "displace": "optimizer",
        },
        trainer.Trainer: {"_refine": "refinement", "_report": "callbacks", "_tell": "callbacks"},
        rendering: {"read_numbers": "readback"},
        trainer: {"read_numbers": "readback"},
    }
    return [
        (owner, name, watch(part, vars(owner)[name]))
        for owner, functions in owners.items()
        for name, part in functions.items()
        if name in vars(owner)
    ]


@contextmanager
def replaced(changes: list[tuple[Any, str, Any]]) -> Iterator[None]:
    """Set attributes, given as owner, name and value, and restore them afterwards."""
    before = [(owner, name, getattr(owner, name)) for owner, name, _ in changes]
    for owner, name, value in changes:
        setattr(owner, name, value)
    try:
        yield
    finally:
        for owner, name, value in before:
            setattr(owner, name, value)
