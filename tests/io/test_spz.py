"""SPZ files: the published encodings, bounded memory, and one message for each broken file."""

import gzip
import struct
import tracemalloc
import zlib

import pytest
import torch
from formats import (
    errors,
    gaussforge_reads,
    gaussforge_writes,
    random_gaussians,
)

from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.io.frames import UPS
from cadam3d.io.spz import read_spz, write_spz

SH_C0 = 0.28209479177387814
ONE = {  # one Gaussian, block by block, in the order of the file
    "position": bytes([0, 16, 0, 0, 240, 255, 1, 0, 0]),  # 4096, -4096 and 1
    "alpha": bytes([51]),
    "color": bytes([255, 0, 127]),
    "scale": bytes([160, 144, 0]),
}


def spz(*blocks, version=3, count=1, degree=0, bits=12, flags=0, magic=b"NGSP") -> bytes:
    """Return a file that is built without the code under test."""
    header = struct.pack("<4sIIBBBB", magic, version, count, degree, bits, flags, 0)
    return gzip.compress(header + b"".join(blocks), mtime=0)


def one(rotation=bytes([0, 0, 0, 192]), sh=b"", **header) -> bytes:
    return spz(*ONE.values(), rotation, sh, **header)


def zeros_after(header: bytes) -> bytes:
    """Return a small gzip stream of ``header`` and 100 MB of zeros."""
    stream = zlib.compressobj(1, wbits=31)
    pieces = [stream.compress(header), *(stream.compress(bytes(1 << 20)) for _ in range(100)), stream.flush()]
    return b"".join(pieces)


def read(tmp_path, content: bytes, **settings) -> Gaussians:
    (tmp_path / "a.spz").write_bytes(content)
    return read_spz(tmp_path / "a.spz", **settings)


# Numbers


@pytest.mark.parametrize("up", UPS)
@pytest.mark.parametrize("degree", [0, 3])
def test_the_round_trip_is_within_half_a_step_of_each_encoding(tmp_path, degree, up):
    gaussians = random_gaussians(500, degree=degree)
    write_spz(tmp_path / "a.spz", gaussians, up=up)
    back = errors(read_spz(tmp_path / "a.spz", up=up), gaussians)
    assert back["means"] <= 2**-17
    assert back["log_scales"] <= 1 / 32 + 1e-6
    assert back["opacities"] <= 1 / 510 + 1e-6
    assert back["sh0"] * SH_C0 <= 0.0038
    # The axes mix the coefficients of a band, so errors add up.
    assert back["sh"] <= (1 / 16 if up == "+z" else 1 / 8) + 1e-6
    assert back["angle_deg"] < 0.25


def test_version_3_has_the_published_encodings(tmp_path):
    # The largest component is w (index 3); the fields of x, y and z have a sign and nine bits.
    rotation = 3 << 30 | (0x200 | 255) << 20 | 0 << 10 | 128
    read_back = read(tmp_path, one(struct.pack("<I", rotation)), up="+z")
    x, z = -255 / 511 * 0.5**0.5, 128 / 511 * 0.5**0.5
    w = (1 - x**2 - z**2) ** 0.5
    assert torch.equal(read_back.means, torch.tensor([[1.0, -1.0, 2**-12]]))
    assert torch.equal(read_back.log_scales, torch.tensor([[0.0, -1.0, -10.0]]))
    assert torch.allclose(read_back.quats, torch.tensor([[w, x, 0.0, z]]))
    assert torch.allclose(read_back.opacities, torch.tensor([0.2]))
    assert torch.allclose(0.15 * read_back.sh[:, 0] + 0.5, torch.tensor([[1.0, 0.0, 127 / 255]]))


def test_version_2_stores_the_first_three_components(tmp_path):
    read_back = read(tmp_path, one(bytes([255, 128, 128]), version=2), up="+z")
    assert torch.allclose(read_back.quats, torch.tensor([[0.0, 1.0, 0.0, 0.0]]), atol=0.005)


def test_the_channels_of_a_coefficient_are_stored_together(tmp_path):
    bands = bytes(range(128, 128 + 9))
    sh = read(tmp_path, one(sh=bands, degree=1), up="+z").sh
    assert torch.equal(sh[0, 1:] * 128, torch.arange(9.0).reshape(3, 3))


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_another_program_reads_the_same_numbers_and_we_read_its_files(tmp_path, degree, version):
    gaussians = random_gaussians(100, degree=degree)
    theirs = gaussforge_writes(gaussians, "spz", version)
    assert max(errors(read(tmp_path, theirs, up="+z"), gaussforge_reads(theirs, "spz")).values()) < 0.03
    write_spz(tmp_path / "b.spz", gaussians, up="+z")
    ours = read_spz(tmp_path / "b.spz", up="+z")
    assert max(errors(gaussforge_reads((tmp_path / "b.spz").read_bytes(), "spz"), ours).values()) < 0.03


def test_reading_and_writing_again_gives_the_same_bytes(tmp_path):
    write_spz(tmp_path / "a.spz", random_gaussians(300, degree=2), up="+z")
    write_spz(tmp_path / "b.spz", read_spz(tmp_path / "a.spz", up="+z"), up="+z")
    assert (tmp_path / "a.spz").read_bytes() == (tmp_path / "b.spz").read_bytes()
    # Bytes 4 to 7 of a gzip stream are a time, which would make two files differ.
    assert (tmp_path / "a.spz").read_bytes()[4:8] == bytes(4)


@pytest.mark.parametrize("extent", [1e-3, 1.0, 127.9, 128.0, 5000.0, 8388607.0])
def test_no_position_overflows(tmp_path, extent):
    gaussians = random_gaussians(20)
    gaussians.means[0] = torch.tensor([extent, -extent, extent / 3])
    write_spz(tmp_path / "a.spz", gaussians, up="+z")
    back = read_spz(tmp_path / "a.spz", up="+z")
    largest = float(gaussians.means.abs().max())
    assert (back.means - gaussians.means).abs().max() <= max(2**-17, largest * 2**-23)


def test_a_position_beyond_the_format_is_one_message(tmp_path):
    gaussians = random_gaussians(3)
    gaussians.means[0, 0] = 1e7
    with pytest.raises(UserError, match=r"up to 8,388,607.*got 1e\+07. Try: 'exporter=\[ply\]'$"):
        write_spz(tmp_path / "a.spz", gaussians, up="+y")
    assert not list(tmp_path.iterdir())


def test_many_rows_are_decoded_in_their_order(tmp_path):
    n = 20_000
    gaussians = random_gaussians(n)
    gaussians.means[:, 0] = torch.arange(n) / n
    write_spz(tmp_path / "a.spz", gaussians, up="-y")
    assert (read_spz(tmp_path / "a.spz", up="-y").means - gaussians.means).abs().max() <= 2**-17


# Broken and hostile files

BROKEN = {
    "nothing": (b"", r"not an spz file"),
    "another file": (b"ply\nformat", r"damaged gzip stream"),
    "another archive": (gzip.compress(b"x" * 50), r"not an spz file"),
    "half a header": (gzip.compress(b"NGSP"), r"not an spz file"),
    "version 1": (one(version=1), r"expected SPZ version 2 or 3 .*got version 1"),
    "degree 4": (one(degree=4), r"SH degree 0 to 3, got .*degree 4"),
    "a missing block": (spz(*ONE.values()), r"expected 20 bytes"),
    "a cut stream": (one()[:-9], r"expected 20 bytes"),
    "a wrong checksum": (one()[:-8] + bytes(8), r"damaged gzip stream"),
    "more data in the stream": (one(sh=b"more"), r"expected 20 bytes"),
    "more data in the file": (one() + b"more", r"expected 20 bytes"),
    "a huge count": (one(count=2**32 - 1), r"promises 4,294,967,295 Gaussians, too many for"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_file_is_one_message(tmp_path, name):
    content, message = BROKEN[name]
    with pytest.raises(UserError, match=message + r".*\. Try: another file$"):
        read(tmp_path, content)


def test_extensions_after_the_gaussians_are_skipped(tmp_path):
    assert len(read(tmp_path, one(sh=b"an extension of a vendor", flags=2))) == 1


def test_memory_is_bounded_by_the_size_of_the_file(tmp_path):
    def peak(content: bytes) -> int:
        tracemalloc.start()
        try:
            with pytest.raises(UserError, match=r"Try: another file$"):
                read(tmp_path, content)
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    assert peak(zeros_after(b"")) < 1 << 21
    one_gaussian = struct.pack("<4sIIBBBB", b"NGSP", 3, 1, 0, 12, 0, 0)
    assert peak(zeros_after(one_gaussian)) < 1 << 21
    millions = struct.pack("<4sIIBBBB", b"NGSP", 3, 5_000_000, 0, 12, 0, 0)
    assert peak(zeros_after(millions)) < 1 << 21
