"""Pack Gaussians into the binary snapshot that ``splat_view.js`` draws. Everything is little endian.

A snapshot consists of five parts, each of which begins at a multiple of 16 bytes and is padded with zeros.

1. The header, 64 bytes:

   ====== ======= ==============================================================================
   offset type    content
   ====== ======= ==============================================================================
   0      8 bytes ``CADAM3DV``
   8      uint32  version of the format, 1
   12     uint32  number of Gaussians n
   16     uint32  SH degree, 0 to 3
   20     uint32  number of layers
   24     3 float smallest x, y, z of the visible centres, in world units; 0 without any
   36     3 float largest x, y, z of the visible centres
   48     3 float x, y, z of the point that a camera should look at
   60     float   radius > 0 of the ball around this point that a camera should show
   ====== ======= ==============================================================================

2. The names of the layers. Each has two floats (the values at the low and the high end of the colours), a
   uint32 (1 if the colours are on a logarithmic axis, else 0), a uint32 (length of the name) and the name in
   UTF-8, padded with zeros to a multiple of 4 bytes.
3. The Gaussians, 32 bytes each, which is two texels of four uint32:

   ====== ======== =============================================================================
   offset type     content
   ====== ======== =============================================================================
   0      3 float  mean, world units
   12     2 uint16 rotation a, b
   16     3 uint16 log scales s, as ``round((s + 16) * 65535 / 32)``: -16 to 16
   22     uint16   opacity in [0, 1], as ``round(65535 * opacity)``
   24     3 half   ``0.5 + Y_0 sh_0``, the colour of the coefficients of degree 0
   30     uint16   rotation c
   ====== ======== =============================================================================

   The rotation is a unit quaternion w, x, y, z without its largest component, which is made positive. The
   lower 15 bits of a, b, c hold the other three in order, as ``round(16383 sqrt(2) q) + 16383``. The highest
   bits of a and b hold the lower and the higher bit of the position of the largest component.
4. If the SH degree is 1, 2 or 3: the other coefficients, 16, 32 or 48 bytes for each Gaussian. The byte
   ``3 (k - 1) + channel`` is an int8 q, and the coefficient k is ``q / 127`` times the largest absolute value
   of the Gaussian, which is a half in the last two bytes.
5. The layers, n bytes each: 0 where there is no value, else 1 to 255 from the low to the high end.

Gaussians that no rasterizer shows (not finite, farther than ``FAR`` from the origin, or without a rotation)
have the opacity 0 and the mean 0.
"""

import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8, UInt16
from torch import Tensor

from cadam3d.core.gaussians import Gaussians
from cadam3d.core.sh import SH_C0

MAGIC = b"CADAM3DV"
VERSION = 1
LOG_SCALE_LIMIT = 16.0
HALF_MAX = 65504.0  # the largest finite half
# Farther Gaussians are culled in every view, as in the rasterizers.
FAR = 1e15  # world units
# A quaternion of a smaller squared length has no direction, as in the rasterizers.
QUAT_SQUARE_MIN = 1e-12
# Every picture has these layers without any data of their own.
BUILT_IN_LAYERS = ("rgb", "depth", "opacity")
# The positions of the three components beside the largest one.
OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
# A layer of values >= 0 has a logarithmic axis if its large values exceed its small ones by this factor.
LOG_FACTOR = 100.0


def pack(gaussians: Gaussians, layers: Mapping[str, Float[Tensor, "n"]] | None = None) -> bytes:
    """Return the snapshot of ``gaussians`` and of one number per Gaussian for each layer.

    The same input gives the same bytes. A value NaN in a layer means "no value". The ends of the colours of a
    layer are its quantiles 0.01 and 0.99, so that a few extreme values do not hide all differences.
    """
    layers = layers or {}
    assert not set(layers) & set(BUILT_IN_LAYERS), f"{BUILT_IN_LAYERS} exist without data"
    assert all(len(values) == len(gaussians) for values in layers.values()), "one value per Gaussian"
    tensors = gaussians.tensors()
    arrays = {name: tensor.detach().cpu().float().numpy() for name, tensor in tensors.items()}
    visible = _visible(arrays)
    means = np.where(visible[:, None], arrays["means"], np.float32(0))
    drawn = [_Layer.of(values.detach().cpu().numpy().astype(np.float64)) for values in layers.values()]
    parts = [
        _header(means[visible], len(visible), gaussians.sh_degree, len(layers)),
        b"".join(layer.entry(name) for name, layer in zip(layers, drawn, strict=True)),
        _records(arrays, means, visible).tobytes(),
        _rest(arrays["sh"], visible).tobytes(),
        *(layer.levels.tobytes() for layer in drawn),
    ]
    return b"".join(part + bytes(-len(part) % 16) for part in parts)


def _visible(arrays: Mapping[str, Float32[np.ndarray, "..."]]) -> Bool[np.ndarray, "n"]:
    n = len(arrays["means"])
    visible = np.ones(n, dtype=bool)
    for array in arrays.values():
        visible &= np.isfinite(array.reshape(n, math.prod(array.shape[1:]))).all(axis=1)
    with np.errstate(over="ignore", invalid="ignore"):
        visible &= (np.abs(arrays["means"]) < FAR).all(axis=1)
        visible &= np.square(arrays["quats"]).sum(axis=1) >= QUAT_SQUARE_MIN
    return visible


def _header(means: Float32[np.ndarray, "m 3"], count: int, degree: int, layers: int) -> bytes:
    low, high = (means.min(axis=0), means.max(axis=0)) if len(means) else (np.zeros(3), np.zeros(3))
    focus, radius = _focus(means.astype(np.float64))
    return struct.pack("<8s4I10f", MAGIC, VERSION, count, degree, layers, *low, *high, *focus, radius)


def _focus(means: Float[np.ndarray, "m 3"]) -> tuple[Float[np.ndarray, "3"], float]:
    """Return the centre and the radius of the ball that a camera should show.

    This is the unit ball if the object fits into it roughly, as our own objects do. For files in other units
    it is the ball around the median that contains 98 of 100 centres, and a margin.
    """
    if len(means) == 0:
        return np.zeros(3), 1.0
    center = np.median(means, axis=0)
    reach, radius = (
        float(np.quantile(np.linalg.norm(means - point, axis=1), 0.98)) for point in (np.zeros(3), center)
    )
    if reach < 1.25 and radius > 0.2:
        return np.zeros(3), 1.0
    return center, max(1.2 * radius, 1e-3)


def _records(
    arrays: Mapping[str, Float32[np.ndarray, "..."]],
    means: Float32[np.ndarray, "n 3"],
    visible: Bool[np.ndarray, "n"],
) -> UInt16[np.ndarray, "n 16"]:
    """Return the 32 bytes of each Gaussian."""
    with np.errstate(over="ignore", invalid="ignore"):
        opacities = np.where(visible, 1 / (1 + np.exp(-arrays["opacity_logits"])), 0)
        scales = np.where(visible[:, None], arrays["log_scales"], 0)
        colors = np.where(visible[:, None], 0.5 + SH_C0 * arrays["sh"][:, 0], 0)
    rotation = _rotation(
        np.where(visible[:, None], arrays["quats"], np.array([1, 0, 0, 0], dtype=np.float32))
    )
    steps = 65535 / (2 * LOG_SCALE_LIMIT)
    record = np.empty((len(means), 16), dtype="<u2")
    record[:, 0:6] = means.astype("<f4").view("<u2").reshape(-1, 6)
    record[:, 6:8] = rotation[:, :2]
    limited = np.clip(scales, -LOG_SCALE_LIMIT, LOG_SCALE_LIMIT)
    record[:, 8:11] = np.rint((limited + LOG_SCALE_LIMIT) * steps).astype(np.uint16)
    record[:, 11] = np.rint(65535 * opacities).astype(np.uint16)
    record[:, 12:15] = np.clip(colors, -HALF_MAX, HALF_MAX).astype("<f2").view("<u2")
    record[:, 15] = rotation[:, 2]
    return record


def _rotation(quats: Float32[np.ndarray, "n 4"]) -> UInt16[np.ndarray, "n 3"]:
    """Return the three numbers a, b, c that hold each rotation."""
    rows = np.arange(len(quats))
    largest = np.abs(quats).argmax(axis=1)
    # The largest component is divided by itself first, because squares might leave the range of float32.
    quats = quats / quats[rows, largest][:, None]
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    rest = np.take_along_axis(quats, OTHERS[largest], axis=1)
    packed = np.rint(16383 * np.sqrt(2) * rest).astype(np.int32) + 16383
    packed[:, 0] |= (largest & 1) << 15
    packed[:, 1] |= (largest >> 1) << 15
    return packed.astype(np.uint16)


def _rest(sh: Float32[np.ndarray, "n k 3"], visible: Bool[np.ndarray, "n"]) -> UInt8[np.ndarray, "n b"]:
    """Return the coefficients of degree 1 and above, 16 bytes per degree."""
    n, k, _ = sh.shape
    rest = np.where(visible[:, None], sh[:, 1:].reshape(n, 3 * (k - 1)), np.float32(0))
    block = np.zeros((n, 16 * (round(k**0.5) - 1)), dtype=np.uint8)
    if k == 1:
        return block
    largest = np.clip(np.abs(rest).max(axis=1), 0, HALF_MAX).astype("<f2")
    # The divisor is what the reader will multiply by. Where it is 0, all coefficients are nearly 0.
    divisor = np.where(largest > 0, largest, 1).astype(np.float32)[:, None]
    # A product that is too large for float32 is clipped like every coefficient above the largest half.
    with np.errstate(over="ignore"):
        levels = np.rint(np.clip(127 * rest / divisor, -127, 127)).astype(np.int8)
    block[:, : rest.shape[1]] = levels.view(np.uint8)
    block[:, -2:] = largest[:, None].view(np.uint8)
    return block


@dataclass(frozen=True)
class _Layer:
    """One number per Gaussian as 255 levels between two ends."""

    low: float
    high: float
    is_log: bool
    levels: UInt8[np.ndarray, "n"]  # 0 = no value

    @staticmethod
    def of(values: Float[np.ndarray, "n"]) -> "_Layer":
        """Return the layer of ``values``, which may be NaN or infinite."""
        finite = values[np.isfinite(values)]
        low, high, is_log = _ends(finite)
        clipped = np.clip(values, low, high)
        if is_log:
            shares = (np.log(clipped) - np.log(low)) / (np.log(high) - np.log(low))
        else:
            shares = (clipped - low) / (high - low if high > low else 1.0)
        levels = np.where(np.isnan(values), 0, 1 + np.rint(254 * np.nan_to_num(shares)))
        return _Layer(low, high, is_log, levels.astype(np.uint8))

    def entry(self, name: str) -> bytes:
        """Return the bytes that describe this layer in the table of names."""
        text = name.encode()
        head = struct.pack("<ffII", self.low, self.high, self.is_log, len(text))
        return head + text + bytes(-len(text) % 4)


def _ends(finite: Float[np.ndarray, "m"]) -> tuple[float, float, bool]:
    """Return the values at both ends of the colours, and whether the axis is logarithmic."""
    limit = float(np.finfo(np.float32).max)
    finite = np.clip(finite, -limit, limit)
    if len(finite) == 0:
        return 0.0, 1.0, False
    low, high = (float(end) for end in np.quantile(finite, [0.01, 0.99]))
    if low == high:
        low, high = float(finite.min()), float(finite.max())
    positive = finite[finite > 0]
    if finite.min() < 0 or len(positive) == 0:
        return low, high, False
    smallest, small = (float(end) for end in np.quantile(positive, [0.01, 0.05]))
    # A smaller end might be 0 in float32, in which the header holds it.
    smallest = max(smallest, float(np.finfo(np.float32).tiny))
    if high > LOG_FACTOR * max(small, smallest):
        return smallest, high, True
    return low, high, False
