"""Commands read assets of every format."""

import pytest
import torch
from omegaconf import OmegaConf

from cadam3d.commands.opened import open_asset
from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.io.compressed_ply import write_compressed_ply
from cadam3d.io.splat import write_splat
from cadam3d.io.spz import write_spz

POINT = Gaussians(
    means=torch.tensor([[0.25, -0.5, 0.75]]),
    log_scales=torch.full((1, 3), -3.0),
    quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
    opacity_logits=torch.zeros(1),
    sh=torch.zeros(1, 1, 3),
)


def opened(path, ply_up=None) -> Gaussians:
    settings = {"run": None, "ply": str(path), "ply_up": ply_up, "device": "cpu"}
    return open_asset(OmegaConf.create(settings)).gaussians


@pytest.mark.parametrize(
    ("name", "write", "usual", "other"),
    [
        ("a.compressed.ply", write_compressed_ply, "-y", "+z"),
        ("a.splat", write_splat, "-y", "+z"),
        ("a.spz", write_spz, "+y", "-y"),
    ],
)
def test_an_asset_is_upright_without_an_axis_or_with_its_own(tmp_path, name, write, usual, other):
    write(tmp_path / name, POINT, up=usual)
    torch.testing.assert_close(opened(tmp_path / name).means, POINT.means, atol=1e-4, rtol=0)
    write(tmp_path / name, POINT, up=other)
    torch.testing.assert_close(opened(tmp_path / name, ply_up=other).means, POINT.means, atol=1e-4, rtol=0)


def test_an_unknown_axis_is_refused_with_the_setting_to_type(tmp_path):
    write_splat(tmp_path / "a.splat", POINT, up="-y")
    with pytest.raises(UserError, match=r"ply_up: expected one of .*, got 'z'\. Try: ply_up="):
        opened(tmp_path / "a.splat", ply_up="z")
