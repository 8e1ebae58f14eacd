"""Gaussians, pictures and an independent program (gaussforge) for the tests of file formats."""

import math
from functools import cache
from io import BytesIO

import numpy as np
import pytest
import torch
from programs.snowman import snowman_and_pine

from cadam3d.core.cameras import orbit
from cadam3d.core.gaussians import Gaussians
from cadam3d.rasterizer.cpu import CpuRasterizer

ENOUGH_DB = 38.0  # for lossy formats
WRONG_DB = 20.0  # a turned object is far below


def random_gaussians(n: int = 50, degree: int = 0, seed: int = 0) -> Gaussians:
    """Return Gaussians with ordinary numbers: every format holds them without clamping anything."""
    draw = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=draw)

    sh = (0.2 * normal(n, (degree + 1) ** 2, 3)).clamp(-0.99, 0.98)
    return Gaussians(normal(n, 3), 0.5 * normal(n, 3) - 3, normal(n, 4), normal(n), sh)


def extreme_gaussians(degree: int) -> Gaussians:
    """Return finite Gaussians with the largest and smallest float32 numbers, at different positions."""
    huge, tiny = 3e38, 1e-45
    values = torch.tensor([0.0, -0.0, 1.0, -1.0, 1e3, -1e3, huge, -huge, tiny, -tiny])
    n = len(values)
    return Gaussians(
        means=torch.arange(3 * n).reshape(n, 3) / 100,
        log_scales=values[:, None].repeat(1, 3),
        quats=values[:, None] * torch.tensor([0.0, 1.0, 0.5, -0.5]),
        opacity_logits=values.clone(),
        sh=values[:, None, None].repeat(1, (degree + 1) ** 2, 3),
    )


def matched(back: Gaussians, original: Gaussians) -> Gaussians:
    """Return ``back`` in the order of ``original``: formats may sort their rows, but positions stay."""
    nearest = torch.cdist(original.means, back.means).argmin(dim=1)
    assert len(nearest.unique()) == len(original) == len(back)
    return back.index(nearest)


def errors(back: Gaussians, original: Gaussians) -> dict[str, float]:
    """Return the largest errors: of SH degree 0 and of the others, and the angle of a turn, among others."""

    def largest(a, b):
        return float((a - b).abs().max()) if a.numel() else 0.0

    turns = back.to(torch.float64).rotations.mT @ original.to(torch.float64).rotations
    cosines = (turns.diagonal(dim1=1, dim2=2).sum(dim=1) - 1) / 2
    return {
        "means": largest(back.means, original.means),
        "log_scales": largest(back.log_scales, original.log_scales),
        "opacities": largest(back.opacities, original.opacities),
        "sh0": largest(back.sh[:, 0], original.sh[:, 0]),
        "sh": largest(back.sh[:, 1:], original.sh[:, 1:]),
        "angle_deg": math.degrees(float(cosines.clamp(-1, 1).acos().max())),
    }


def is_finite(gaussians: Gaussians) -> bool:
    """Return whether all numbers are finite."""
    return all(bool(tensor.isfinite().all()) for tensor in gaussians.tensors().values())


@cache
def asset(degree: int = 0) -> Gaussians:
    """Return an object without any symmetry."""
    return snowman_and_pine(degree)


@cache
def _picture_of_asset(degree: int) -> torch.Tensor:
    return picture(asset(degree))


def picture(gaussians: Gaussians) -> torch.Tensor:
    """Return renders from three sides [3 h w 3]."""
    size = 160
    sides = torch.tensor([[20.0, 140.0, 260.0], [15.0, 30.0, -10.0]])
    cameras = orbit(*sides, torch.full((3,), 2.6), torch.full((3,), 45.0), size, size)
    with torch.no_grad():
        return CpuRasterizer(cache_dir=None).render(gaussians, cameras, torch.ones(3, 3)).rgb


def likeness_db(back: Gaussians, degree: int = 0) -> float:
    """Return the PSNR between pictures of ``back`` and of ``asset(degree)``."""
    return float(-10 * (picture(back) - _picture_of_asset(degree)).square().mean().log10())


def gaussforge_writes(gaussians: Gaussians, kind: str, spz_version: int = 3) -> bytes:
    """Return a file that gaussforge writes from these numbers, without a change of axes."""
    cloud = {
        "numPoints": len(gaussians),
        "positions": _bytes(gaussians.means),
        "scales": _bytes(gaussians.log_scales),
        "rotations": _bytes(torch.nn.functional.normalize(gaussians.quats, dim=1)),
        "alphas": _bytes(gaussians.opacity_logits),
        "colors": _bytes(gaussians.sh[:, 0]),
        "sh": _bytes(gaussians.sh[:, 1:]),
        "extras": {},
        "meta": {"shDegree": gaussians.sh_degree, "sourceFormat": "ply"},
    }
    result = pytest.importorskip("gaussforge").GaussForge().write(cloud, kind, spz_version=spz_version)
    assert "error" not in result, result
    return result["data"]


def gaussforge_reads(data: bytes, kind: str) -> Gaussians:
    """Return the numbers that gaussforge finds in a file; infinite logits become large ones."""
    result = pytest.importorskip("gaussforge").GaussForge().convert(data, kind, "ply")
    assert "error" not in result, result
    from plyfile import PlyData

    rows = PlyData.read(BytesIO(result["data"]))["vertex"]

    def columns(*names):
        found = [np.asarray(rows[name], dtype=np.float32) for name in names]
        found = np.stack(found, axis=1) if found else np.zeros((len(rows.data), 0), np.float32)
        return torch.from_numpy(np.clip(found, -1e30, 1e30))

    rest = sorted((p.name for p in rows.properties if p.name.startswith("f_rest_")), key=lambda n: int(n[7:]))
    bands = columns(*rest).reshape(len(rows.data), 3, -1).mT
    return Gaussians(
        means=columns("x", "y", "z"),
        log_scales=columns("scale_0", "scale_1", "scale_2"),
        quats=columns("rot_0", "rot_1", "rot_2", "rot_3"),
        opacity_logits=columns("opacity")[:, 0].clone(),
        sh=torch.cat([columns("f_dc_0", "f_dc_1", "f_dc_2")[:, None], bands], dim=1).contiguous(),
    )


def _bytes(tensor: torch.Tensor) -> bytes:
    return tensor.contiguous().numpy().astype("<f4").tobytes()
