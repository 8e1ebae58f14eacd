"""Tracing: which ray tracer renders a scene.

The tracers find the same hits and the same light. The one in torch works in every dtype, on every device and
without a compiler. The native one is many times faster, but it needs a compiler, float32 and a CPU.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from typing import Annotated

import torch

from cadam3d.core.cameras import Cameras
from cadam3d.core.checks import one_of
from cadam3d.core.errors import UserError
from cadam3d.prior.shapes.native_tracer import load_tracer, trace_natively
from cadam3d.prior.shapes.scene import Scene
from cadam3d.prior.shapes.tracer import Layers, trace

TRACERS = ("auto", "native", "torch")
TracerName = Annotated[str, one_of(TRACERS)]


@dataclass(frozen=True)
class Tracer:
    """A ray tracer."""

    identity: str  # differs if the last bits of the images may differ; "torch" if it is not native
    trace: Callable[[Scene, Cameras, int], Layers]


@cache
def find_tracer(setting: str, key: str = "prior.tracer") -> Tracer:
    """Return the tracer for float32 on the CPU that a setting of :data:`TRACERS` chooses.

    The first call may compile the native tracer. Raises ``UserError``, which names ``key``, if the setting
    is ``native`` and this machine cannot compile it.
    """
    if setting != "torch":
        try:
            built, library = load_tracer(key)
            return Tracer(built.stem, partial(trace_natively, library))
        except UserError:
            if setting == "native":
                raise
    return Tracer("torch", trace)


def tracer_for(setting: str, cameras: Cameras) -> Tracer:
    """Return the tracer for the device and the dtype of the cameras."""
    like = cameras.intrinsics
    is_native = like.device.type == "cpu" and like.dtype == torch.float32
    return find_tracer(setting if is_native else "torch")
