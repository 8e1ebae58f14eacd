"""Laws of every format that rounds: the picture stays, numbers stay finite, and files are reproducible."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest
from formats import (
    ENOUGH_DB,
    WRONG_DB,
    asset,
    extreme_gaussians,
    gaussforge_reads,
    is_finite,
    likeness_db,
    matched,
    random_gaussians,
)

from cadam3d.core.gaussians import Gaussians
from cadam3d.io.compressed_ply import read_compressed_ply, write_compressed_ply
from cadam3d.io.frames import file_to_world
from cadam3d.io.gaussforge import write_ksplat, write_sog, write_spz4
from cadam3d.io.splat import read_splat, write_splat
from cadam3d.io.spz import read_spz, write_spz


class Format(NamedTuple):
    """A format with its writer, and a reader of this package or of gaussforge."""

    write: Callable[..., None]
    read: Callable[..., Gaussians]
    degree: int = 3  # largest SH degree whose picture stays


def with_gaussforge(kind: str):
    def read(path: Path, *, up: str) -> Gaussians:
        return file_to_world(gaussforge_reads(path.read_bytes(), kind), up)

    return read


OWN = {
    "splat": Format(write_splat, read_splat, 0),
    "spz": Format(write_spz, read_spz),
    "compressed_ply": Format(write_compressed_ply, read_compressed_ply),
}
FORMATS = OWN | {
    "sog": Format(write_sog, with_gaussforge("sog")),
    "ksplat": Format(write_ksplat, with_gaussforge("ksplat"), 0),
    "spz4": Format(write_spz4, with_gaussforge("spz")),
}


@pytest.fixture(autouse=True)
def _needs_gaussforge(request):
    if request.node.callspec.params["name"] not in OWN:
        pytest.importorskip("gaussforge")


@pytest.mark.parametrize("name", FORMATS)
def test_the_picture_stays_and_a_wrong_up_axis_shows(tmp_path, name):
    each = FORMATS[name]
    for degree in {0, each.degree}:
        each.write(tmp_path / "a", asset(degree), up="+y")
        assert likeness_db(each.read(tmp_path / "a", up="+y"), degree) > ENOUGH_DB
    # A compressed PLY records its axes.
    if name != "compressed_ply":
        assert likeness_db(each.read(tmp_path / "a", up="-y"), each.degree) < WRONG_DB


@pytest.mark.parametrize("name", FORMATS)
def test_extreme_numbers_are_written_as_finite_ones(tmp_path, name):
    each, original = FORMATS[name], extreme_gaussians(1)
    each.write(tmp_path / "a", original, up="-y")
    back = each.read(tmp_path / "a", up="-y")
    assert is_finite(back)
    if name in OWN:
        assert (matched(back, original).opacities - original.opacities).abs().max() < 1 / 500


@pytest.mark.parametrize("name", FORMATS)
def test_the_same_gaussians_give_the_same_bytes(tmp_path, name):
    for file in ("a", "b"):
        FORMATS[name].write(tmp_path / file, random_gaussians(300, degree=1), up="-y")
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


@pytest.mark.parametrize("name", OWN)
@pytest.mark.parametrize("n", [0, 1])
def test_few_gaussians_are_a_valid_file(tmp_path, name, n):
    each = OWN[name]
    each.write(tmp_path / "a", random_gaussians(n, each.degree), up="+y")
    back = each.read(tmp_path / "a", up="+y")
    assert (len(back), back.sh_degree) == (n, each.degree)
