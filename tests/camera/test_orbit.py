"""Laws of the orbit sampler."""

import pytest
import torch

from cadam3d.camera.orbit import Orbit
from cadam3d.core.cameras import Cameras
from cadam3d.core.schedule import Steps

RANGES = {
    "size": 40,
    "azimuth_deg": [-180.0, 180.0],
    "elevation_deg": [-10.0, 60.0],
    "elevation_law": "uniform",
    "distance": [2.5, 3.5],
    "fov_y_deg": [40.0, 50.0],
}


def orbit(**changes) -> Orbit:
    return Orbit(**{**RANGES, **changes})


def sample(views: int, seed: int = 0, step: int = 0, **changes) -> Cameras:
    return orbit(**changes).sample(step, views, torch.Generator().manual_seed(seed))


def fov_y_deg(cameras: Cameras) -> torch.Tensor:
    return torch.rad2deg(2 * torch.atan(cameras.height / 2 / cameras.intrinsics[:, 1, 1]))


def test_every_number_fills_its_range_and_stays_inside():
    cameras = sample(5000, azimuth_deg=[-30.0, 90.0])
    for values, (low, high) in (
        (cameras.azimuth_deg, (-30, 90)),
        (cameras.elevation_deg, RANGES["elevation_deg"]),
        (cameras.positions.norm(dim=-1), RANGES["distance"]),
        (fov_y_deg(cameras), RANGES["fov_y_deg"]),
    ):
        width = high - low
        assert low - 1e-3 <= values.min() < low + 0.01 * width
        assert high - 0.01 * width < values.max() <= high + 1e-3
        assert float(values.mean()) == pytest.approx((low + high) / 2, abs=0.02 * width)


@pytest.mark.parametrize("views", [1, 2, 4, 7])
@pytest.mark.parametrize("seed", range(5))
def test_each_stratum_of_azimuth_holds_one_view(views, seed):
    azimuth = sample(views, seed, azimuth_deg=[-90.0, 150.0]).azimuth_deg
    assert ((azimuth + 90) / 240 * views).floor().tolist() == list(range(views))


def test_cameras_look_at_the_origin_and_are_upright():
    cameras = sample(50)
    origin, above = torch.zeros(3), torch.tensor([0.0, 0.0, 0.1])
    for point, is_above in ((origin, False), (above, True)):
        seen = cameras.world_to_camera[:, :3, :3] @ point + cameras.world_to_camera[:, :3, 3]
        pixels = (cameras.intrinsics @ seen[..., None])[..., 0]
        pixels = pixels[:, :2] / pixels[:, 2:]
        torch.testing.assert_close(pixels[:, 0], torch.full((50,), 20.0), atol=1e-3, rtol=0)
        assert ((pixels[:, 1] < 19.9) == is_above).all()


@pytest.mark.parametrize(("law", "power"), [("uniform", 0), ("sphere", 1)])
def test_the_elevation_law_sets_how_often_the_top_is_seen(law, power):
    elevation = sample(40_000, elevation_deg=[0.0, 90.0], elevation_law=law).elevation_deg
    above_30 = float((elevation > 30).float().mean())
    assert above_30 == pytest.approx([2 / 3, 1 / 2][power], abs=0.01)  # by angle, or by area: 1 - sin 30


def test_the_mixture_is_uniform_in_degrees_in_half_of_the_steps_and_threestudios_law_in_the_others():
    steps = [sample(64, seed, elevation_law="mixture").elevation_deg for seed in range(300)]
    # Some of 64 uniform views are above 45 degrees.
    is_wide = [bool(views.max() > 45) for views in steps]
    assert sum(is_wide) / 300 == pytest.approx(0.5, abs=0.1)
    wide = torch.cat([views for views, yes in zip(steps, is_wide, strict=True) if yes])
    other = torch.cat([views for views, yes in zip(steps, is_wide, strict=True) if not yes])
    assert (float(wide.min()), float(wide.max())) == pytest.approx((-10, 60), abs=0.1)
    assert float(wide.mean()) == pytest.approx(25, abs=1)
    assert (float(other.min()), float(other.max())) == pytest.approx((-6.38, 41.81), abs=0.1)  # asin(e / 90)
    assert float(torch.deg2rad(other).sin().mean()) == pytest.approx(25 / 90, abs=0.01)


def test_the_mixture_draws_equally_many_numbers_in_both_cases():
    states = {}
    for seed in range(10):
        generator = torch.Generator().manual_seed(seed)
        orbit(elevation_law="mixture").sample(0, 3, generator)
        after = torch.rand(1, generator=generator)
        generator.manual_seed(seed)
        # These are the draws for azimuth, choice of the law, elevation, distance and lens.
        torch.rand(3 + 1 + 3 + 3 + 3, generator=generator)
        states[seed] = torch.equal(after, torch.rand(1, generator=generator))
    assert all(states.values())


def test_the_size_may_follow_the_step():
    growing = Steps(values=[128, 256, 512], milestones=[150, 300])
    sizes = {step: sample(1, step=step, size=growing) for step in (0, 149, 150, 299, 300, 499)}
    assert [cameras.height for cameras in sizes.values()] == [128, 128, 256, 256, 512, 512]
    assert all(cameras.width == cameras.height for cameras in sizes.values())
    lenses = torch.stack([fov_y_deg(cameras) for cameras in sizes.values()])
    torch.testing.assert_close(lenses, lenses[:1].expand_as(lenses), atol=1e-3, rtol=0)


def test_a_range_may_be_one_point():
    cameras = sample(3, elevation_deg=[20.0, 20.0], distance=[3.0, 3.0], fov_y_deg=[45.0, 45.0])
    torch.testing.assert_close(cameras.elevation_deg, torch.full((3,), 20.0))
    torch.testing.assert_close(cameras.positions.norm(dim=-1), torch.full((3,), 3.0))
