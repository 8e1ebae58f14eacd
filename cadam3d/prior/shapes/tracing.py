"""Tracing: which ray tracer renders a scene, and files that keep what was rendered before.

The tracers find the same hits and the same light. The one in torch works in every dtype, on every device and
without a compiler. The native one is many times faster, but it needs a compiler, float32 and a CPU.

Tracing takes most of the time of a step with ``prior=shapes``. If an environment variable names a folder,
traced views are stored in it, and runs that need the same views, such as the jobs of a sweep, read them. The
numbers are bit-identical, and each tracer has its own files.
"""

import hashlib
import os
import shutil
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import torch
from torch import Tensor

from cadam3d.core.cameras import Cameras
from cadam3d.core.errors import UserError
from cadam3d.io.atomic import replacing
from cadam3d.io.cache import TRACES, default_cache_dir
from cadam3d.prior.shapes.native_tracer import load_tracer, trace_natively
from cadam3d.prior.shapes.scene import Scene
from cadam3d.prior.shapes.tracer import Layers, trace

TRACERS = ("auto", "native", "torch")
PACKAGE = Path(__file__).parents[2]
# Space of the disk that stays free.
SPARE = 2 * 1024**3  # bytes


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


def shared_trace(scene: Scene, cameras: Cameras, samples: int, setting: str = "auto") -> Layers:
    """Return the result of :func:`~cadam3d.prior.shapes.tracer.trace`, from a file if there is one.

    ``setting`` is one of :data:`TRACERS`.
    """
    chosen, like = tracer_for(setting, cameras), cameras.intrinsics
    folder = os.environ.get(TRACES)
    if not folder or like.dtype != torch.float32:
        return chosen.trace(scene, cameras, samples)
    kinds = [(kind.name, count) for kind, count in scene.kinds]
    facts = (chosen.identity, kinds, cameras.height, cameras.width, samples, scene.albedo.shape[1])
    # All tensors of a scene except its colours and their shares.
    rows = (scene.to_local, scene.offsets, scene.sizes, scene.low, scene.high, scene.centres, scene.radii)
    tensors = (*rows, scene.patterns, scene.paints, cameras.world_to_camera, like)
    path = Path(folder) / f"{like.device.type}-{_digest(facts, tensors)}.pt"
    if found := _read(path):
        # Most of a view is empty, so only the other numbers are stored.
        shape = (len(cameras), cameras.height, cameras.width)
        alpha, paints = (found[name].to(like.device).to_dense() for name in ("alpha", "paints"))
        return Layers(alpha=alpha.view(shape), paints=paints.view(*shape, -1))
    layers = chosen.trace(scene, cameras, samples)
    _write(path, {name: each.cpu().flatten().to_sparse() for name, each in vars(layers).items()})
    return layers


def stored_arrays(name: str, make: Callable[[], dict[str, Tensor]]) -> dict[str, Tensor]:
    """Return the result of ``make``, which takes long, from the user's cache folder if it is there.

    A file belongs to one state of the sources, one version of torch, one instruction set and one number of
    threads, because all of these may change the last bits.
    """
    facts = (torch.__version__, torch.backends.cpu.get_cpu_capability(), torch.get_num_threads())
    path = default_cache_dir() / "shapes" / f"{name}-{_digest(facts, ())}.pt"
    made = _read(path)
    if made is None:
        made = make()
        _write(path, made)
    return made


def _digest(facts: object, tensors: Iterable[Tensor]) -> str:
    """Return a name that changes with the facts, the numbers, and the code that files depend on."""
    digest = hashlib.sha256(_code() + repr(facts).encode())
    for tensor in tensors:
        digest.update(tensor.cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()[:32]


@cache
def _code() -> bytes:
    paths = sorted([*PACKAGE.glob("core/*.py"), *PACKAGE.glob("prior/shapes/*.py")])
    return hashlib.sha256(b"".join(path.read_bytes() for path in paths)).digest()


def _read(path: Path) -> dict[str, Tensor] | None:
    """Return the tensors of a file; None if the file is missing or damaged."""
    try:
        return torch.load(path, weights_only=True)
    # A damaged file makes its reader raise almost anything.
    except Exception:
        return None


def _write(path: Path, tensors: dict[str, Tensor]) -> None:
    """Write tensors completely or not at all. If the disk is nearly full or read-only, nothing is stored."""
    with suppress(UserError, OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        if shutil.disk_usage(path.parent).free > SPARE:
            with replacing(path) as temporary:
                torch.save(tensors, temporary)
