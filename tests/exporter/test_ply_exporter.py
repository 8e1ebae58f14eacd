"""PlyExporter: the asset that every other command reads back."""

import pytest
import torch

from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.exporter.ply import PlyExporter
from cadam3d.io.ply import read_ply


def random_gaussians(n: int = 20) -> Gaussians:
    draw = torch.Generator().manual_seed(0)
    shapes = [(n, 3), (n, 3), (n, 4), (n,), (n, 1, 3)]
    return Gaussians(*(torch.randn(*shape, generator=draw) for shape in shapes))


def never_renders(cameras, background):
    raise AssertionError("a file of Gaussians needs no picture")


@pytest.mark.parametrize("up", ["-y", "+y", "+z"])
def test_the_asset_reads_back_bit_for_bit_whatever_the_frame(tmp_path, up):
    exporter = PlyExporter(up=up, pad_sh=0)
    assert exporter.export(random_gaussians(), never_renders, tmp_path) == [tmp_path / "asset.ply"]
    back = read_ply(tmp_path / "asset.ply")
    for name, tensor in random_gaussians().tensors().items():
        assert torch.equal(back.tensors()[name], tensor), name


def test_the_file_has_padded_spherical_harmonics(tmp_path):
    PlyExporter(up="-y", pad_sh=3).export(random_gaussians(), never_renders, tmp_path)
    assert read_ply(tmp_path / "asset.ply").sh_degree == 3


def test_wrong_values_name_their_key():
    with pytest.raises(UserError, match=r"exporter\.ply\.up=\+z"):
        PlyExporter(up="z", pad_sh=0)
    with pytest.raises(UserError, match=r"exporter\.ply\.pad_sh: expected one of 0\|1\|2\|3"):
        PlyExporter(up="-y", pad_sh=4)
