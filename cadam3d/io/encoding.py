"""Encodings that several file formats share: activated opacities and scales, unit quaternions and bytes.

PLY stores the raw numbers of the optimizer. Other formats store opacities in [0, 1], linear scales and unit
quaternions, often in one byte each. Every function accepts all finite float32 numbers, however large, and
returns finite ones.
"""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, Integer, UInt8
from torch import Tensor

from cadam3d.core.gaussians import Gaussians
from cadam3d.io.frames import world_to_file

SMALLEST = float(np.finfo(np.float32).tiny)
LARGEST = float(np.finfo(np.float32).max)
# The second largest component of a unit quaternion is at most this.
LARGEST_OF_SMALLEST = 0.5**0.5


def to_bytes(values: Float[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape"]:
    """Return numbers rounded to the nearest byte; those outside of [0, 255] become 0 or 255."""
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def opacities(gaussians: Gaussians) -> Float[np.ndarray, "n"]:
    """Return the opacities in [0, 1], as float64."""
    return gaussians.opacity_logits.double().sigmoid().numpy()


def byte_logits(values: UInt8[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """Return the logits of opacities that are stored as bytes, ``opacity * 255``, as float32.

    The bytes 0 and 255 stand for half an interval each, [0, 0.5] and [254.5, 255]. They are read as its
    middle, because the logits of 0 and 1 are infinite. Images do not show the difference: opacities below
    1/255 are skipped, and those above 0.99 are capped.
    """
    shares = np.clip(values.astype(np.float64), 0.25, 254.75) / 255
    return np.log(shares / (1 - shares)).astype(np.float32)


def linear_scales(gaussians: Gaussians) -> Float[np.ndarray, "n 3"]:
    """Return standard deviations as positive normal float32 numbers, in world units."""
    scales = gaussians.log_scales.double().clamp(max=100).exp()
    return scales.clamp(SMALLEST, LARGEST).float().numpy()


def scale_logarithms(scales: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Return the natural logarithms of standard deviations >= 0, as float32; 0 counts as the smallest one."""
    return np.log(np.maximum(scales.astype(np.float64), SMALLEST)).astype(np.float32)


def unit_quats(gaussians: Gaussians) -> Float[np.ndarray, "n 4"]:
    """Return the quaternions (w, x, y, z) with length 1, as float64; (0, 0, 0, 0) becomes (1, 0, 0, 0)."""
    quats = gaussians.quats.double().numpy()
    lengths = np.linalg.norm(quats, axis=1, keepdims=True)
    return np.where(lengths > 0, quats / np.where(lengths > 0, lengths, 1), [1.0, 0.0, 0.0, 0.0])


def smallest_three(
    quats: Float[np.ndarray, "n 4"],
) -> tuple[Integer[np.ndarray, "n"], Float[np.ndarray, "n 3"]]:
    """Return the index of the largest component of unit quaternions, and the other three components.

    The largest component is made positive, because both signs of a quaternion are the same rotation.
    """
    largest = np.abs(quats).argmax(axis=1)
    quats = quats * np.where(np.take_along_axis(quats, largest[:, None], axis=1) < 0, -1, 1)
    return largest, quats[np.arange(4) != largest[:, None]].reshape(len(quats), 3)


def with_largest(
    others: Float[np.ndarray, "n 3"], largest: Integer[np.ndarray, "n"]
) -> Float[np.ndarray, "n 4"]:
    """Return unit quaternions from three components and the index of the fourth, which is positive."""
    is_largest = np.arange(4) == largest[:, None]
    quats = np.empty((len(others), 4))
    quats[~is_largest] = others.reshape(-1)
    quats[is_largest] = np.sqrt(np.maximum(1 - (others**2).sum(axis=1), 0))
    return quats


def is_finite(gaussians: Gaussians) -> bool:
    """Return whether no number is NaN or infinite."""
    return all(bool(tensor.isfinite().all()) for tensor in gaussians.tensors().values())


def in_file_axes(gaussians: Gaussians, up: str) -> Gaussians:
    """Return the Gaussians as they are written: float32, on the CPU, with the up axis ``up``.

    Turning mixes SH coefficients, so the largest ones might become infinite; they are clamped. A coefficient
    that is infinite before stays so.
    """
    world = gaussians.detach().to("cpu").to(torch.float32)
    local = world_to_file(world, up)
    is_finite = world.sh.isfinite().all(dim=1, keepdim=True)
    return replace(local, sh=torch.where(is_finite, local.sh.clamp(-LARGEST, LARGEST), local.sh))


def as_tensor(values: Float[np.ndarray, "*shape"]) -> Tensor:
    """Return a copy of an array as a float32 tensor."""
    return torch.from_numpy(np.array(values, dtype=np.float32))
