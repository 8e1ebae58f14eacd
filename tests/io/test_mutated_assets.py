"""Damaged files of every format: finite Gaussians or one message, in bounded time and memory.

The suite reads a small sample. To read 10,000 mutated files per format, type

    CADAM3D_MUTATIONS=10000 python -m pytest tests/io/test_mutated_assets.py -k mutated

A failure names its case; ``CADAM3D_FIRST_MUTATION`` starts there.
"""

import gzip
import os
import re
import struct
import tracemalloc
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from formats import random_gaussians

from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.io.asset_file import read_gaussians
from cadam3d.io.compressed_ply import read_compressed_ply, write_compressed_ply
from cadam3d.io.glb import read_glb, write_glb
from cadam3d.io.ply import read_ply, read_points, write_ply
from cadam3d.io.ply_tables import read_header
from cadam3d.io.splat import read_splat, write_splat
from cadam3d.io.spz import read_spz, write_spz

CASES = int(os.environ.get("CADAM3D_MUTATIONS", "24"))
FIRST = int(os.environ.get("CADAM3D_FIRST_MUTATION", "0"))
MOST_EXPANSION = 20  # times the size of the file
SPARE_BYTES = 64 << 20


def table_of(gaussians: Gaussians) -> dict[str, np.ndarray]:
    """Return the properties of a 3DGS PLY by name."""
    rest = gaussians.sh[:, 1:].transpose(1, 2).flatten(1)
    parts = {
        "x y z": gaussians.means,
        "f_dc_0 f_dc_1 f_dc_2": gaussians.sh[:, 0],
        " ".join(f"f_rest_{i}" for i in range(rest.shape[1])): rest,
        "opacity": gaussians.opacity_logits[:, None],
        "scale_0 scale_1 scale_2": gaussians.log_scales,
        "rot_0 rot_1 rot_2 rot_3": gaussians.quats,
    }
    return {
        name: values[:, column].numpy()
        for names, values in parts.items()
        for column, name in enumerate(names.split())
    }


def plain_ply(columns: dict[str, np.ndarray], encoding: str, before: bytes = b"", rows: bytes = b"") -> bytes:
    """Return a PLY as other programs write it; ``before`` and ``rows`` are another element."""
    words = {"f": {4: "float", 8: "double"}, "i": {1: "char", 4: "int"}, "u": {1: "uchar", 2: "ushort"}}
    count = len(next(iter(columns.values())))
    kinds = {name: words[values.dtype.kind][values.dtype.itemsize] for name, values in columns.items()}
    header = f"ply\nformat {encoding} 1.0\ncomment Vertical axis: y\n".encode() + before
    header += f"element vertex {count}\n".encode()
    header += b"".join(f"property {kind} {name}\n".encode() for name, kind in kinds.items()) + b"end_header\n"
    if encoding == "ascii":
        lines = [" ".join(f"{values[row]:g}" for values in columns.values()) for row in range(count)]
        return header + rows + "".join(f"{line}\n" for line in lines).encode()
    order = ">" if "big" in encoding else "<"
    record = np.dtype([(name, values.dtype.newbyteorder(order)) for name, values in columns.items()])
    table = np.empty(count, dtype=record)
    for name, values in columns.items():
        table[name] = values
    return header + rows + table.tobytes()


def written(write: Callable, degree: int, name: str, folder: Path, n: int = 20) -> bytes:
    extra = {"pad_sh": 0} if write is write_ply else {}
    write(folder / name, random_gaussians(n, degree), up="-y", **extra)
    return (folder / name).read_bytes()


def of_version_2(spz: bytes) -> bytes:
    """Return an SPZ of version 3 and degree 0 as version 2, whose rotations have three bytes."""
    unpacked = gzip.decompress(spz)
    count = struct.unpack_from("<I", unpacked, 8)[0]
    return gzip.compress(unpacked[:4] + struct.pack("<I", 2) + unpacked[8:-count], mtime=0)


def without_color_bounds(compressed: bytes) -> bytes:
    """Return a compressed PLY of one chunk in the layout of SuperSplat 1."""
    header, body = compressed.split(b"end_header\n", maxsplit=1)
    lines = [line for line in header.split(b"\n") if line[-5:] not in (b"min_r", b"min_g", b"min_b")]
    lines = [line for line in lines if line[-5:] not in (b"max_r", b"max_g", b"max_b")]
    return b"\n".join(lines) + b"end_header\n" + body[:48] + body[72:]


def read_cloud(path: Path) -> Gaussians:
    """Read plain points, as far as a reader does it."""
    points, rgb = read_points(read_header(path))
    assert rgb is None or (rgb.min(initial=0) >= 0 and rgb.max(initial=1) <= 1)
    return random_gaussians(min(len(points), 1000), 0)


CAMERA = b"element camera 1\nproperty double t\nproperty uchar id\n"
READERS: dict[str, tuple[Callable[[Path], Gaussians], str]] = {
    "ply": (read_ply, "a.ply"),
    "ascii ply": (read_ply, "a.ply"),
    "big-endian ply": (read_ply, "a.ply"),
    "compressed ply": (read_compressed_ply, "a.ply"),
    "old compressed ply": (read_compressed_ply, "a.compressed.ply"),
    "splat": (read_splat, "a.splat"),
    "glb": (read_glb, "a.glb"),
    "spz": (read_spz, "a.spz"),
    "spz 2": (read_spz, "a.spz"),
    "points": (read_cloud, "a.ply"),
}


@pytest.fixture(scope="module")
def samples(tmp_path_factory) -> dict[str, bytes]:
    """Return a small valid file of each format."""
    folder = tmp_path_factory.mktemp("samples")
    columns = table_of(random_gaussians(20, 1))
    points = {name: columns[name] for name in ("z", "x", "y")}
    colors = {name: np.arange(20, dtype=np.uint8) for name in ("red", "green", "blue")}
    doubles = {name: values.astype(np.float64) for name, values in reversed(columns.items())}
    return {
        "ply": written(write_ply, 1, "a.ply", folder),
        "ascii ply": plain_ply(columns, "ascii", CAMERA, b"0.5 3\n"),
        "big-endian ply": plain_ply(doubles, "binary_big_endian", CAMERA, b"\0" * 9),
        "compressed ply": written(write_compressed_ply, 1, "b.ply", folder, n=300),
        "old compressed ply": without_color_bounds(written(write_compressed_ply, 0, "c.ply", folder)),
        "splat": written(write_splat, 0, "a.splat", folder),
        "glb": written(write_glb, 1, "a.glb", folder),
        "spz": written(write_spz, 1, "a.spz", folder),
        "spz 2": of_version_2(written(write_spz, 0, "b.spz", folder)),
        "points": plain_ply(points | colors, "ascii"),
    }


# Mutations. Each takes the bytes of a file and a generator, and returns other bytes.

Random = np.random.Generator
HUGE = [b"0", b"1", b"21", b"-1", b"4294967295", b"999999999", b"999999999999999", b"9" * 40, b"1e9", b"x"]
TEXTS = [b"nan", b"-inf", b"1e999", b"-1e-999", b"0x1p3", b"9" * 400, b"1_0", b"--1", b"1,5", b"1e", b"'1'"]
TEXTS += [b"\xff\xfe", b"", b"\0", b"1 2 3", b"\n", b"." * 5000, b"1" + b"0" * 308, b"\x1c", b"#"]
LINES = [
    b"property list uchar int vertex_indices",
    b"property float x",
    b"property double extra",
    b"property uchar f_rest_0",
    b"property half y",
    b"element vertex 20",
    b"element face 1000000",
    b"element chunk 1",
    b"element empty 999999999999",
    b"comment cadam3d up=+z",
    b"comment cadam3d up=x",
    b"comment " + b"x" * 70000,
    b"format ascii 1.0",
    b"format binary_big_endian 1.0",
    b"end_header",
    b"\xff\xff",
]
FLOATS = [np.nan, np.inf, -np.inf, 3.4e38, -3.4e38, 1e-45, 0.0]


def truncated(content: bytes, draw: Random) -> bytes:
    return content[: draw.integers(len(content))]


def flipped(content: bytes, draw: Random) -> bytes:
    changed = bytearray(content)
    for position in draw.integers(len(content), size=draw.integers(1, 9)):
        changed[position] ^= 1 << draw.integers(8)
    return bytes(changed)


def overwritten(content: bytes, draw: Random) -> bytes:
    start, size = draw.integers(len(content)), draw.integers(1, 64)
    fill = [b"\0" * size, b"\xff" * size, draw.bytes(size)][draw.integers(3)]
    return content[:start] + fill + content[start + size :]


def spliced(content: bytes, draw: Random) -> bytes:
    start, end, place = draw.integers(len(content), size=3)
    piece = content[min(start, end) : max(start, end)]
    return content[:place] + piece + content[place + draw.integers(2) * len(piece) :]


def with_float(content: bytes, draw: Random) -> bytes:
    place = draw.integers(max(len(content) - 8, 1))
    kind = ["<f4", ">f4", "<f8", ">f8"][draw.integers(4)]
    value = np.array(FLOATS[draw.integers(len(FLOATS))]).astype(kind).tobytes()
    return content[:place] + value + content[place + len(value) :]


def with_count(content: bytes, draw: Random) -> bytes:
    """Change a number in the header of a PLY, or four bytes at the beginning of another file."""
    counts = list(re.finditer(rb"(?<=element )(\S+ )(\d+)", content))
    if not counts:
        place = draw.integers(min(len(content), 24))
        number = [0, 1, 2**16, 2**24, 2**31 - 1, 2**32 - 1][draw.integers(6)]
        return content[:place] + struct.pack("<I", number) + content[place + 4 :]
    found = counts[draw.integers(len(counts))]
    return content[: found.start(2)] + HUGE[draw.integers(len(HUGE))] + content[found.end(2) :]


def with_text(content: bytes, draw: Random) -> bytes:
    """Replace a word, or everything if there is no word."""
    words = list(re.finditer(rb"[^\s]+", content[:20000])) or list(re.finditer(rb"(?s).+", content))
    found = words[draw.integers(len(words))]
    return content[: found.start()] + TEXTS[draw.integers(len(TEXTS))] + content[found.end() :]


def with_line(content: bytes, draw: Random) -> bytes:
    """Add a line to the header of a PLY, or remove one."""
    header, found, body = content.partition(b"end_header\n")
    lines = header.split(b"\n")
    place = draw.integers(len(lines))
    if draw.integers(2):
        lines.insert(place, LINES[draw.integers(len(LINES))])
    else:
        del lines[place]
    return b"\n".join(lines) + found + body


MUTATIONS = [truncated, flipped, overwritten, spliced, with_float, with_count, with_text, with_line]


def mutated(content: bytes, draw: Random) -> bytes:
    """Return ``content`` after one to three mutations; those of a gzip stream change what is in it."""
    is_inside = content[:2] == b"\x1f\x8b" and draw.integers(4) > 0
    changed = gzip.decompress(content) if is_inside else content
    for _ in range(draw.integers(1, 4)):
        changed = MUTATIONS[draw.integers(len(MUTATIONS))](changed, draw) or b"\0"
    return gzip.compress(changed, compresslevel=1) if is_inside else changed


# Laws


def outcome(read: Callable[[Path], Gaussians], path: Path) -> tuple[Gaussians | None, int]:
    """Read a file and check the laws. Return the Gaussians, if valid, and the peak of memory."""
    made, message = None, ""
    tracemalloc.reset_peak()
    before = tracemalloc.get_traced_memory()[0]
    with warnings.catch_warnings():
        # A warning would be a second line for the user.
        warnings.simplefilter("error")
        try:
            made = read(path)
        except UserError as error:
            message = str(error)
    peak = tracemalloc.get_traced_memory()[1] - before
    if made is None:
        assert message.startswith(f"{path}: ")
        assert message.count("Try: ") == 1
        assert "\n" not in message
        assert len(message) < len(str(path)) + 400
    else:
        n, coefficients = len(made), made.sh.shape[1]
        assert coefficients in (1, 4, 9, 16)
        shapes = [(n, 3), (n, 3), (n, 4), (n,), (n, coefficients, 3)]
        assert [tuple(tensor.shape) for tensor in made.tensors().values()] == shapes
        for tensor in made.tensors().values():
            assert tensor.dtype == torch.float32
            assert bool(tensor.isfinite().all())
            # tracemalloc does not see the memory of tensors.
            peak += tensor.nbytes
    assert peak <= MOST_EXPANSION * path.stat().st_size + SPARE_BYTES
    return made, peak


@pytest.fixture
def tracing():
    tracemalloc.start()
    yield
    tracemalloc.stop()


@pytest.mark.parametrize("name", READERS)
def test_a_mutated_file_is_read_or_refused_with_one_message(name, samples, tmp_path, tracing):
    reader, file_name = READERS[name]
    path = tmp_path / file_name
    path.write_bytes(samples[name])
    assert outcome(reader, path)[0] is not None
    for case in range(FIRST, FIRST + CASES):
        draw = np.random.default_rng([list(READERS).index(name), case])
        path.write_bytes(mutated(samples[name], draw))
        try:
            outcome(read_gaussians if reader is not read_cloud and case % 4 == 0 else reader, path)
        except BaseException as error:
            error.add_note(f"in case {case} of {name}")
            raise


def repeated(rows: int, kind: str) -> bytes:
    """Return a PLY of degree 3 with equal rows of one-byte numbers, or of one-digit numbers in text."""
    columns = {name: np.ones(rows, dtype=np.int8) for name in table_of(random_gaussians(1, 3))}
    if kind == "binary":
        return plain_ply(columns, "binary_little_endian")
    header = plain_ply({name: values[:0].astype(np.float64) for name, values in columns.items()}, "ascii")
    header = header.replace(b"element vertex 0", f"element vertex {rows}".encode())
    return header + (b" ".join([b"1"] * len(columns)) + b"\n") * rows


def many_points(rows: int) -> bytes:
    header = plain_ply({name: np.ones(0) for name in "xyz"}, "ascii")
    return header.replace(b"element vertex 0", f"element vertex {rows}".encode()) + b"1 1 1\n" * rows


# The formats that expand most, in files for which the memory of a constant size does not matter.
LARGE = {
    "one-byte ply": (read_ply, lambda folder: repeated(5_000, "binary")),
    "short text": (read_ply, lambda folder: repeated(3_000, "text")),
    "compressed ply": (
        read_compressed_ply,
        lambda folder: written(write_compressed_ply, 3, "a.ply", folder, n=20_000),
    ),
    "splat": (read_splat, lambda folder: written(write_splat, 0, "a.splat", folder, n=50_000)),
    "points": (read_cloud, lambda folder: many_points(30_000)),
}


@pytest.mark.parametrize("name", LARGE)
def test_the_memory_of_a_reader_is_bounded_by_the_size_of_the_file(name, tmp_path, tracing):
    read, content = LARGE[name]
    path = tmp_path / "large"
    path.write_bytes(content(tmp_path))
    made, peak = outcome(read, path)
    assert made is not None
    # A constant part is allowed, but none of these needs it.
    assert peak <= MOST_EXPANSION * path.stat().st_size
