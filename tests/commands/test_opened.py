"""Commands read assets of every format, in the axes that the user states."""

import pytest
import torch
from formats import random_gaussians
from omegaconf import OmegaConf

from cadam3d.commands.opened import open_asset
from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.io.spz import write_spz


def opened(path, ply_up=None) -> Gaussians:
    settings = {"run": None, "ply": str(path), "ply_up": ply_up, "device": "cpu"}
    return open_asset(OmegaConf.create(settings)).gaussians


def test_an_asset_is_upright_without_an_axis_or_with_its_own(tmp_path):
    for written, given in (("-y", None), ("+y", "+y")):
        write_spz(tmp_path / "a.spz", random_gaussians(5), up=written)
        found = opened(tmp_path / "a.spz", ply_up=given).means
        torch.testing.assert_close(found, random_gaussians(5).means, atol=1e-4, rtol=0)
    with pytest.raises(UserError, match=r"ply_up: expected one of .*, got 'z'\. Try: ply_up="):
        opened(tmp_path / "a.spz", ply_up="z")
