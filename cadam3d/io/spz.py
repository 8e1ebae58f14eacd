"""SPZ files of Niantic, versions 2 and 3: rounded numbers and gzip, a quarter to a seventh of a PLY.

A gzip stream holds a header of 16 bytes, and then one block for each kind of number. All are little endian.

| bytes per Gaussian | block | encoding |
|---|---|---|
| (16 once) | header | "NGSP", version u32, count u32, SH degree u8, fractional bits u8, flags u8, 0 |
| 9 | positions | x, y, z as 24-bit integers, which are the position times 2^(fractional bits) |
| 1 | opacities | ``255 opacity`` |
| 3 | colours | ``255 (0.15 f + 0.5)`` of the SH coefficients f of degree 0 |
| 3 | scales | ``16 (s + 10)`` of the natural logarithms s of standard deviations |
| 4 | rotations, version 3 | the three smallest components of a unit quaternion, see below |
| 3 | rotations, version 2 | ``127.5 (q + 1)`` of x, y, z, where w >= 0 is the remainder |
| 9, 24, 45 | SH of degree 1, 2, 3 | ``128 (f + 1)``, the three channels of a coefficient together |

The quaternion of version 3 is a 32-bit integer. Its highest two bits are the index of the largest component
in the order x, y, z, w, which is positive (or all signs change). Ten bits for each of the other three follow
in this order: a sign, and the magnitude in nine bits, where 511 means 1/sqrt(2).

The specification calls the axes "right, up, back", which is +y up. But the programs that write most files
(splat-transform, gaussforge) write the numbers of a PLY unchanged, which is -y up, so this is the default
here. The file does not tell them apart, and ``up`` chooses. Bit 0 of the flags means
that the Gaussians were trained with an antialiasing filter; it is not read, and written as 0. Bit 1 means
that extensions of vendors follow the Gaussians; they are skipped.

:func:`write_spz` rounds to the nearest value of each encoding. The errors are at most half a step: 2^-17 of
a position within the unit ball, 1/32 of the logarithm of a scale (3 % of the scale), 0.0007 of a quaternion's
component, 1/510 of an opacity, and 0.0037 of a colour. Coefficients of SH degree 1 have 5 bits and the others
4, as the reference writes them by default, so their errors are at most 1/32 and 1/16. Clamped are scales
outside of [4.5e-5, 380], colours outside of [-0.44, 1.44], and SH coefficients outside of [-1, 1].

Sources: the README of github.com/nianticlabs/spz, and for the formulas of the encodings the files that
gaussforge 0.6.0 writes and reads (``tests/io/test_spz.py`` compares every number in both directions).
"""

import gzip
import struct
import zlib
from pathlib import Path

import numpy as np

from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.sh import MAX_DEGREE
from cadam3d.io.atomic import replacing
from cadam3d.io.encoding import (
    LARGEST_OF_SMALLEST,
    as_tensor,
    byte_logits,
    in_file_axes,
    opacities,
    smallest_three,
    to_bytes,
    unit_quats,
    with_largest,
)
from cadam3d.io.gathering import gathered
from cadam3d.io.reading import opened, unusable

# The first bytes of the unzipped header. Version 4 (``gaussforge.py``) begins with them directly.
MAGIC = b"NGSP"
GZIP_MAGIC = b"\x1f\x8b\x08"
HEADER = struct.Struct("<4sIIBBBB")
VERSIONS = (2, 3)
HAS_EXTENSIONS = 2  # flag: other data follow the Gaussians
# Positions within the unit ball then have steps of 2^-16. The reference writes 12 bits.
MOST_FRACTIONAL_BITS = 16
LARGEST_FIXED = (1 << 23) - 1
COLOR_SCALE = 0.15
SH_STEPS = (8, 16)  # of the byte of a coefficient: of degree 1, and of higher degrees
GZIP_LEVEL = 6  # 9 gives files that are 1 % smaller, in three to five times the time

# The file and the result may need this many times the size of the file, and these bytes. The rest of the
# promised 64 MB is for decoding a block of rows (measured: 36 MB at SH degree 3).
MOST_EXPANSION = 20
SPARE_BYTES = 24 << 20


def write_spz(path: Path, gaussians: Gaussians, *, up: str) -> None:
    """Write ``gaussians`` as SPZ version 3, atomically, in the axes with up axis ``up`` (see ``frames.py``).

    The same Gaussians give the same bytes. Raises ``UserError`` if the file cannot be written, or if a
    position is too far away for the format.
    """
    local = in_file_axes(gaussians, up)
    bits = _fractional_bits(path, local)
    header = HEADER.pack(MAGIC, 3, len(local), local.sh_degree, bits, 0, 0)
    fixed = np.rint(np.ldexp(local.means.double().numpy(), bits)).astype("<i4")
    blocks = [
        np.ascontiguousarray(fixed)[..., None].view(np.uint8)[..., :3],
        to_bytes(255 * opacities(local)),
        to_bytes(255 * (COLOR_SCALE * local.sh[:, 0].double().numpy() + 0.5)),
        to_bytes(16 * (local.log_scales.double().numpy() + 10)),
        _smallest_three(unit_quats(local)),
        _sh_bytes(local.sh[:, 1:].double().numpy()),
    ]
    with (
        replacing(path) as temporary,
        temporary.open("wb") as raw,
        # Without a name and a time, the stream depends on nothing except its content.
        gzip.GzipFile(filename="", mode="wb", compresslevel=GZIP_LEVEL, fileobj=raw, mtime=0) as file,
    ):
        file.write(header)
        for block in blocks:
            file.write(block.tobytes())


def read_spz(path: Path, *, up: str = "-y") -> Gaussians:
    """Read Gaussians of a file of version 2 or 3 into world axes, on the CPU, as float32.

    ``up`` is the up axis of the file. Never allocates more than 20 times the size of the file and 64 MB.
    Raises ``UserError`` if ``path`` is not such a file, or would need more memory.
    """
    with opened(path) as file:
        content = file.read()
    inflate = zlib.decompressobj(wbits=31)  # gzip, whose checksum is verified
    try:
        start = inflate.decompress(content, HEADER.size)
        if len(start) < HEADER.size or not start.startswith(MAGIC):
            raise unusable(path, "not an spz file")
        _, version, count, degree, fractional_bits, flags, _ = HEADER.unpack(start)
        if version not in VERSIONS or degree > MAX_DEGREE:
            wanted = f"SPZ version 2 or 3 and SH degree 0 to {MAX_DEGREE}"
            raise unusable(path, f"expected {wanted}, got version {version} and degree {degree}")
        coefficients = (degree + 1) ** 2
        sizes = [9, 1, 3, 3, 4 if version == 3 else 3, 3 * (coefficients - 1)]
        length = count * sum(sizes)
        if length + 4 * count * (11 + 3 * coefficients) > MOST_EXPANSION * len(content) + SPARE_BYTES:
            promise = f"its header promises {count:,} Gaussians"
            raise unusable(path, f"{promise}, too many for {len(content):,} bytes")
        # A limit of 0 would be none at all. One byte more shows whether the stream goes on.
        packed = inflate.decompress(inflate.unconsumed_tail, length + 1)
    except zlib.error as error:
        raise unusable(path, f"a damaged gzip stream ({error})") from error
    is_at_end = len(packed) == length and inflate.eof and not inflate.unused_data
    if len(packed) < length or not (is_at_end or flags & HAS_EXTENSIONS):
        raise unusable(path, f"expected {length:,} bytes after its header, got another number")
    numbers = np.frombuffer(packed, np.uint8, count=length)
    ends = count * np.cumsum(sizes)
    blocks = [
        each.reshape(count, size) for each, size in zip(np.split(numbers, ends[:-1]), sizes, strict=True)
    ]

    def local(rows: slice) -> Gaussians:
        positions, alphas, colors, scales, rotations, rest = (block[rows] for block in blocks)
        digits = positions.reshape(-1, 3, 3).astype(np.int32)
        fixed = digits[..., 0] | digits[..., 1] << 8 | digits[..., 2] << 16
        signed = (fixed ^ 1 << 23) - (1 << 23)
        xyzw = (
            _from_smallest_three(rotations)
            if version == 3
            else with_largest(rotations / 127.5 - 1, np.full(len(rotations), 3))
        )
        dc = (colors.astype(np.float64) / 255 - 0.5) / COLOR_SCALE
        sh = np.concatenate([dc, rest / 128.0 - 1], axis=1)
        return Gaussians(
            means=as_tensor(np.ldexp(signed.astype(np.float64), -fractional_bits)),
            log_scales=as_tensor(scales / 16.0 - 10),
            quats=as_tensor(xyzw[:, [3, 0, 1, 2]]),
            opacity_logits=as_tensor(byte_logits(alphas[:, 0])),
            sh=as_tensor(sh.reshape(len(sh), coefficients, 3)),
        )

    return gathered(path, count, up, local)


def _fractional_bits(path: Path, local: Gaussians) -> int:
    """Return the number of fractional bits with which all positions fit into 24 bits."""
    extent = float(local.means.abs().max()) if len(local) else 0.0
    for bits in range(MOST_FRACTIONAL_BITS, -1, -1):
        if extent * 2**bits <= LARGEST_FIXED:
            return bits
    raise UserError(
        f"{path}: expected positions up to {LARGEST_FIXED:,}, which is the range of SPZ, got {extent:g}. "
        "Try: 'exporter=[ply]'"
    )


def _smallest_three(quats: np.ndarray) -> np.ndarray:
    """Return the rotations of unit quaternions (w, x, y, z) in version 3, as integers."""
    largest, others = smallest_three(quats[:, [1, 2, 3, 0]])
    magnitudes = np.minimum(np.rint(np.abs(others) / LARGEST_OF_SMALLEST * 511), 511).astype(np.uint32)
    fields = magnitudes | (others < 0).astype(np.uint32) << 9
    words = largest.astype(np.uint32) << 30
    return (words | fields[:, 0] << 20 | fields[:, 1] << 10 | fields[:, 2]).astype("<u4")


def _from_smallest_three(packed: np.ndarray) -> np.ndarray:
    """Return the quaternions (x, y, z, w) of rotations [n 4 bytes] in version 3."""
    words = np.ascontiguousarray(packed).view("<u4")
    fields = words >> np.array([20, 10, 0], dtype=np.uint32)
    signs = np.where(fields >> 9 & 1, -1.0, 1.0)
    return with_largest(signs * (fields & 511) * (LARGEST_OF_SMALLEST / 511), words[:, 0] >> 30)


def _sh_bytes(rest: np.ndarray) -> np.ndarray:
    """Return SH coefficients [n r 3] of degree 1 and higher as bytes of few bits, which compress well."""
    steps = np.where(np.arange(rest.shape[1]) < 3, *SH_STEPS)[:, None]
    return to_bytes(steps * np.rint(128 * (np.clip(rest, -1, 1) + 1) / steps))
