"""Compressed PLY: bounded errors, two layouts, and the same numbers as gaussforge in both directions."""

import struct

import numpy as np
import pytest
import torch
from formats import WRONG_DB, asset, likeness_db, random_gaussians

from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.sh import SH_C0
from cadam3d.io.compressed_ply import morton_order, read_compressed_ply, write_compressed_ply
from cadam3d.io.frames import UPS
from cadam3d.io.ply import read_ply, write_ply


def read_back(folder, gaussians: Gaussians, up: str = "-y") -> Gaussians:
    """Return the Gaussians of a file, in the order of ``gaussians`` instead of its own."""
    write_compressed_ply(folder / "a.ply", gaussians, up=up)
    back = read_compressed_ply(folder / "a.ply")
    order = morton_order(_of_file(gaussians, up).numpy())
    return back.index(torch.from_numpy(np.argsort(order)))


def _of_file(gaussians: Gaussians, up: str) -> torch.Tensor:
    x, y, z = gaussians.means.unbind(1)
    return torch.stack({"-y": (-y, -z, x), "+y": (y, z, x), "+z": (x, y, z)}[up], dim=1)


# Laws


@pytest.mark.parametrize("up", UPS)
@pytest.mark.parametrize("degree", [0, 1])
def test_errors_are_at_most_half_a_step(tmp_path, up, degree):
    made = random_gaussians(600, degree)
    back = read_back(tmp_path, made, up)
    extent = made.means.amax(dim=0) - made.means.amin(dim=0)
    assert ((back.means - made.means).abs() <= extent / 2046 + 1e-6).all()
    scale_extent = float(made.log_scales.max() - made.log_scales.min())
    assert ((back.log_scales - made.log_scales).abs() <= scale_extent / 2046 + 1e-6).all()
    assert ((back.opacities - made.opacities).abs() <= 0.5 / 255 + 1e-6).all()
    color_extent = float(made.sh[:, 0].max() - made.sh[:, 0].min())
    assert ((back.sh[:, 0] - made.sh[:, 0]).abs() <= color_extent / 510 + 1e-6).all()
    assert ((back.sh[:, 1:] - made.sh[:, 1:]).abs() <= 1 / 64 + 1e-6).all()
    assert ((back.rotations - made.rotations).abs() <= 0.005).all()


@pytest.mark.parametrize(("degree", "least_db"), [(0, 50), (3, 45)])
def test_the_picture_of_the_file_is_the_picture_of_the_asset(tmp_path, degree, least_db):
    back = read_back(tmp_path, asset(degree))
    assert likeness_db(back, degree) > least_db
    turned_over = Gaussians(**{**back.tensors(), "means": back.means * torch.tensor([1.0, -1.0, -1.0])})
    assert likeness_db(turned_over, degree) < WRONG_DB


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("n", [0, 1, 255, 256, 257])
def test_every_number_of_gaussians_and_degree_is_possible(tmp_path, n, degree):
    made = random_gaussians(n, degree)
    back = read_back(tmp_path, made)
    assert (len(back), back.sh_degree) == (n, degree)
    _, body = (tmp_path / "a.ply").read_bytes().split(b"end_header\n", maxsplit=1)
    assert len(body) == -(-n // 256) * 72 + n * (16 + 3 * ((degree + 1) ** 2 - 1))


def test_equal_positions_scales_and_colors_are_exact(tmp_path):
    made = random_gaussians(1).index(torch.zeros(300, dtype=torch.long))
    back = read_back(tmp_path, made)
    assert torch.equal(back.means, made.means)
    assert torch.equal(back.log_scales, made.log_scales)
    torch.testing.assert_close(back.sh, made.sh)


def test_extreme_numbers_are_clamped_and_stay_finite(tmp_path):
    made = random_gaussians(8, 1)
    made.means[:, 0] = torch.tensor([3e38, -3e38, 1e-45, 0, -0.0, 1, 2, 3])
    made.log_scales[:, 0] = torch.tensor([100.0, -100, 3e38, -3e38, 0, 1, 2, 3])
    made.opacity_logits[:] = torch.tensor([100.0, -100, 3e38, -3e38, 0, 1, 2, 3])
    made.quats[:3] = torch.tensor([[0.0, 0, 0, 0], [0, 0, 0, -1e-30], [3e38, 3e38, 3e38, -3e38]])
    made.sh[0, 0, 0], made.sh[1, 1:] = 3e38, 1e30
    back = read_back(tmp_path, made)
    assert all(bool(tensor.isfinite().all()) for tensor in back.tensors().values())
    assert back.log_scales.abs().max() <= 20
    torch.testing.assert_close(back.rotations[:3], made.rotations[:3], atol=0.005, rtol=0)
    assert back.sh[1, 1:].tolist() == [[4, 4, 4]] * 3
    torch.testing.assert_close(back.opacities, made.opacities, atol=1 / 500, rtol=0)


def test_a_number_that_is_not_finite_is_refused_before_anything_is_written(tmp_path):
    made = random_gaussians(3)
    made.means[1, 1] = float("nan")
    with pytest.raises(UserError, match="expected finite numbers, got NaN or infinity"):
        write_compressed_ply(tmp_path / "a.ply", made, up="-y")
    assert not list(tmp_path.iterdir())


def test_the_same_gaussians_make_the_same_file(tmp_path):
    for name in ("a.ply", "b.ply"):
        write_compressed_ply(tmp_path / name, random_gaussians(300, 1), up="-y")
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


def test_chunks_hold_neighbours():
    made = random_gaussians(4096)
    ordered = made.means[torch.from_numpy(morton_order(made.means.numpy()))].view(-1, 256, 3)
    shuffled = made.means.view(-1, 256, 3)

    def volume(chunks):
        return (chunks.amax(dim=1) - chunks.amin(dim=1)).prod(dim=1).median()

    assert volume(ordered) < volume(shuffled) / 4


# Layout

HEADER = """ply
format binary_little_endian 1.0
comment Generated by SuperSplat 1.8.3
element chunk 1
{bounds}
element vertex {count}
property uint packed_position
property uint packed_rotation
property uint packed_scale
property uint packed_color
end_header
"""
NAMES = [f"{end}_{block}{axis}" for block in ("", "scale_") for end in ("min", "max") for axis in "xyz"]
OLD = [f"property float {name}" for name in NAMES]
NEW = [*OLD, *(f"property float {end}_{channel}" for end in ("min", "max") for channel in "rgb")]


def hand_made(lines, bounds, *rows) -> bytes:
    header = HEADER.format(bounds="\n".join(lines), count=len(rows))
    body = struct.pack(f"<{len(bounds)}f", *bounds)
    return header.encode() + body + b"".join(struct.pack("<4I", *row) for row in rows)


def test_a_hand_made_file_of_the_first_layout_is_read(tmp_path):
    position = 2047 << 21 | 0 << 11 | 1024
    rotation = 1 << 30 | 1023 << 20 | 0 << 10 | 512  # x is the largest; w, y, z follow
    scale = 0 << 21 | 1023 << 11 | 2047
    color = 255 << 24 | 0 << 16 | 51 << 8 | 128
    bounds = [-1, -2, -4, 1, 2, 4, -5, -6, -7, -1, -2, -3]
    (tmp_path / "a.ply").write_bytes(hand_made(OLD, bounds, (position, rotation, scale, color)))
    back = read_compressed_ply(tmp_path / "a.ply", up="+z")
    assert back.means[0].tolist() == pytest.approx([1, -2, -4 + 8 * 1024 / 2047])
    assert back.log_scales[0].tolist() == [-5, -2, -3]
    w, y, z = 0.5**0.5, -(0.5**0.5), (512 / 1023 - 0.5) * 2**0.5
    assert back.quats[0].tolist() == pytest.approx([w, 0, y, z], abs=1e-6)
    assert (0.5 + SH_C0 * back.sh[0, 0]).tolist() == pytest.approx([1, 0, 0.2], abs=1e-6)
    assert back.opacities.tolist() == pytest.approx([128 / 255])


def test_bounds_of_colors_are_read_from_the_second_layout(tmp_path):
    bounds = [0] * 12 + [-1, 0.25, 0.5, 3, 0.75, 0.5]
    (tmp_path / "a.ply").write_bytes(hand_made(NEW, bounds, (0, 0, 0, 255 << 24 | 51 << 16 | 255 << 8)))
    back = read_compressed_ply(tmp_path / "a.ply", up="+z")
    assert (0.5 + SH_C0 * back.sh[0, 0]).tolist() == pytest.approx([3, 0.35, 0.5])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"element chunk 2", b"element chunk 1", "257 Gaussians need 2 chunks, got 1"),
        (b"element sh 257", b"element sh 256", "257 Gaussians, but 256 rows of element sh"),
        (b"element vertex 257", b"element vertex 258", "but 257 rows of element sh"),
        (
            b"property uint packed_scale",
            b"property int packed_scale",
            "expected uint for property packed_scale",
        ),
        (b"property uchar f_rest_8", b"property char f_rest_8", "expected uchar for property f_rest_8"),
        (b"property uchar f_rest_8", b"property uchar f_rest_9", "got 9"),
        (b"property float max_y", b"property float highest_y", "element chunk has no properties max_y"),
    ],
)
def test_a_wrong_header_is_one_message(tmp_path, old, new, message):
    write_compressed_ply(tmp_path / "a.ply", random_gaussians(257, 1), up="-y")
    content = (tmp_path / "a.ply").read_bytes()
    assert old in content
    (tmp_path / "a.ply").write_bytes(content.replace(old, new))
    with pytest.raises(UserError, match=rf"a\.ply: .*{message}"):
        read_compressed_ply(tmp_path / "a.ply")


@pytest.mark.parametrize("lost", [1, 9 * 257, 9 * 257 + 1, 9 * 257 + 16 * 257 + 1])
def test_a_truncated_file_is_refused(tmp_path, lost):
    write_compressed_ply(tmp_path / "a.ply", random_gaussians(257, 1), up="-y")
    (tmp_path / "a.ply").write_bytes((tmp_path / "a.ply").read_bytes()[:-lost])
    with pytest.raises(UserError, match="truncated"):
        read_compressed_ply(tmp_path / "a.ply")


def test_bounds_that_are_not_finite_are_refused(tmp_path):
    bounds = [float("nan"), *[0] * 17]
    (tmp_path / "a.ply").write_bytes(hand_made(NEW, bounds, (0, 0, 0, 0), (0, 0, 0, 0)))
    with pytest.raises(UserError, match="NaN or infinity in 2 of 2 Gaussians"):
        read_compressed_ply(tmp_path / "a.ply")


# An independent reader and writer


@pytest.mark.oracle
@pytest.mark.parametrize("degree", [0, 1, 3])
def test_gaussforge_reads_the_same_numbers(tmp_path, degree):
    forge = pytest.importorskip("gaussforge").GaussForge()
    write_compressed_ply(tmp_path / "a.ply", random_gaussians(300, degree), up="+z")
    ours = read_compressed_ply(tmp_path / "a.ply")
    content = forge.convert((tmp_path / "a.ply").read_bytes(), "compressed.ply", "ply")["data"]
    (tmp_path / "b.ply").write_bytes(content)
    assert_close(read_ply(tmp_path / "b.ply", up="+z"), ours)


@pytest.mark.oracle
def test_gaussforge_writes_what_this_program_reads(tmp_path):
    # gaussforge 0.6.0 writes higher SH coefficients in an order that its own reader does not read.
    forge = pytest.importorskip("gaussforge").GaussForge()
    write_ply(tmp_path / "a.ply", random_gaussians(300), up="+z", pad_sh=0)
    packed = forge.convert((tmp_path / "a.ply").read_bytes(), "ply", "compressed.ply")["data"]
    (tmp_path / "packed.ply").write_bytes(packed)
    (tmp_path / "b.ply").write_bytes(forge.convert(packed, "compressed.ply", "ply")["data"])
    theirs = read_ply(tmp_path / "b.ply", up="+z")
    assert_close(read_compressed_ply(tmp_path / "packed.ply", up="+z"), theirs)


def assert_close(first: Gaussians, second: Gaussians) -> None:
    for name in ("means", "log_scales", "rotations", "sh"):
        torch.testing.assert_close(getattr(first, name), getattr(second, name), atol=1e-5, rtol=0)
    # Both choose a number for the opacities 0 and 1.
    torch.testing.assert_close(first.opacities, second.opacities, atol=0.0011, rtol=0)
