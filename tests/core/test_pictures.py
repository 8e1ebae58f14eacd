"""PictureSettings: the settings, checks and cameras that exporters, callbacks and metrics share."""

import torch

from cadam3d.core.cameras import orbit, turntable
from cadam3d.core.pictures import PictureSettings

GIVEN = {"distance": 3.0, "fov_y_deg": 40.0, "size": 16, "background": [1, 0.5, 0]}


def test_cameras_have_the_given_angles_and_settings():
    expected = turntable(3, elevation_deg=20.0, distance=3.0, fov_y_deg=40.0, size=16)
    assert vars_equal(PictureSettings(**GIVEN).ring(3, 20.0), expected)
    angles, full = torch.tensor([0.0, 90.0]), torch.ones(2)
    expected = orbit(angles, angles / 2, full * 3.0, full * 40.0, 16, 16)
    assert vars_equal(PictureSettings(**GIVEN).cameras_at(angles, angles / 2), expected)


def vars_equal(left, right) -> bool:
    return all(
        torch.equal(value, vars(right)[name])
        if isinstance(value, torch.Tensor)
        else value == vars(right)[name]
        for name, value in vars(left).items()
    )
