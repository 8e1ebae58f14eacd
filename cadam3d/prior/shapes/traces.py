"""Traced views that several runs share: the jobs of a sweep look at the same scene from the same places.

Tracing is most of a step of ``prior=shapes``. A folder, named by an environment variable, keeps what was
traced, and whoever needs the same views of the same scene reads them instead, to the bit what it would have
traced.
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
from cadam3d.prior.shapes import solids, tracer
from cadam3d.prior.shapes.scene import Scene
from cadam3d.prior.shapes.tracer import Layers, trace

SPARE = 2 * 1024**3  # bytes of the disk that are left to others
# A folder may outlive the code that filled it.
CODE = b"".join(Path(str(module.__file__)).read_bytes() for module in (tracer, solids))


def shared_trace(scene: Scene, cameras: Cameras, samples: int) -> Layers:
    """:func:`~cadam3d.prior.shapes.tracer.trace`, or what another run kept of it."""
    folder = os.environ.get(TRACES)
    if not folder or cameras.intrinsics.dtype != torch.float32:
        return trace(scene, cameras, samples)
    path = Path(folder) / f"{_identity(scene, cameras, samples)}.npy"
    layers = _read(path, scene, cameras)
    if layers is None:
        layers = trace(scene, cameras, samples)
        _keep(path, layers)
    return layers


def _identity(scene: Scene, cameras: Cameras, samples: int) -> str:
    """A name for all that a trace depends on; colours come later."""
    digest = hashlib.sha256(CODE)
    kinds = [(kind.name, count) for kind, count in scene.kinds]
    digest.update(repr((kinds, scene.albedo.shape[1], cameras.height, cameras.width, samples)).encode())
    rows = (scene.to_local, scene.offsets, scene.sizes, scene.low, scene.high, scene.centres, scene.radii)
    for tensor in (*rows, scene.patterns, scene.paints, cameras.world_to_camera, cameras.intrinsics):
        digest.update(tensor.cpu().contiguous().numpy().tobytes())
    return f"{cameras.intrinsics.device.type}-{digest.hexdigest()}"


def _keep(path: Path, layers: Layers) -> None:
    """Write a trace, whole or not at all; if the disk is full or closed, the next one traces again."""
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
    """Counts, places and values of what is not zero, as 32-bit words: most of a view is empty."""
    places, values = [], []
    for tensor in (layers.alpha, layers.paints):
        flat = tensor.flatten().cpu()
        places.append(flat.nonzero()[:, 0].int())
        values.append(flat[places[-1]].view(torch.int32))
    counts = torch.tensor([len(each) for each in places], dtype=torch.int32)
    return torch.cat([counts, *places, *values]).numpy()


def _read(path: Path, scene: Scene, cameras: Cameras) -> Layers | None:
    """What :func:`_keep` wrote; None if that is not there or not whole."""
    try:
        words = torch.from_numpy(np.load(path, allow_pickle=False))
    except (OSError, ValueError, EOFError):
        return None
    sizes = words[:2].tolist()
    alpha_at, paints_at, alpha, paints = words[2:].split([*sizes, *sizes])
    shape = (len(cameras), cameras.height, cameras.width)
    return Layers(
        alpha=_unpacked(shape, alpha_at, alpha).to(cameras.intrinsics.device),
        paints=_unpacked((*shape, scene.albedo.shape[1]), paints_at, paints).to(cameras.intrinsics.device),
    )


def _unpacked(shape: tuple[int, ...], places: Tensor, values: Tensor) -> Tensor:
    return torch.zeros(shape).view(-1).index_put_((places.long(),), values.view(torch.float32)).view(shape)
