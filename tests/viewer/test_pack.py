"""Snapshots for the browser: the bytes hold what the Gaussians are, and nothing that a page cannot draw."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch
from snapshots import read_snapshot, some_gaussians

from cadam3d.viewer.pack import pack


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_snapshot_holds_the_gaussians(degree):
    gaussians = some_gaussians(50, degree=degree)
    read = read_snapshot(pack(gaussians))
    assert (read.count, read.degree) == (50, degree)
    assert np.array_equal(read.means, gaussians.means.double())
    assert np.allclose(read.log_scales, gaussians.log_scales, atol=2.5e-4)
    assert np.allclose(read.opacities, gaussians.opacities, atol=1e-5)
    assert np.allclose(read.rotations, gaussians.rotations, atol=3e-4)
    assert np.allclose(read.colors, 0.5 + 0.28209479177387814 * gaussians.sh[:, 0], atol=1e-3)
    largest = gaussians.sh[:, 1:].abs().flatten(1).amax(dim=1) if degree else torch.zeros(50)
    assert np.all(np.abs(read.rest - gaussians.sh[:, 1:].numpy()) <= largest.numpy()[:, None, None] / 200)


def test_every_rotation_survives_whatever_its_largest_component():
    quats = torch.cat(
        [torch.eye(4), -torch.eye(4), torch.ones(1, 4), 1e-5 * torch.eye(4), 1e18 * torch.eye(4)]
    )
    gaussians = replace(some_gaussians(len(quats)), quats=quats)
    read = read_snapshot(pack(gaussians))
    assert np.allclose(read.rotations, gaussians.rotations, atol=2e-4)
    # The axes of the world are exact, because objects are often aligned with them.
    assert np.abs(read.rotations[0] - np.eye(3)).max() < 1e-12


def test_the_same_gaussians_give_the_same_bytes_and_stay_as_they_are():
    gaussians, layers = some_gaussians(30, degree=1), {"age": torch.arange(30.0)}
    before = gaussians.map(torch.clone)
    assert pack(gaussians, layers) == pack(before.to(torch.float64), layers)
    for name, tensor in gaussians.tensors().items():
        assert torch.equal(tensor, before.tensors()[name]), name


@pytest.mark.parametrize("name", ["means", "log_scales", "quats", "opacity_logits", "sh"])
@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf])
def test_a_gaussian_that_is_not_finite_is_transparent(name, value):
    gaussians = some_gaussians(20, degree=1)
    getattr(gaussians, name)[3] = value
    read = read_snapshot(pack(gaussians))
    assert read.opacities[3] == 0
    assert np.all(np.delete(read.opacities, 3) > 0)
    for array in (read.low, read.means, read.log_scales, read.rotations, read.colors, read.rest):
        assert np.isfinite(array).all()


def test_gaussians_that_no_rasterizer_shows_are_transparent():
    gaussians = some_gaussians(20)
    gaussians.means[0], gaussians.quats[1] = 2e15, 0.0
    read = read_snapshot(pack(gaussians))
    assert list(np.flatnonzero(read.opacities == 0)) == [0, 1]
    assert read.high.max() < 2


def test_a_camera_shows_the_unit_ball_for_objects_in_our_units():
    read = read_snapshot(pack(some_gaussians(200)))
    assert (list(read.focus), read.radius) == ([0, 0, 0], 1.0)


def test_a_camera_shows_the_whole_object_for_files_in_other_units():
    """A few stray Gaussians do not shrink the object in the picture."""
    ours = some_gaussians(200)
    theirs = replace(ours, means=40 * ours.means + torch.tensor([100.0, 0, 0]))
    theirs.means[:2] = 1e6
    read = read_snapshot(pack(theirs))
    distances = np.linalg.norm(read.means - read.focus, axis=1)
    assert np.quantile(distances, 0.95) < read.radius < 60


def test_a_layer_keeps_the_order_of_its_values_and_where_it_has_none():
    values = torch.linspace(-5, 5, 200)
    values[7] = torch.nan
    values[0], values[-1] = -torch.inf, torch.inf
    low, high, is_log, levels = read_snapshot(pack(some_gaussians(200), {"drift": values})).layers["drift"]
    assert not is_log
    assert -5 < low < -4.5
    assert 4.5 < high < 5
    assert levels[7] == 0
    assert (levels[0], levels[-1]) == (1, 255)
    known = np.delete(levels.astype(int), 7)
    assert (np.diff(known) >= 0).all()
    # A level is the value that a legend from low to high shows there.
    middle = slice(10, 190)
    expected = 1 + 254 * (values[middle].numpy() - low) / (high - low)
    assert np.abs(levels[middle] - expected).max() <= 0.51


def test_values_over_many_powers_of_ten_get_a_logarithmic_axis():
    values = torch.logspace(-6, 2, 200)
    values[0] = 0
    low, high, is_log, levels = read_snapshot(pack(some_gaussians(200), {"snr": values})).layers["snr"]
    assert is_log
    assert 0 < low < 1e-5
    assert high > 50
    assert levels[0] == 1
    assert abs(levels[100].astype(int) - 128) < 4


def test_a_layer_has_a_name_of_its_own_and_one_value_per_gaussian():
    with pytest.raises(AssertionError):
        pack(some_gaussians(5), {"depth": torch.zeros(5)})
    with pytest.raises(AssertionError):
        pack(some_gaussians(5), {"age": torch.zeros(4)})


def test_coefficients_too_large_for_a_product_are_limited_without_a_warning():
    gaussians = some_gaussians(2, degree=1)
    gaussians.sh[:, 1:] = 3e38
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        pack(gaussians)
