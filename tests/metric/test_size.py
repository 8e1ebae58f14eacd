"""Size: the bytes it states are the bytes on disk."""

import pytest
import torch

from cadam3d.core.gaussians import Gaussians
from cadam3d.io.ply import write_ply
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


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("n", [0, 1, 500])
def test_asset_bytes_are_the_bytes_of_the_file(tmp_path, degree, n):
    write_ply(tmp_path / "asset.ply", gaussians(n, degree), up="-y", pad_sh=0)
    measured = Size().measure(gaussians(n, degree), never_renders, None)
    assert measured["asset_bytes"] == (tmp_path / "asset.ply").stat().st_size
    assert measured["num_gaussians"] == n


def test_a_large_asset_of_degree_0_costs_68_bytes_per_gaussian():
    measured = Size().measure(gaussians(100_000), never_renders, None)
    assert measured["bytes_per_gaussian"] == pytest.approx(68, abs=0.01)
    assert measured["asset_mib"] == pytest.approx(6.8e6 / 2**20, rel=1e-3)


def test_medians_are_of_the_longest_axis_and_of_the_opacity():
    measured = Size().measure(gaussians(3), never_renders, None)
    assert measured["median_scale"] == pytest.approx(0.4)
    assert measured["median_opacity"] == pytest.approx(0.5)


def test_counts_are_whole_numbers():
    measured = Size().measure(gaussians(3), never_renders, None)
    assert type(measured["num_gaussians"]) is type(measured["asset_bytes"]) is int
