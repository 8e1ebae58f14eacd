"""An independent reader of snapshots, and objects to pack."""

import struct
from dataclasses import dataclass

import numpy as np
import torch

from cadam3d.core.gaussians import Gaussians
from cadam3d.core.rotation import rotation_matrices


def some_gaussians(n: int, *, degree: int = 0, seed: int = 0) -> Gaussians:
    """Return an object without any symmetry: a bent row of coloured Gaussians of all shapes."""
    draw = torch.Generator().manual_seed(seed)
    t = torch.linspace(0, 1, n)
    path = torch.stack([0.7 * t - 0.2, 0.6 * (3 * t).sin() - 0.2, 0.9 * t**2 - 0.3], dim=-1)
    colors = torch.stack([t, 1 - t, 0.5 + 0.5 * (7 * t).sin()], dim=-1)
    rest = 0.25 * torch.randn(n, (degree + 1) ** 2 - 1, 3, generator=draw)
    return Gaussians(
        means=path + 0.08 * torch.randn(n, 3, generator=draw),
        log_scales=-3.2 + 0.6 * torch.randn(n, 3, generator=draw),
        quats=torch.randn(n, 4, generator=draw),
        opacity_logits=1.0 + 2 * torch.randn(n, generator=draw),
        sh=torch.cat([(colors[:, None] - 0.5) / 0.28209479177387814, rest], dim=1),
    )


@dataclass
class Snapshot:
    count: int
    degree: int
    low: np.ndarray
    high: np.ndarray
    focus: np.ndarray
    radius: float
    means: np.ndarray
    log_scales: np.ndarray
    rotations: np.ndarray
    opacities: np.ndarray
    colors: np.ndarray
    rest: np.ndarray  # n x (k - 1) x 3
    layers: dict[str, tuple[float, float, bool, np.ndarray]]


def read_snapshot(data: bytes) -> Snapshot:
    """Read a snapshot by the table in ``pack.py``, one Gaussian at a time."""
    magic, version, count, degree, layer_count, *bounds = struct.unpack_from("<8s4I10f", data)
    assert (magic, version) == (b"CADAM3DV", 1)
    offset, names = 64, []
    for _ in range(layer_count):
        low, high, is_log, length = struct.unpack_from("<ffII", data, offset)
        names.append((data[offset + 16 : offset + 16 + length].decode(), low, high, bool(is_log)))
        offset += 16 + length + -length % 4
    offset += -offset % 16
    rows = [struct.unpack_from("<3f2H3HH3eH", data, offset + 32 * i) for i in range(count)]
    offset += 32 * count
    table = np.array(rows, dtype=np.float64).reshape(count, 13)
    rest = np.zeros((count, (degree + 1) ** 2 - 1, 3))
    for i in range(count if degree else 0):
        block = data[offset + 16 * degree * i : offset + 16 * degree * (i + 1)]
        values = np.frombuffer(block, dtype=np.int8)[: rest[i].size].reshape(rest[i].shape)
        rest[i] = values / 127 * np.frombuffer(block[-2:], dtype="<f2")[0]
    offset += 16 * degree * count
    layers = {}
    for name, low, high, is_log in names:
        layers[name] = (low, high, is_log, np.frombuffer(data, np.uint8, count, offset))
        offset += count + -count % 16
    assert offset == len(data)
    quats = [quaternion(*(int(row[i]) for i in (3, 4, 12))) for row in table]
    return Snapshot(
        count=count,
        degree=degree,
        low=np.array(bounds[:3]),
        high=np.array(bounds[3:6]),
        focus=np.array(bounds[6:9]),
        radius=bounds[9],
        means=table[:, :3],
        log_scales=table[:, 5:8] * 32 / 65535 - 16,
        rotations=rotation_matrices(torch.tensor(quats, dtype=torch.float64).reshape(count, 4)).numpy(),
        opacities=table[:, 8] / 65535,
        colors=table[:, 9:12],
        rest=rest,
        layers=layers,
    )


def quaternion(a: int, b: int, c: int) -> list[float]:
    three = [((value & 0x7FFF) - 16383) / (16383 * 2**0.5) for value in (a, b, c)]
    position = (a >> 15) + 2 * (b >> 15)
    three.insert(position, max(1 - sum(value**2 for value in three), 0) ** 0.5)
    return three
