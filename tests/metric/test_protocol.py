"""Protocols: where the cameras are, and how the values of views become one number."""

from dataclasses import replace

import pytest
import torch
from protocols import output

from cadam3d.build import option
from cadam3d.core.errors import UserError
from cadam3d.metric.protocol import Protocol, RingProtocol, SphereProtocol

PICTURES = {
    "distance": 2.2,
    "fov_y_deg": 60.0,
    "size": 40,
    "background": [0.0, 0.0, 1.0],
    "text": "{}",
    "models": {},
}
RING = RingProtocol(**PICTURES, name="ring", views=4, elevations_deg=[0.0, 30.0])
SPHERE = SphereProtocol(**PICTURES, name="sphere", subdivisions=1, other_fovs_y_deg=[45.0, 30.0], rounds=3)


def test_a_ring_begins_at_the_front():
    azimuths, elevations = RING.cameras.azimuth_deg, RING.cameras.elevation_deg
    assert azimuths.abs().tolist() == [0, 90, 180, 90] * 2
    assert elevations.tolist() == [0.0] * 4 + [30.0] * 4


@pytest.mark.parametrize(("subdivisions", "places"), [(0, 12), (1, 42), (2, 162)])
def test_places_on_the_sphere_are_spread_evenly(subdivisions, places):
    protocol = replace(SPHERE, subdivisions=subdivisions, other_fovs_y_deg=[])
    positions = protocol.cameras.positions.double()
    assert len(positions) == places
    assert positions.norm(dim=1) == pytest.approx(torch.full((places,), 2.2).numpy(), abs=1e-5)
    assert positions.mean(dim=0).abs().max() < 1e-6
    apart = torch.cdist(positions, positions) + 10 * torch.eye(places)
    nearest = apart.amin(dim=1)
    assert nearest.max() < 1.2 * nearest.min()


def test_every_place_has_all_fields_of_view():
    cameras = SPHERE.cameras
    assert len(cameras) == 42 * 3
    focal = cameras.intrinsics[:, 0, 0].reshape(42, 3)
    wanted = 20 / torch.tan(torch.deg2rad(torch.tensor([60.0, 45.0, 30.0])) / 2)
    assert torch.allclose(focal, wanted.expand(42, 3), rtol=1e-5)
    places = cameras.positions.reshape(42, 3, 3)
    assert torch.allclose(places, places[:, :1].expand(-1, 3, -1), atol=1e-6)


def test_equal_values_stay_equal_and_the_best_field_of_view_counts():
    values = torch.full((42, 3), 1.0)
    values[:, 2] = 2.0
    assert SPHERE.aggregate(values.flatten(), less_is_better=False) == pytest.approx(2.0)
    assert SPHERE.aggregate(values.flatten(), less_is_better=True) == pytest.approx(1.0)


def test_smoothing_is_repeated_averages_over_neighbours():
    """The same as loops over places and their neighbours, which are the places within 0.65 of the radius."""
    values = torch.rand(42 * 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    places = SPHERE.cameras.positions.reshape(42, 3, 3)[:, 0].double() / 2.2
    near = [[j for j in range(42) if (places[i] - places[j]).norm() < 0.65] for i in range(42)]
    assert {len(each) for each in near} == {6, 7}
    scores = [float(values.reshape(42, 3)[i].max()) for i in range(42)]
    for _ in range(3):
        scores = [sum(scores[j] for j in each) / len(each) for each in near]
    assert SPHERE.aggregate(values, less_is_better=False) == pytest.approx(max(scores))


def test_the_pictures_are_those_of_the_renderer():
    pictures = torch.rand(4, 40, 40, 3, generator=torch.Generator().manual_seed(0))
    assert all(torch.equal(images, pictures) for images in RING.images(lambda *_: output(pictures)))


@pytest.mark.parametrize("text", ["no place", "{} and {}"])
def test_a_text_has_one_place_for_the_prompt(text):
    with pytest.raises(UserError, match=r"^RingProtocol\.text: expected a text with {} once"):
        replace(RING, text=text)


@pytest.mark.parametrize(
    ("name", "views"),
    [("paper", 12), ("gaussiandreamer", 120), ("dreamfusion", 8), ("shapes", 36), ("t3bench", 810)],
)
def test_a_protocol_has_its_own_name_and_its_published_number_of_views(name, views):
    protocol = option("protocol", name, Protocol) if name in ("paper", "t3bench") else composed(name)
    assert protocol.name == name
    assert len(protocol.cameras) == views


def composed(name):
    from cadam3d.build import component
    from cadam3d.settings.compose import compose

    return component(compose([f"protocol={name}", "prompt=a cube"]).protocol, Protocol)
