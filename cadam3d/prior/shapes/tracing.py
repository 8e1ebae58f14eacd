"""Tracing: which ray tracer renders a scene, and files that keep what takes long to render.

The tracers find the same hits and the same light. The one in torch works in every dtype, on every device and
without a compiler. The native one is many times faster, but it needs a compiler, float32 and a CPU.
"""

import hashlib
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import torch
from torch import Tensor

from cadam3d.core.cameras import Cameras
from cadam3d.core.errors import UserError
from cadam3d.io.atomic import replacing
from cadam3d.io.cache import default_cache_dir
from cadam3d.prior.shapes.native_tracer import load_tracer, trace_natively
from cadam3d.prior.shapes.scene import Scene
from cadam3d.prior.shapes.tracer import Layers, trace

TRACERS = ("auto", "native", "torch")
PACKAGE = Path(__file__).parents[2]


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


def stored_arrays(name: str, make: Callable[[], dict[str, Tensor]]) -> dict[str, Tensor]:
    """Return the result of ``make``, which takes long, from the user's cache folder if it is there.

    A file belongs to one state of the sources, one version of torch, one instruction set and one number of
    threads, because all of these may change the last bits.
    """
    facts = (torch.__version__, torch.backends.cpu.get_cpu_capability(), torch.get_num_threads())
    digest = hashlib.sha256(_code() + repr(facts).encode()).hexdigest()
    path = default_cache_dir() / "shapes" / f"{name}-{digest[:32]}.pt"
    try:
        return torch.load(path, weights_only=True)
    # The file is missing, or it is damaged, which makes its reader raise almost anything.
    except Exception:
        made = make()
    # A cache that cannot be written only costs time.
    with suppress(UserError, OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as temporary:
            torch.save(made, temporary)
    return made


@cache
def _code() -> bytes:
    paths = sorted([*PACKAGE.glob("core/*.py"), *PACKAGE.glob("prior/shapes/*.py")])
    return hashlib.sha256(b"".join(path.read_bytes() for path in paths)).digest()
