"""PictureSettings: the settings, checks and cameras that exporters, callbacks and metrics share."""

from dataclasses import dataclass
from typing import ClassVar

import pytest
import torch

from cadam3d.core.cameras import orbit, turntable
from cadam3d.core.errors import UserError
from cadam3d.core.pictures import PictureSettings

GIVEN = {"distance": 3.0, "fov_y_deg": 40.0, "size": 16, "background": [1, 0.5, 0]}


@dataclass(frozen=True, kw_only=True)
class Postcard(PictureSettings):
    node: ClassVar[str] = "exporter.postcard"


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("distance", 0),
        ("fov_y_deg", 180),
        ("size", 0),
        ("size", 2.5),
        ("background", [1, 1]),
        ("background", [1, 1, 2]),
    ],
)
def test_an_impossible_setting_is_refused_with_the_node_of_its_owner(key, value):
    with pytest.raises(UserError, match=rf"^exporter\.postcard\.{key}: expected"):
        Postcard(**GIVEN | {key: value})


def test_cameras_have_the_given_angles_and_settings():
    expected = turntable(3, elevation_deg=20.0, distance=3.0, fov_y_deg=40.0, size=16)
    assert vars_equal(Postcard(**GIVEN).ring(3, 20.0), expected)
    angles, full = torch.tensor([0.0, 90.0]), torch.ones(2)
    expected = orbit(angles, angles / 2, full * 3.0, full * 40.0, 16, 16)
    assert vars_equal(Postcard(**GIVEN).cameras_at(angles, angles / 2), expected)


def vars_equal(left, right) -> bool:
    return all(
        torch.equal(value, vars(right)[name])
        if isinstance(value, torch.Tensor)
        else value == vars(right)[name]
        for name, value in vars(left).items()
    )
