"""Janus: one front is right, more are worse, and neither the turn nor the symmetry of an object matters."""

import math
from dataclasses import replace

import pytest
import torch
from composed import composed
from protocols import output
from splats import make_gaussians

from cadam3d.build import component, components
from cadam3d.core.cameras import turntable
from cadam3d.core.gaussians import Gaussians, concatenate
from cadam3d.core.rendering import Truth
from cadam3d.metric.base import Measurand, Measurement, Metric
from cadam3d.metric.janus import VIEWS, Janus
from cadam3d.metric.scoring import Scorer
from cadam3d.rasterizer.reference import ReferenceRasterizer

SETTINGS = dict(components(composed("prompt=a", "metric=[janus]").metric, Metric, key="metric"))
ONE = make_gaussians(1)


def metric(**changes) -> Janus:
    return replace(SETTINGS["janus"], **changes)


# --- by the truth, on prior=shapes -----------------------------------------------------------------------


class Ring:
    """The true pictures of a prompt from all azimuths that the metric uses, over black and over white."""

    def __init__(self, prompt: str):
        cfg = composed("prompt=a cube", "prior.samples_per_pixel=1")
        self.truth = component(cfg.prior).truth(prompt)
        self.pictures = {}

    def __call__(self, cameras, background):
        rows = [self.row(float(azimuth) % 360, float(background[0, 0])) for azimuth in cameras.azimuth_deg]
        return torch.stack(rows)[None]

    def row(self, azimuth: float, level: float):
        if (azimuth, level) not in self.pictures:
            cameras = turntable(VIEWS, elevation_deg=15.0, distance=3.0, fov_y_deg=40.0, size=48)
            for each in (0.0, 1.0):
                images = self.truth.images(cameras, torch.full((VIEWS, 3), each))[0]
                self.pictures |= {
                    (round(float(at) % 360), each): image
                    for at, image in zip(cameras.azimuth_deg, images, strict=True)
                }
        return self.pictures[round(azimuth) % 360, level]


def measured(ring: Ring, asset, **changes):
    """Return what the metric says about an asset, which is a function from an azimuth to true azimuths.

    The asset shows the true view of each of them with its weight.
    """

    def render(cameras, background):
        level = float(background[0, 0])
        rows = [
            sum(weight * ring.row(at % 360, level) for at, weight in asset(round(float(azimuth) % 360)))
            for azimuth in cameras.azimuth_deg
        ]
        return output(torch.stack(rows))

    measurand = Measurand(gaussians=ONE, render=render, prompt="a car", truth=Truth(ring), **changes)
    return metric().measure(measurand)


def itself(azimuth):
    return [(azimuth, 1.0)]


def faces(count, share=1.0):
    """Return an asset that repeats the front ``count`` times around, blended into the true object."""
    width = 360 // count

    def asset(azimuth):
        return [((azimuth + width // 2) % width - width // 2, share), (azimuth, 1 - share)]

    return asset


@pytest.fixture(scope="module")
def car():
    return Ring("a car")


def test_the_true_object_has_one_front_and_is_perfect(car):
    assert measured(car, itself).numbers == {"janus": 0.0, "janus_fronts": 1.0}


@pytest.mark.parametrize("turn", [15, 90, 180])
def test_a_turned_asset_is_as_good(car, turn):
    found = measured(car, lambda azimuth: [(azimuth + turn, 1.0)]).numbers
    assert found == {"janus": pytest.approx(0, abs=1e-9), "janus_fronts": 1.0}


@pytest.mark.parametrize("count", [2, 3, 4])
def test_equal_fronts_are_counted_and_cost_their_share(car, count):
    found = measured(car, faces(count)).numbers
    assert found["janus_fronts"] == count
    # Where one front ends and the next begins, views look like both.
    assert found["janus"] == pytest.approx(1 - 1 / count, abs=0.09)


def test_a_clearer_second_front_is_worse(car):
    found = [measured(car, faces(2, share)).numbers["janus"] for share in (0, 0.2, 0.4, 0.5, 0.6, 0.8, 1)]
    assert found == sorted(found)
    assert found[0] < 0.001
    assert 0.15 < found[3] < 0.35
    assert found[-1] > 0.4


def test_an_object_that_looks_alike_from_four_sides_is_not_punished():
    cube = Ring("a red cube")
    assert measured(cube, itself).numbers == {"janus": 0.0, "janus_fronts": 1.0}
    found = measured(cube, faces(2)).numbers
    assert found["janus"] < 0.05
    assert found["janus_fronts"] == 1


@pytest.mark.parametrize("prompt", ["a white ball", "a red cone"])
def test_an_object_that_looks_the_same_from_all_sides_has_no_number(prompt):
    found = measured(Ring(prompt), itself)
    assert found.numbers == {}
    assert found.details["janus"]["value"] is None
    assert "the same from all sides" in found.details["janus"]["reason"]


def test_the_best_mode_of_an_open_prompt_counts(car):
    def modes(cameras, background):
        own = car(cameras, background)
        return torch.cat([own.flip(-1), own])

    measurand = Measurand(
        gaussians=ONE,
        render=lambda cameras, background: output(car(cameras, background)[0]),
        prompt="",
        truth=Truth(modes),
    )
    assert metric().measure(measurand).numbers["janus"] == 0


def test_gaussians_with_two_faces_are_worse_than_with_one():
    generator = torch.Generator().manual_seed(0)
    means = torch.nn.functional.normalize(torch.randn(80, 3, generator=generator), dim=-1) * 0.7
    object_ = Gaussians(
        means=means,
        log_scales=torch.full((80, 3), math.log(0.09)),
        quats=torch.tensor([1.0, 0, 0, 0]).expand(80, 4).clone(),
        opacity_logits=torch.full((80,), 4.0),
        sh=(torch.rand(80, 1, 3, generator=generator) - 0.5) * 3,
    )
    is_front = means[:, 0] > 0
    turned = replace(object_, means=means * torch.tensor([-1.0, -1.0, 1.0]))
    two_faces = concatenate([object_.index(is_front), turned.index(is_front)])
    rasterizer = ReferenceRasterizer()

    def renderer(gaussians):
        return lambda cameras, background: rasterizer.render(gaussians, cameras, background)

    truth = Truth(lambda cameras, background: renderer(object_)(cameras, background).rgb[None])
    found = [
        metric().measure(Measurand(gaussians=each, render=renderer(each), prompt="", truth=truth)).numbers
        for each in (object_, turned, two_faces)
    ]
    assert found[0]["janus"] == pytest.approx(0, abs=1e-6)
    assert found[1]["janus"] < 0.01
    assert found[2]["janus"] > 0.35
    assert [each["janus_fronts"] for each in found] == [1, 1, 2]


# --- by a model -------------------------------------------------------------------------------------------

# What the stand-in takes for each side: red, green and blue pictures.
CHANNELS = {"front": 0, "side": 1, "back": 2}


class ByEye(Janus):
    """The metric with a stand-in for CLIP, which reads the side off the colour of a picture."""

    def scorer(self, device):
        def score(images, text):
            side = text.split(" view of ")[0]
            return 10 * images[..., CHANNELS[side]].mean(dim=(1, 2))

        return Scorer(score=score, facts={"model": "a stand-in"})


def seen(*fronts_deg, heights=(), contrast=1.0, **changes):
    """Return what the stand-in says about an asset with a front at each azimuth."""
    heights = heights or (1.0,) * len(fronts_deg)

    def render(cameras, background):
        colors = []
        for azimuth in cameras.azimuth_deg.tolist():
            near = [
                height * max(0.0, math.cos(math.radians(azimuth - front)))
                for front, height in zip(fronts_deg, heights, strict=True)
            ]
            front = contrast * max(near)
            colors.append([front, 0.5 * (1 - front), 0.5 * (1 - front)])
        size = cameras.height
        return output(torch.tensor(colors)[:, None, None].expand(-1, size, size, 3))

    settings = {**vars(metric(by="model")), **changes}
    measurand = Measurand(gaussians=ONE, render=render, prompt="a corgi")
    return ByEye(**settings).measure(measurand)


def test_a_model_sees_one_front():
    found = seen(0)
    assert found.numbers["janus"] < 0.01
    assert found.numbers["janus_fronts"] == 1
    record = found.details["janus"]
    assert record["text"] == "front view of a corgi"
    assert record["model"] == "a stand-in"
    assert record["protocol"]["views"] == len(record["views"]) == 24


def test_two_fronts_are_worse_than_one_and_three_are_counted():
    assert seen(0, 180).numbers == {"janus": pytest.approx(1), "janus_fronts": 2}
    assert seen(0, 120, 240).numbers == {"janus": pytest.approx(1), "janus_fronts": 3}


def test_without_a_clear_front_there_is_no_number():
    found = seen(0, contrast=0.01)
    assert found.numbers == {}
    assert found.details["janus"]["reason"] == "the model sees no side as the front"


def test_the_sides_are_the_softmax_over_three_texts_of_a_clip_model(clip_folder):
    from PIL import Image
    from transformers import CLIPModel, CLIPProcessor

    pictures = torch.rand(6, 32, 32, 3, generator=torch.Generator().manual_seed(0))

    def render(cameras, background):
        return output(pictures[[round(float(azimuth) % 360) // 60 for azimuth in cameras.azimuth_deg]])

    measurand = Measurand(gaussians=ONE, render=render, prompt="a corgi")
    found = metric(by="model", model=str(clip_folder), views=6).measure(measurand).details["janus"]
    model, processor = CLIPModel.from_pretrained(clip_folder), CLIPProcessor.from_pretrained(clip_folder)
    inputs = processor(
        text=[f"{side} view of a corgi" for side in ("front", "side", "back")],
        images=[Image.fromarray(each) for each in (pictures * 255).round().byte().numpy()],
        return_tensors="pt",
        padding=True,
    )
    with torch.no_grad():
        expected = model(**inputs).logits_per_image.softmax(dim=1)[:, 0]
    assert found["views"] == pytest.approx(expected.tolist(), abs=1e-5)
    assert len(found["weights_sha256"]) == 64


# --- which way --------------------------------------------------------------------------------------------


def test_the_truth_is_preferred_to_a_model_unless_the_line_says_otherwise(car, monkeypatch):
    asked = []

    def ask(self, measurand):
        asked.append(self.by)
        return Measurement({})

    monkeypatch.setattr(Janus, "_by_model", ask)
    known = Measurand(gaussians=ONE, render=lambda c, b: output(car(c, b)[0]), prompt="", truth=Truth(car))
    unknown = replace(known, truth=None)
    for by, measurand in (("auto", unknown), ("model", known), ("auto", known)):
        metric(by=by).measure(measurand)
    assert asked == ["auto", "model"]
    assert metric(by="truth").measure(unknown).numbers == {}
