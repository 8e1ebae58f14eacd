"""Size: the bytes that it states are the bytes on disk, for every way to write the file."""

import pytest
import torch

from cadam3d.core.gaussians import Gaussians
from cadam3d.io.ply import write_ply
from cadam3d.metric.base import Measurand
from cadam3d.metric.size import Size


def gaussians(n: int, degree: int = 0) -> Gaussians:
    return Gaussians(
        means=torch.zeros(n, 3),
        log_scales=torch.tensor([0.1, 0.2, 0.4]).log().expand(n, 3),
        quats=torch.ones(n, 4),
        opacity_logits=torch.zeros(n),
        sh=torch.zeros(n, (degree + 1) ** 2, 3),
    )


def never_renders(cameras, background):
    raise AssertionError("counting needs no picture")


def measure(shown, asset):
    return (
        Size().measure(Measurand(gaussians=shown, render=never_renders, prompt="a cube", asset=asset)).numbers
    )


@pytest.mark.parametrize(("degree", "pad_sh"), [(0, 0), (0, 3), (1, 0), (1, 2), (3, 0)])
@pytest.mark.parametrize("n", [0, 1, 500])
def test_sizes_are_those_of_the_file(tmp_path, degree, pad_sh, n):
    path = tmp_path / "asset.ply"
    write_ply(path, gaussians(n, degree), up="-y", pad_sh=pad_sh)
    measured = measure(gaussians(n, degree), path)
    size = path.stat().st_size
    assert measured["num_gaussians"] == n
    assert measured["asset_bytes"] == size
    assert measured["asset_mib"] == size / 2**20
    assert measured.get("bytes_per_gaussian") == (size / n if n else None)


def test_without_a_file_there_are_no_sizes():
    measured = measure(gaussians(3), None)
    assert set(measured) == {"num_gaussians", "median_scale", "median_opacity"}


def test_medians_are_of_the_longest_axis_and_of_the_opacity():
    measured = measure(gaussians(3), None)
    assert measured["median_scale"] == pytest.approx(0.4)
    assert measured["median_opacity"] == pytest.approx(0.5)
