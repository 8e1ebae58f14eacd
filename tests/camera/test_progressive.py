"""Laws of the progressive sampler."""

import math
from itertools import pairwise

import pytest
import torch

from cadam3d.build import component
from cadam3d.camera.progressive import Progressive, Widening
from cadam3d.core.cameras import Cameras
from cadam3d.settings.compose import compose

STILL = {"position_jitter": 0.0, "target_jitter": 0.0, "up_jitter": 0.0}


def published(*lines: str) -> Progressive:
    cfg = compose(["prompt=a red cube", "camera=progressive", "steps=5000", *lines])
    return component(cfg.camera, key="camera")


def changed(sampler: Progressive, **changes) -> Progressive:
    return Progressive(**{**vars(sampler), **changes})


def draw(sampler: Progressive, views: int = 4, step: int = 0, seed: int = 0) -> Cameras:
    return sampler.sample(step, views, torch.Generator().manual_seed(seed))


def fov_y_deg(cameras: Cameras) -> torch.Tensor:
    return torch.rad2deg(2 * torch.atan(cameras.height / 2 / cameras.intrinsics[:, 1, 1]))


def widening(start, end, factor, about=0.0) -> Widening:
    return Widening(start=start, end=end, factor=factor, about=about)


@pytest.mark.parametrize(
    ("step", "narrowest"), [(0, 0.32), (499, 0.32), (500, 0.24), (1000, 0.18), (1500, 0.16), (4999, 0.16)]
)
def test_the_field_of_view_narrows_as_published(step, narrowest):
    sampler = published()
    low, high = (math.radians(degrees) for degrees in sampler.fov_y_deg.at(sampler.widenings(step)))
    assert (low, high) == pytest.approx((narrowest, 0.60), abs=1e-4)


@pytest.mark.parametrize(
    ("step", "radii"), [(0, (5.2, 5.5)), (500, (4.94, 5.225)), (1000, (4.693, 5.0)), (4000, (3.5, 5.0))]
)
def test_the_cameras_come_closer_as_published_with_all_lengths_doubled(step, radii):
    sampler = published()
    assert sampler.distance.at(sampler.widenings(step)) == pytest.approx([2 * r for r in radii], abs=1e-3)


def test_heads_are_seen_all_around_after_two_widenings():
    heads = published("camera.azimuth_deg.start=[-80,80]")
    ranges = [heads.azimuth_deg.at(heads.widenings(step)) for step in (0, 500, 1000, 1500)]
    assert ranges == [pytest.approx((-end, end)) for end in (80, 120, 180, 180)]


def test_elevations_widen_as_published_polar_angles_do():
    """Polar [60, 90] becomes [60 / 1.5, 90 * 1.5], clamped to [45, 105], in one step as published."""
    sampler = published("camera.elevation_deg.start=[0,30]")
    assert sampler.elevation_deg.at(0) == pytest.approx((0, 30))
    assert sampler.elevation_deg.at(1) == pytest.approx((-15, 45))


def test_the_closed_form_equals_step_by_step_multiplication():
    for start, end, factor, about in (
        ([18.0, 34.0], [9.0, 60.0], [0.75, 1.1], 0.0),
        ([-80.0, 80.0], [-180.0, 180.0], [1.5, 1.5], 0.0),
        ([0.0, 30.0], [-15.0, 45.0], [1.1, 0.9], 90.0),
    ):
        moving = widening(start, end, factor, about)
        ends = list(start)
        for count in range(30):
            assert moving.at(count) == pytest.approx(ends)
            for side in (0, 1):
                moved = about + (ends[side] - about) * factor[side]
                ends[side] = max(moved, end[side]) if end[side] < start[side] else min(moved, end[side])
        assert moving.at(10**6) == pytest.approx(end)


@pytest.mark.parametrize(
    ("begin", "every", "steps"), [(500, 500, [500, 1000]), (300, 500, [500, 1000]), (600, 500, [1000, 1500])]
)
def test_widenings_are_at_multiples_from_begin_on(begin, every, steps):
    sampler = changed(published(), begin=begin, every=every)
    counts = [sampler.widenings(step) for step in range(1501)]
    assert [step for step in range(1, 1501) if counts[step] > counts[step - 1]][:2] == steps
    assert counts[0] == 0
    assert max(b - a for a, b in pairwise(counts)) == 1


@pytest.mark.parametrize("begin", [0, 1])
def test_the_first_step_never_uses_a_widened_range(begin):
    sampler = changed(published(), begin=begin, every=1)
    assert [sampler.widenings(step) for step in range(4)] == [0, 1, 2, 3]


def test_every_number_fills_its_range_and_stays_inside():
    cameras = draw(changed(published(), **STILL), views=5000, step=700)
    for values, low, high in (
        (cameras.azimuth_deg, -180, 180),
        (cameras.elevation_deg, -15, 45),
        (cameras.positions.norm(dim=-1), 2 * 4.94, 2 * 5.225),
    ):
        width = high - low
        assert low - 1e-3 <= values.min() < low + 0.01 * width
        assert high - 0.01 * width < values.max() <= high + 1e-3
        assert float(values.mean()) == pytest.approx((low + high) / 2, abs=0.02 * width)


def test_views_of_a_step_share_one_field_of_view_that_fills_its_range():
    sampler = published()
    lenses = torch.stack([fov_y_deg(draw(sampler, seed=seed)) for seed in range(400)])
    assert (lenses == lenses[:, :1]).all()
    assert math.degrees(0.32) - 1e-2 <= lenses.min() < 18.6
    assert 34.1 < lenses.max() <= math.degrees(0.60) + 1e-2


@pytest.mark.parametrize("gamma", [1.0, 1.5, 3.0])
def test_gamma_sets_how_close_to_the_middle_most_views_are(gamma):
    cameras = draw(changed(published(), gamma=gamma), views=40_000)
    for values, middle, half in ((cameras.azimuth_deg, 0, 180), (cameras.elevation_deg, 15, 30)):
        within_half = ((values - middle).abs() < half / 2).float().mean()
        assert float(within_half) == pytest.approx(0.5 ** (1 / gamma), abs=0.01)


def test_without_jitter_cameras_look_at_the_origin_and_are_upright():
    cameras = draw(changed(published(), **STILL, size=40), views=50)
    origin, above = torch.zeros(3), torch.tensor([0.0, 0.0, 0.1])
    for point, is_above in ((origin, False), (above, True)):
        seen = cameras.world_to_camera[:, :3, :3] @ point + cameras.world_to_camera[:, :3, 3]
        pixels = (cameras.intrinsics @ seen[..., None])[..., 0]
        pixels = pixels[:, :2] / pixels[:, 2:]
        torch.testing.assert_close(pixels[:, 0], torch.full((50,), 20.0), atol=1e-3, rtol=0)
        assert ((pixels[:, 1] < 19.99) == is_above).all()


def test_each_jitter_has_its_published_size():
    """Measured at twice LucidDreamer's numbers, since our units are half of its."""
    still = draw(changed(published(), **STILL), views=20_000)
    shaken = draw(changed(published(), **{**STILL, "position_jitter": 0.05}), views=20_000)
    moved = shaken.positions - still.positions
    assert float(moved.abs().max()) == pytest.approx(0.05, abs=1e-3)
    assert float(moved.std()) == pytest.approx(0.05 / 3**0.5, abs=1e-3)

    aimed = draw(changed(published(), **{**STILL, "target_jitter": 0.1}), views=20_000)
    forward, distance = aimed.world_to_camera[:, 2, :3], aimed.positions.norm(dim=-1, keepdim=True)
    # This is about the point of the view axis that is nearest to the origin.
    missed = aimed.positions + forward * distance
    assert float(missed.square().sum(-1).mean().sqrt()) == pytest.approx(0.1 * 2**0.5, abs=3e-3)

    tilted = draw(changed(published(), **{**STILL, "up_jitter": 0.01}), views=20_000)
    roll = (tilted.world_to_camera[:, 0, :3] * still.world_to_camera[:, 1, :3]).sum(-1)
    assert float(roll.std()) == pytest.approx(0.01, abs=1e-3)


def test_jittered_cameras_stay_rigid():
    rotation = draw(published("camera.up_jitter=0.5"), views=200).world_to_camera[:, :3, :3]
    torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3).expand(200, 3, 3), atol=1e-5, rtol=0)
    torch.testing.assert_close(torch.linalg.det(rotation), torch.ones(200), atol=1e-5, rtol=0)
