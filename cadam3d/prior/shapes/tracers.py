"""The choice between the ray tracers: the native one, or the one in torch.

They find the same hits and the same light. The one in torch works in every dtype, on every device and without
a compiler. The native one is many times faster, but it needs a compiler, float32 and a CPU.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial

import torch

from cadam3d.core.cameras import Cameras
from cadam3d.core.errors import UserError
from cadam3d.prior.shapes.native_tracer import load_tracer, trace_natively
from cadam3d.prior.shapes.scene import Scene
from cadam3d.prior.shapes.tracer import Layers, trace

TRACERS = ("auto", "native", "torch")


@dataclass(frozen=True)
class Tracer:
    """A ray tracer, and why it is not the native one."""

    name: str  # "native" or "torch"
    identity: str  # differs if the last bits of the images may differ
    trace: Callable[[Scene, Cameras, int], Layers]
    reason: str | None = None  # why the native one cannot be compiled, if auto tried it


@cache
def find_tracer(setting: str, key: str = "prior.tracer") -> Tracer:
    """Return the tracer for float32 on the CPU that a setting of :data:`TRACERS` chooses.

    The first call may compile the native tracer. Raises ``UserError``, which names ``key``, if the setting
    is ``native`` and this machine cannot compile it.
    """
    if setting == "torch":
        return Tracer("torch", "torch", trace)
    try:
        built, library = load_tracer(key)
    except UserError as error:
        if setting == "native":
            raise
        return Tracer("torch", "torch", trace, reason=str(error))
    return Tracer("native", built.path.stem, partial(trace_natively, library))


def tracer_for(setting: str, cameras: Cameras) -> Tracer:
    """Return the tracer for the device and the dtype of the cameras."""
    like = cameras.intrinsics
    is_native = like.device.type == "cpu" and like.dtype == torch.float32
    return find_tracer(setting if is_native else "torch")
