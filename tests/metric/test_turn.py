"""The turn at which an asset fits: known turns are found, and all metrics compare there."""

import math
from dataclasses import replace
from functools import partial

import pytest
import torch
from splats import make_gaussians

from cadam3d.core.cameras import vertical_turn
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.mesh import distance
from cadam3d.core.mesh.distance import true_surfaces
from cadam3d.core.rendering import Truth
from cadam3d.metric import mesh, turn
from cadam3d.metric.base import Measurand
from cadam3d.metric.fidelity import Fidelity
from cadam3d.metric.mesh import MeshMetric
from cadam3d.metric.outline import Outline
from cadam3d.metric.turn import facing
from cadam3d.rasterizer.base import render_fn
from cadam3d.rasterizer.reference import ReferenceRasterizer

# Forty degrees apart, so that an asset that is turned by 40 degrees looks the same from the next view.
VIEWS = {
    "views": 9,
    "elevations_deg": [20.0],
    "distance": 3.0,
    "fov_y_deg": 40.0,
    "background": [1.0, 1.0, 1.0],
}
FIDELITY = Fidelity(**VIEWS, size=16)
OUTLINE = Outline(**VIEWS, size=16)


@pytest.fixture(autouse=True)
def small_pictures(monkeypatch):
    monkeypatch.setattr(turn, "SIZE", 24)
    monkeypatch.setattr(turn, "ELEVATIONS_DEG", (20.0,))


def shown(gaussians: Gaussians):
    return render_fn(ReferenceRasterizer(), lambda: gaussians)


def seen(gaussians: Gaussians, truth: Truth) -> Measurand:
    return Measurand(gaussians=gaussians, render=shown(gaussians), prompt="five blobs", truth=truth)


def true_object(**changes) -> Truth:
    """Return a truth that consists of five Gaussians with different places and colours."""
    render = shown(asset())
    truth = Truth(
        images=lambda cameras, background: render(cameras, background).rgb[None],
        alpha=lambda cameras: render(cameras, torch.ones(len(cameras), 3)).alpha[None],
        turns=9,
    )
    return replace(truth, **changes)


def asset() -> Gaussians:
    return make_gaussians(5, spread=0.4, log_scale=-1.7, opacity=4.0)


def turned(gaussians: Gaussians, turn_deg: float) -> Gaussians:
    """Turn Gaussians around the vertical axis, counterclockwise seen from above."""
    half = math.radians(turn_deg) / 2
    a, d = math.cos(half), math.sin(half)
    w, x, y, z = gaussians.quats.unbind(1)
    quats = torch.stack([a * w - d * z, a * x - d * y, a * y + d * x, a * z + d * w], dim=1)
    matrix = vertical_turn(turn_deg, gaussians.means)[:3, :3]
    return replace(gaussians, means=gaussians.means @ matrix.T, quats=quats)


def worn() -> Gaussians:
    """Return an asset whose colours are only nearly right."""
    return replace(asset(), sh=0.7 * asset().sh)


@pytest.mark.parametrize(("turns", "turn_deg"), [(24, -153.0), (9, 40.0), (4, 180.0)])
def test_a_turned_asset_is_found_at_its_turn(turns, turn_deg):
    truth = true_object(turns=turns)
    assert facing(truth, shown(turned(asset(), turn_deg))).turn_deg == pytest.approx(turn_deg)


def test_the_numbers_at_the_turn_are_those_of_the_asset_that_was_not_turned():
    straight = facing(true_object(), shown(worn()))
    askew = facing(true_object(), shown(turned(worn(), 40.0)))
    assert (straight.turn_deg, askew.turn_deg) == (0.0, 40.0)
    before = FIDELITY.measure(seen(worn(), straight)).numbers
    after = FIDELITY.measure(seen(turned(worn(), 40.0), askew)).numbers
    assert after["psnr_turned"] == pytest.approx(before["psnr"], abs=0.01)
    assert after["ssim_turned"] == pytest.approx(before["ssim"], abs=1e-3)
    assert after["psnr"] < before["psnr"] - 3
    before = OUTLINE.measure(seen(worn(), straight)).numbers
    after = OUTLINE.measure(seen(turned(worn(), 40.0), askew)).numbers
    assert after == pytest.approx(before, abs=1e-2)


def test_a_round_object_has_no_turn():
    ball = Gaussians(
        torch.zeros(1, 3), torch.full((1, 3), -1.0), torch.eye(4)[:1], torch.ones(1), torch.ones(1, 1, 3)
    )
    assert facing(true_object(), shown(ball)).turn_deg == 0.0


def test_a_truth_that_knows_the_front_is_not_turned():
    truth = true_object(turns=None)

    def never(*_):
        raise AssertionError("rendered although the front is known")

    assert facing(truth, never) is truth
    assert truth.turned() is truth
    assert set(FIDELITY.measure(seen(worn(), truth)).numbers) == {"psnr", "psnr_min", "ssim", "mode"}


def test_the_best_mode_decides_the_turn():
    right = true_object()
    wrong = shown(replace(asset(), sh=-asset().sh))

    def images(cameras, background):
        return torch.cat([wrong(cameras, background).rgb[None], right.images(cameras, background)])

    assert facing(replace(right, images=images), shown(turned(asset(), 40.0))).turn_deg == 40.0


def test_the_start_is_compared_with_the_images_of_the_turned_asset():
    truth = replace(true_object(), turn_deg=40.0)
    start = turned(worn(), 40.0)
    straight = FIDELITY.measure(seen(worn(), true_object())).numbers
    assert FIDELITY.measure_start(seen(start, truth))["psnr_start"] == pytest.approx(
        straight["psnr"], abs=0.01
    )


def test_the_true_surface_turns_too(monkeypatch):
    """A ball beside the axis, which is somewhere else after the turn."""
    monkeypatch.setattr(distance, "TRUE_NODES", 64)
    monkeypatch.setattr(distance, "CELL", 2 / 64)
    monkeypatch.setattr(mesh, "GUIDES", 5000)

    def ball(points):
        return (points - torch.tensor([0.4, 0.0, 0.0]).to(points)).norm(dim=1)[None] - 0.3

    truth = true_object(surfaces=partial(true_surfaces, ball), turn_deg=90.0).turned()
    assert truth.surfaces is not None
    [(vertices, _)] = truth.surfaces()
    assert vertices.mean(axis=0) == pytest.approx([0.0, 0.4, 0.0], abs=0.01)
    settings = {"resolution": 16, "level": 0.3, "smallest_part": 0.0, "triangles": None}
    metric = MeshMetric(**settings, threshold=0.1, samples=200, seed=0)
    blob = replace(
        worn().index(slice(0, 1)), means=torch.tensor([[0.0, 0.4, 0.0]]), opacity_logits=torch.tensor([4.0])
    )
    blob = replace(blob, log_scales=torch.full((1, 3), -1.9))
    measured = metric.measure(
        seen(blob, true_object(surfaces=partial(true_surfaces, ball), turn_deg=90.0))
    ).numbers
    assert measured["mesh_chamfer"] < 0.1
