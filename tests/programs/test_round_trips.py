"""Files that splat-transform makes of ours are read upright without any axis, and look the same."""

import pytest
from programs.files import FORMATS, OPPOSITE, VIEW, Case, assert_equal
from programs.render_elsewhere import SplatTransform, ours, psnr
from programs.snowman import snowman_and_pine

from cadam3d.io.asset_file import read_gaussians

pytestmark = [pytest.mark.oracle, pytest.mark.slow]

# The SH degree and the PSNR of what splat-transform writes. At degree 3, its SOG takes minutes without a GPU.
WRITTEN = {".ply": (3, 60), ".compressed.ply": (3, 36), ".sog": (0, 50), ".spz": (3, 36), ".glb": (3, 60)}
# Formats of ours that it reads, with our default axes.
READ = {"ply": 60, "compressed_ply": 36, "splat": 45, "spz": 36, "spz4": 36, "sog": 40, "ksplat": 45}


@pytest.fixture(scope="module")
def convert():
    """Return a function that converts a file into another one."""
    program = SplatTransform.find()

    def convert(source, target) -> None:
        done = program.run("-q", "-w", str(source), str(target))
        assert done.returncode == 0, done.stderr

    return convert


def assert_read_upright(path, degree: int, floor_db: float) -> None:
    assert_equal(ours(read_gaussians(path), VIEW), ours(snowman_and_pine(degree), VIEW), floor_db, path)


@pytest.mark.parametrize("suffix", WRITTEN)
def test_what_it_writes_of_our_ply_is_upright(convert, suffix, tmp_path):
    degree, floor_db = WRITTEN[suffix]
    convert(Case("ply", degree, "-y", 0).write(tmp_path, "-y"), tmp_path / f"back{suffix}")
    assert_read_upright(tmp_path / f"back{suffix}", degree, floor_db)


@pytest.mark.parametrize("name", READ)
def test_our_file_comes_back_upright_as_a_ply(convert, name, tmp_path):
    source = Case(name, 3, "-y", 0).write(tmp_path, "-y")
    convert(source, tmp_path / "back.ply")
    assert_read_upright(tmp_path / "back.ply", min(3, FORMATS[name].max_degree), READ[name])


def test_the_opposite_axes_are_noticed(convert, tmp_path):
    source = Case("spz", 0, "-y", 0).write(tmp_path, OPPOSITE["-y"])
    convert(source, tmp_path / "back.spz")
    wrong = ours(read_gaussians(tmp_path / "back.spz"), VIEW)
    assert psnr(wrong, ours(snowman_and_pine(0), VIEW)) < 15
