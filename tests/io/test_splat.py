""".splat files: 32-byte records that another program reads too, and one message for each broken file."""

import struct

import pytest
import torch
from formats import (
    errors,
    gaussforge_reads,
    gaussforge_writes,
    is_finite,
    matched,
    random_gaussians,
)

from cadam3d.core.errors import UserError
from cadam3d.io.frames import UPS
from cadam3d.io.splat import read_splat, write_splat

# Half a step of a byte, as a colour, and the largest angle between two quaternions of bytes.
HALF_STEP, MOST_DEG = 1 / 510 + 1e-6, 1.0
SH_C0 = 0.28209479177387814


def record(position=(0.1, 0.2, 0.3), scale=(0.5, 1.0, 2.0), rgba=(255, 0, 51, 128), quat=(255, 128, 128, 0)):
    """Return the bytes of one Gaussian, built without the code under test."""
    return struct.pack("<6f8B", *position, *scale, *rgba, *quat)


@pytest.mark.parametrize("up", UPS)
def test_the_round_trip_keeps_positions_and_scales_and_rounds_the_rest_to_bytes(tmp_path, up):
    gaussians = random_gaussians(500)
    write_splat(tmp_path / "a.splat", gaussians, up=up)
    assert (tmp_path / "a.splat").stat().st_size == 500 * 32
    back = errors(matched(read_splat(tmp_path / "a.splat", up=up), gaussians), gaussians)
    assert back["means"] == 0
    assert back["log_scales"] < 1e-6
    assert back["opacities"] < HALF_STEP
    assert back["sh0"] * SH_C0 < HALF_STEP
    assert back["angle_deg"] < MOST_DEG


def test_a_record_has_the_published_layout(tmp_path):
    (tmp_path / "a.splat").write_bytes(record())
    read = read_splat(tmp_path / "a.splat", up="+z")
    assert torch.allclose(read.means, torch.tensor([[0.1, 0.2, 0.3]]))
    assert torch.allclose(read.scales, torch.tensor([[0.5, 1.0, 2.0]]))
    assert torch.allclose(0.5 + SH_C0 * read.sh[:, 0], torch.tensor([[1.0, 0.0, 0.2]]), atol=1e-6)
    assert torch.allclose(read.opacities, torch.tensor([128 / 255]))
    assert torch.equal(read.quats, torch.tensor([[127 / 128, 0.0, 0.0, -1.0]]))
    write_splat(tmp_path / "b.splat", read, up="+z")
    assert (tmp_path / "b.splat").read_bytes()[:28] == record()[:28]


def test_large_and_opaque_gaussians_come_first(tmp_path):
    gaussians = random_gaussians(200)
    write_splat(tmp_path / "a.splat", gaussians, up="-y")
    back = read_splat(tmp_path / "a.splat")
    sizes = back.log_scales.sum(dim=1) + back.opacities.log()
    # Opacities are rounded to bytes, so neighbours of almost the same size may change places.
    assert (sizes.diff() < 0.05).all()
    assert sizes[0] - sizes[-1] > 3


def test_another_program_reads_the_same_numbers_and_we_read_its_file(tmp_path):
    gaussians = random_gaussians(100)
    write_splat(tmp_path / "a.splat", gaussians, up="+z")
    ours = read_splat(tmp_path / "a.splat", up="+z")
    theirs = gaussforge_reads((tmp_path / "a.splat").read_bytes(), "splat")
    assert max(errors(theirs, ours).values()) < 0.03  # the angle is in degrees
    (tmp_path / "b.splat").write_bytes(gaussforge_writes(gaussians, "splat"))
    back = errors(matched(read_splat(tmp_path / "b.splat", up="+z"), gaussians), gaussians)
    # gaussforge does not round to the nearest byte but down.
    assert back["means"] == 0
    assert back["opacities"] < 2 * HALF_STEP
    assert back["sh0"] * SH_C0 < 2 * HALF_STEP
    assert back["angle_deg"] < 2 * MOST_DEG


def test_view_dependence_is_dropped_and_nothing_else(tmp_path):
    write_splat(tmp_path / "a.splat", random_gaussians(20, degree=3), up="-y")
    coloured = random_gaussians(20, degree=3)
    plain = type(coloured)(**{**coloured.tensors(), "sh": coloured.sh[:, :1]})
    write_splat(tmp_path / "b.splat", plain, up="-y")
    assert (tmp_path / "a.splat").read_bytes() == (tmp_path / "b.splat").read_bytes()


def test_a_scale_of_zero_is_read_as_a_very_thin_one(tmp_path):
    (tmp_path / "a.splat").write_bytes(record(scale=(0.0, 1.0, 1.0)))
    assert is_finite(read := read_splat(tmp_path / "a.splat", up="+z"))
    assert read.log_scales[0, 0] < -80


BROKEN = {
    "a size": (record()[:-1], r"expected records of 32 bytes, got 31 bytes"),
    "a position": (
        record(position=(float("nan"), 0, 0)),
        r"1 of 1 records have no possible position or scale",
    ),
    "a scale": (record(scale=(1, float("inf"), 1)) + record(), r"1 of 2 records"),
    "a negative scale": (record(scale=(1, -1, 1)), r"1 of 1 records"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_file_is_one_message(tmp_path, name):
    content, message = BROKEN[name]
    (tmp_path / "a.splat").write_bytes(content)
    with pytest.raises(UserError, match=message + r".*\. Try: another file$"):
        read_splat(tmp_path / "a.splat")
