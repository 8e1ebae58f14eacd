"""The exporter of compressed PLY writes one file with its usual name and axes."""

import pytest
import torch

from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.exporter.compressed_ply import CompressedPlyExporter
from cadam3d.io.asset_file import read_gaussians


def points() -> Gaussians:
    return Gaussians(
        means=torch.tensor([[0.0, 0.0, 0.5], [0.25, 0.0, -0.5]]),
        log_scales=torch.full((2, 3), -3.0),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(2, 1),
        opacity_logits=torch.zeros(2),
        sh=torch.zeros(2, 1, 3),
    )


@pytest.mark.parametrize("up", ["-y", "+y", "+z"])
def test_the_file_is_read_back_upright(tmp_path, up):
    exporter = CompressedPlyExporter(up=up)
    path = tmp_path / "asset.compressed.ply"
    assert exporter.export(points(), lambda cameras, background: None, tmp_path) == [path]
    means = read_gaussians(path).means
    torch.testing.assert_close(means.sort(dim=0).values, points().means.sort(dim=0).values)


def test_an_unknown_axis_is_refused():
    with pytest.raises(UserError, match=r"exporter\.compressed_ply\.up: expected"):
        CompressedPlyExporter(up="up")
