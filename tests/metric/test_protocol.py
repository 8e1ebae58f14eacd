"""Protocols: where the cameras are, and how the values of views become one number."""

from dataclasses import replace

import pytest
import torch
from protocols import output

from cadam3d.core.errors import UserError
from cadam3d.metric.protocol import Protocol

PICTURES = {
    "distance": 2.2,
    "fov_y_deg": 60.0,
    "size": 40,
    "background": [0.0, 0.0, 1.0],
    "text": "{}",
    "models": {},
}
RING = Protocol(**PICTURES, name="ring", views=4, elevations_deg=[0.0, 30.0])


def test_a_ring_begins_at_the_front():
    azimuths, elevations = RING.cameras.azimuth_deg, RING.cameras.elevation_deg
    assert azimuths.abs().tolist() == [0, 90, 180, 90] * 2
    assert elevations.tolist() == [0.0] * 4 + [30.0] * 4


def test_the_pictures_are_those_of_the_renderer():
    pictures = torch.rand(4, 40, 40, 3, generator=torch.Generator().manual_seed(0))
    assert all(torch.equal(images, pictures) for images in RING.images(lambda *_: output(pictures)))


@pytest.mark.parametrize("text", ["no place", "{} and {}"])
def test_a_text_has_one_place_for_the_prompt(text):
    with pytest.raises(UserError, match=r"^Protocol\.text: expected a text with {} once"):
        replace(RING, text=text)


@pytest.mark.parametrize(
    ("name", "views"),
    [("paper", 12), ("gaussiandreamer", 120), ("dreamfusion", 8), ("shapes", 36)],
)
def test_a_protocol_has_its_own_name_and_its_published_number_of_views(name, views):
    protocol = composed(name)
    assert protocol.name == name
    assert len(protocol.cameras) == views


def composed(name):
    from cadam3d.build import component
    from cadam3d.settings.compose import compose

    return component(compose([f"protocol={name}", "prompt=a cube"]).protocol, Protocol)
