"""A cache of traced views for runs that trace the same views of the same scene, such as the jobs of a sweep.

Tracing takes most of the time of a step with ``prior=shapes``. If an environment variable names a folder,
traced views are stored in it, and other runs read them instead of tracing. The numbers are bit-identical, and
each tracer has its own files.
"""

import hashlib
import os
import shutil
from contextlib import suppress
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from cadam3d.core.cameras import Cameras
from cadam3d.io.cache import TRACES
from cadam3d.prior.shapes import native_tracer, solids, tracer
from cadam3d.prior.shapes.scene import Scene
from cadam3d.prior.shapes.tracer import Layers
from cadam3d.prior.shapes.tracers import tracer_for

# Space of the disk that stays free.
SPARE = 2 * 1024**3  # bytes
# Part of the identity of a trace, since a folder may outlive the code that wrote it.
CODE = b"".join(Path(str(module.__file__)).read_bytes() for module in (tracer, native_tracer, solids))


def shared_trace(scene: Scene, cameras: Cameras, samples: int, setting: str = "auto") -> Layers:
    """Return the result of :func:`~cadam3d.prior.shapes.tracer.trace`, from the cache if it is there.

    ``setting`` chooses the tracer (``tracers.py``).
    """
    chosen = tracer_for(setting, cameras)
    folder = os.environ.get(TRACES)
    if not folder or cameras.intrinsics.dtype != torch.float32:
        return chosen.trace(scene, cameras, samples)
    path = Path(folder) / f"{_identity(scene, cameras, samples, chosen.identity)}.npy"
    layers = _read(path, scene, cameras)
    if layers is None:
        layers = chosen.trace(scene, cameras, samples)
        _store(path, layers)
    return layers


def _identity(scene: Scene, cameras: Cameras, samples: int, of_tracer: str) -> str:
    """Return a name that identifies everything a trace depends on; it does not depend on colours."""
    digest = hashlib.sha256(CODE)
    digest.update(of_tracer.encode())
    kinds = [(kind.name, count) for kind, count in scene.kinds]
    digest.update(repr((kinds, scene.albedo.shape[1], cameras.height, cameras.width, samples)).encode())
    rows = (scene.to_local, scene.offsets, scene.sizes, scene.low, scene.high, scene.centres, scene.radii)
    for tensor in (*rows, scene.patterns, scene.paints, cameras.world_to_camera, cameras.intrinsics):
        digest.update(tensor.cpu().contiguous().numpy().tobytes())
    return f"{cameras.intrinsics.device.type}-{digest.hexdigest()}"


def _store(path: Path, layers: Layers) -> None:
    """Write a trace completely or not at all. If the disk is full or read-only, nothing is stored."""
    temporary = path.with_name(f".{os.getpid()}-{path.name}")
    with suppress(OSError):
        path.parent.mkdir(exist_ok=True)
        if shutil.disk_usage(path.parent).free < SPARE:
            return
        try:
            np.save(temporary, _packed(layers))
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)


def _packed(layers: Layers) -> np.ndarray:
    """Return counts, positions and values of the nonzero numbers as 32-bit words; most of a view is empty."""
    places, values = [], []
    for tensor in (layers.alpha, layers.paints):
        flat = tensor.flatten().cpu()
        places.append(flat.nonzero()[:, 0].int())
        values.append(flat[places[-1]].view(torch.int32))
    counts = torch.tensor([len(each) for each in places], dtype=torch.int32)
    return torch.cat([counts, *places, *values]).numpy()


def _read(path: Path, scene: Scene, cameras: Cameras) -> Layers | None:
    """Read a trace that :func:`_store` wrote; None if the file is missing or damaged."""
    shape = (len(cameras), cameras.height, cameras.width)
    # A damaged file fails when it is read, when it is split, or when its numbers are put in their places.
    try:
        words = torch.from_numpy(np.load(path, allow_pickle=False))
        sizes = words[:2].tolist()
        alpha_at, paints_at, alpha, paints = words[2:].split([*sizes, *sizes])
        alpha = _unpacked(shape, alpha_at, alpha)
        paints = _unpacked((*shape, scene.albedo.shape[1]), paints_at, paints)
        device = cameras.intrinsics.device
        return Layers(alpha=alpha.to(device), paints=paints.to(device))
    except (OSError, ValueError, EOFError, RuntimeError, LookupError, TypeError, MemoryError):
        return None


def _unpacked(shape: tuple[int, ...], places: Tensor, values: Tensor) -> Tensor:
    return torch.zeros(shape).view(-1).index_put_((places.long(),), values.view(torch.float32)).view(shape)
