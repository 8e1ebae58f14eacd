"""Fidelity: known numbers for known errors, and the right mode of a mixture."""

import pytest
import torch
from protocols import output
from splats import make_gaussians

from cadam3d.core.cameras import turntable
from cadam3d.core.rendering import Truth
from cadam3d.metric.base import Measurand
from cadam3d.metric.fidelity import Fidelity

SETTINGS = {
    "views": 3,
    "elevations_deg": [0.0, 30.0],
    "distance": 3.0,
    "fov_y_deg": 40.0,
    "size": 16,
    "background": [1.0, 1.0, 1.0],
}


def scene(cameras, background):
    """Return a smooth picture that depends on the view and the background: "v h w 3"."""
    size = cameras.height
    ramp = torch.linspace(0.2, 0.8, size)
    picture = torch.stack(
        [ramp.expand(size, size), ramp[:, None].expand(size, size), torch.full((size, size), 0.5)], -1
    )
    turn = torch.deg2rad(cameras.azimuth_deg).sin()[:, None, None, None]
    return picture + 0.1 * turn + 0.05 * (background[:, None, None] - 1)


def renders(shift):
    def render(cameras, background):
        return output(scene(cameras, background) + shift)

    return render


def truths(*shifts):
    def truth(cameras, background):
        return torch.stack([scene(cameras, background) + shift for shift in shifts])

    return truth


def measure(render, truth, **changes):
    measurement = Fidelity(**{**SETTINGS, **changes}).measure(
        Measurand(
            gaussians=make_gaussians(0),
            render=render,
            prompt="a cube",
            truth=None if truth is None else Truth(truth),
        )
    )
    return measurement.numbers


@pytest.mark.parametrize(("error", "psnr"), [(0.1, 20.0), (-0.1, 20.0), (0.01, 40.0)])
def test_a_constant_error_has_the_psnr_of_its_square(error, psnr):
    measured = measure(renders(error), truths(0.0))
    assert measured["psnr"] == pytest.approx(psnr, abs=1e-3)
    assert measured["psnr_min"] == pytest.approx(psnr, abs=1e-3)


def test_equal_images_have_a_psnr_of_100_db():
    assert measure(renders(0.0), truths(0.0)) == {
        "psnr": 100.0,
        "psnr_min": 100.0,
        "ssim": pytest.approx(1.0),
        "mode": 0.0,
    }


def test_views_are_averaged_in_db_and_the_worst_one_is_kept():
    def truth(cameras, background):
        wrong = 0.1 * (cameras.elevation_deg > 10) + 0.01 * (cameras.elevation_deg < 10)
        return (scene(cameras, background) + wrong[:, None, None, None])[None]

    measured = measure(renders(0.0), truth)
    assert measured["psnr"] == pytest.approx(30.0, abs=1e-3)
    assert measured["psnr_min"] == pytest.approx(20.0, abs=1e-3)


def test_renders_are_clamped_before_they_are_compared():
    def white(cameras, background):
        return torch.ones(1, len(cameras), cameras.height, cameras.width, 3)

    assert measure(renders(5.0), white)["psnr"] == 100.0


def test_ssim_of_flat_images_is_its_luminance_term():
    def flat(level):
        return lambda cameras, _: torch.full((1, len(cameras), cameras.height, cameras.width, 3), level)

    def render(cameras, background):
        return output(flat(0.4)(cameras, background)[0])

    c1 = 0.01**2
    expected = (2 * 0.4 * 0.6 + c1) / (0.4**2 + 0.6**2 + c1)
    assert measure(render, flat(0.6))["ssim"] == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize("right", [0, 1, 2])
def test_the_nearest_mode_is_found_and_scored(right):
    shifts = [0.1, 0.1, 0.1]
    shifts[right] = 0.01
    measured = measure(renders(0.0), truths(*shifts))
    assert measured["mode"] == right
    assert measured["psnr"] == pytest.approx(40.0, abs=1e-3)
    assert measured["psnr_min"] == pytest.approx(40.0, abs=1e-3)  # of that mode, not of all


def test_one_mode_counts_for_all_views():
    def truth(cameras, background):
        """Make each mode right at one elevation only; the first is a little closer at the other one."""
        low = (cameras.elevation_deg < 10)[:, None, None, None]
        right = scene(cameras, background)
        return torch.stack([right + torch.where(low, 0.01, 0.08), right + torch.where(low, 0.1, 0.01)])

    measured = measure(renders(0.0), truth)
    assert measured["mode"] == 0
    assert measured["psnr"] < 32  # a choice of the mode per view would give 40 dB


def test_without_true_images_there_are_no_numbers():
    def never(cameras, background):
        raise AssertionError("rendered although there are no true images")

    assert measure(never, None) == {}


def test_held_out_views_are_not_those_of_a_turntable_and_no_two_are_alike():
    fidelity = Fidelity(**{**SETTINGS, "views": 12, "elevations_deg": [-10.0, 20.0, 50.0]})
    azimuths = fidelity.cameras().azimuth_deg % 360
    assert len(azimuths) == len(set(azimuths.tolist())) == 36
    shown = turntable(12, elevation_deg=0.0, distance=3.0, fov_y_deg=40.0, size=8).azimuth_deg % 360
    apart = (azimuths[:, None] - shown + 180) % 360 - 180
    assert apart.abs().min() > 4
    assert sorted(set(fidelity.cameras().elevation_deg.tolist())) == [-10.0, 20.0, 50.0]


def test_render_and_truth_have_the_same_background():
    seen = []

    def truth(cameras, background):
        seen.append(background)
        return scene(cameras, background)[None]

    assert measure(renders(0.0), truth, background=[0.0, 0.25, 1.0])["psnr"] == 100.0
    assert all((background == torch.tensor([0.0, 0.25, 1.0])).all() for background in seen)
