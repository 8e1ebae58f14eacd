"""Laws of meshes as exact priors, and of the catalogue of a folder of meshes."""

import json
import os
import time
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from cadam3d.core.cameras import Cameras, turntable
from cadam3d.core.errors import UserError
from cadam3d.io.frames import points_to_file
from cadam3d.prior.exact import Census
from cadam3d.prior.objects import catalog
from cadam3d.prior.objects.catalog import WORLD, read_catalog
from cadam3d.prior.objects.prior import MeshPrior, ObjectsPrior
from cadam3d.prior.objects.scene import MeshScene, read_object
from cadam3d.prior.path import DDPM, per_view
from cadam3d.prior.truth import MeshTruth

SHARED = {
    "noise_path": DDPM(),
    "spread": 0.1,
    "edge_spread": 0.2,
    "model_error": 0.0,
    "samples_per_pixel": 2,
    "census_size": 8,
    "seed": 0,
}


def views(count: int = 2, size: int = 24) -> Cameras:
    cameras = turntable(count, elevation_deg=20.0, distance=3.0, fov_y_deg=45.0, size=size)
    return cameras.to(torch.float64)


def paper(count: int = 2, shade: float = 1.0) -> torch.Tensor:
    return torch.full((count, 3), shade, dtype=torch.float64)


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """A folder with a ball and two boxes of different outlines."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    place = tmp_path / "things"
    place.mkdir()
    trimesh.creation.icosphere(subdivisions=3).export(place / "ball.ply")
    trimesh.creation.box((1, 1, 3)).export(place / "tallBox_01.ply")
    trimesh.creation.box((1, 3, 1)).export(place / "wide box.ply")
    return place


def prior(folder: Path, **changes) -> ObjectsPrior:
    return ObjectsPrior(folder=str(folder), **{**SHARED, **changes})


def condition(model: ObjectsPrior, prompt: str, negative: str = ""):
    return model.embed(prompt, negative).at(views(), paper())


# --- The posterior -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("t", [0.0, 0.3, 1.0])
def test_one_match_is_denoised_like_a_gaussian_at_its_render(folder, t):
    model = prior(folder)
    times = torch.full((2,), t, dtype=torch.float64)
    a, b = (per_view(each) for each in (model.noise_path.a(times), model.noise_path.b(times)))
    noisy = torch.randn(2, 3, 24, 24, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    image, alpha = model.scene("ball").draw(views(), paper(), 2)
    mean, sigma = 2 * image[:, 0] - 1, 0.1 + 0.2 * 4 * alpha * (1 - alpha)
    expected = mean + a * sigma**2 / (a**2 * sigma**2 + b**2) * (noisy - a * mean)
    found = model.predict(noisy, times, condition(model, "ball"), 1.0)
    torch.testing.assert_close(found.clean, expected)
    torch.testing.assert_close(a * found.clean + b * found.noise, noisy)


@pytest.mark.parametrize("mode", [0, 1])
def test_of_two_matches_the_right_one_is_found_at_low_noise(folder, mode):
    """The outlines of the modes differ, so each has its own variance."""
    model, t = prior(folder), torch.full((2,), 0.2, dtype=torch.float64)
    mixture = condition(model, "box").positive
    assert mixture.variance.shape[1] == mixture.means.shape[1] == 2
    assert not torch.equal(mixture.variance[:, 0], mixture.variance[:, 1])
    noise = torch.randn(2, 3, 24, 24, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    noisy = model.noise_path.mix(mixture.means[:, mode], noise, t)
    a, b = (per_view(each)[:, None] for each in (model.noise_path.a(t), model.noise_path.b(t)))
    shares = mixture.log_joint(noisy, a, a * a * mixture.variance + b * b).softmax(dim=1)
    torch.testing.assert_close(shares.sum(1), torch.ones(2).double())
    assert float(shares[:, mode].min()) > 0.999


# --- Images ------------------------------------------------------------------------------------------------


def drawn(folder: Path, name: str, cameras: Cameras, samples: int = 3, shade: float = 0.0):
    mesh = read_object(str(folder / name), "truth.path", "+z")
    return MeshScene([mesh], lambda size: None).draw(cameras, paper(len(cameras), shade), samples)


def test_the_outline_of_a_ball_has_the_area_of_its_cone(folder):
    _, alpha = drawn(folder, "ball.ply", views(1, 96))
    assert 0 <= float(alpha.min()) <= float(alpha.max()) <= 1
    assert float(((alpha > 0) & (alpha < 1)).double().mean()) > 0.01
    tangent = 0.85 / (3.0**2 - 0.85**2) ** 0.5
    radius = 48 / np.tan(np.radians(22.5)) * tangent
    assert float(alpha.sum()) == pytest.approx(np.pi * radius**2, rel=0.01)


def test_two_backgrounds_give_alpha(folder):
    (black, alpha), (white, _) = (drawn(folder, "ball.ply", views(), shade=shade) for shade in (0.0, 1.0))
    torch.testing.assert_close(1 - (white - black).mean(2), alpha)


def test_the_light_on_a_point_is_the_same_from_every_side(folder):
    """Where the top of the box is seen, its colour is one, from all views."""
    image, alpha = drawn(folder, "wide box.ply", views(6, 48), samples=1)
    colors = image.permute(0, 1, 3, 4, 2)[alpha > 0].mul(1e6).round().unique(dim=0)
    assert len(colors) <= 5  # of four sides and the top


@pytest.mark.parametrize("up", ["+y", "-y"])
def test_a_turned_file_with_its_up_axis_gives_the_same_images(folder, up):
    box = trimesh.creation.box((1, 2, 3))
    box.vertices[0] *= 2
    box.export(folder / "a.ply")
    box.vertices = points_to_file(torch.tensor(np.array(box.vertices)), up).numpy()
    box.export(folder / "b.ply")
    images = [
        MeshScene([read_object(str(folder / name), "k", axis)], lambda size: None).draw(views(), paper(), 2)[
            0
        ]
        for name, axis in (("a.ply", "+z"), ("b.ply", up))
    ]
    torch.testing.assert_close(*images)


@pytest.mark.parametrize("name", ["ball.ply", "wide box.ply", "tallBox_01.ply"])
def test_the_farthest_point_is_at_the_usual_distance(folder, name):
    mesh = read_object(str(folder / name), "k", "+y")
    assert float(mesh.vertices.norm(dim=1).max()) == pytest.approx(0.85)


def test_truth_and_prior_of_a_mesh_agree(folder):
    path = str(folder / "tallBox_01.ply")
    model = MeshPrior(path=path, folder=str(folder), up="+y", **SHARED)
    truth = MeshTruth(path=path, up="+y", samples_per_pixel=2, turns=None).of("anything", model)
    own = model.truth("whatever")
    torch.testing.assert_close(truth.images(views(), paper()), own.images(views(), paper()))
    assert np.array_equal(truth.surfaces()[0][0], own.surfaces()[0][0])
    assert truth.alpha is not None


def test_a_hole_shows_what_is_behind_it(tmp_path):
    wall = "v {0} -1 -1\nv {0} 1 -1\nv {0} 1 1\nv {0} -1 1\n"
    quads = "vt 0 0\nusemtl hole\nf 1/1 2/1 3/1\nf 1/1 3/1 4/1\nusemtl red\nf 5/1 6/1 7/1\nf 5/1 7/1 8/1\n"
    (tmp_path / "a.obj").write_text("mtllib a.mtl\n" + wall.format(0.1) + wall.format(-0.1) + quads)
    (tmp_path / "a.mtl").write_text("newmtl hole\nKd 0 0 1\nmap_Kd hole.png\nnewmtl red\nKd 1 0 0\n")
    from PIL import Image

    for alpha, channel in ((0, 0), (255, 2)):
        Image.new("RGBA", (2, 2), (0, 0, 255, alpha)).save(tmp_path / "hole.png")
        image, _ = drawn(tmp_path, "a.obj", views(1))
        assert int(image[0, 0, :, 12, 12].argmax()) == channel


# --- The catalogue -----------------------------------------------------------------------------------------


def names(folder: Path, prompt: str) -> list[str]:
    return [entry.name for entry in prior(folder).named(prompt)]


def listed(folder: Path, *entries: dict) -> None:
    (folder / "catalog.json").write_text(json.dumps(entries))
    read_catalog.cache_clear()


def test_words_of_file_names_are_names(folder):
    assert names(folder, "a photo of a Tall Box") == ["tall box"]
    assert names(folder, "box") == ["tall box", "wide box"]


def test_a_name_comes_before_tags(folder):
    file = {"file": "ball.ply"}
    listed(
        folder,
        file | {"name": "globe", "tags": ["ball"]},
        file | {"name": "ball"},
        file | {"name": "3d model"},
    )
    assert names(folder, "a ball") == ["ball"]
    assert names(folder, "globe ball") == ["globe"]
    assert names(folder, "a 3d model") == ["3d model"]


def test_many_matches_are_eight_modes(folder):
    listed(folder, *({"file": "ball.ply", "name": f"ball {number}"} for number in range(30)))
    assert len(names(folder, "ball")) == 8


@pytest.mark.parametrize(("prompt", "key"), [("bal", "prompt"), ("", "prompt"), ("ball", "negative_prompt")])
def test_unknown_words_are_answered_with_the_nearest_name(folder, prompt, key):
    negative = "tal box" if key == "negative_prompt" else ""
    with pytest.raises(
        UserError, match=rf'^{key}: expected the name or a tag .* Try: {key}="a (ball|tall box)"'
    ):
        prior(folder).embed(prompt, negative)


def test_a_negative_prompt_is_another_object_and_an_empty_one_is_the_census(folder):
    model = prior(folder)
    negative = condition(model, "ball", "tall box").negative
    torch.testing.assert_close(negative.means, condition(model, "tall box").positive.means)
    empty = condition(model, "ball")
    assert empty.negative is empty.empty


def test_the_census_is_kept_until_a_file_or_its_axis_changes(folder, monkeypatch):
    taken = []
    monkeypatch.setattr(
        catalog,
        "stored_census",
        lambda identity, scenes, size: taken.append(identity) or Census(torch.zeros(11, 2, 2)),
    )
    for _ in range(2):
        read_catalog(str(folder)).census(8)
    assert len(set(taken)) == 1
    os.utime(folder / "ball.ply", (1, 1))
    read_catalog(str(folder)).census(8)
    assert len(set(taken)) == 2
    for up in ("+y", "+z"):
        listed(folder, {"file": "ball.ply", "name": "ball", "up": up})
        read_catalog(str(folder)).census(8)
    assert len(set(taken)) == 4


def test_every_object_of_the_package_is_found_by_its_name():
    world = read_catalog(None)
    for row in json.loads((WORLD / "catalog.json").read_text()):
        assert [entry.name for entry in world.matching(f"a {row['name']}")] == [row["name"]]


BALL = {"file": "ball.ply", "name": "ball"}
CATALOGUES = {
    "no list": "5",
    "no objects": "[]",
    "no json": "[{]",
    "deep": "[" * 100_000,
    "large": "[" + " " * (1 << 24),
    "no name": json.dumps([{"file": "ball.ply"}]),
    "a number": json.dumps([BALL | {"name": 5}]),
    "an axis": json.dumps([BALL | {"up": "x"}]),
    "above": json.dumps([BALL | {"file": "../../../../../../etc/passwd"}]),
    "absolute": json.dumps([BALL | {"file": "/etc/passwd"}]),
    "missing": json.dumps([BALL | {"file": "none.glb"}]),
    "null": json.dumps([BALL | {"file": "a\0b"}]),
    "folder": json.dumps([BALL | {"file": "."}]),
    "link": json.dumps([BALL | {"file": "link.ply"}]),
    "escape": json.dumps([BALL | {"name": "\x1b[2Jball"}]),
    "two lines": json.dumps([BALL | {"author": "a\nNote: all is well"}]),
    "backwards": json.dumps([BALL | {"tags": ["\u202eball"]}]),
    "long": json.dumps([BALL | {"name": "x" * 100_000}]),
    "half a letter": '[{"file": "ball.ply", "name": "\\ud800"}]',
}


@pytest.mark.parametrize("kind", CATALOGUES)
def test_a_catalogue_of_a_stranger_is_refused_in_one_line(kind, folder):
    (folder.parent / "secret.ply").write_bytes((folder / "ball.ply").read_bytes())
    (folder / "link.ply").symlink_to("../secret.ply")
    (folder / "catalog.json").write_text(CATALOGUES[kind])
    with pytest.raises(UserError) as raised:
        read_catalog(str(folder))
    message = str(raised.value)
    assert "expected" in message
    assert "\n" not in message
    assert len(message) < 600


@pytest.mark.parametrize("name", ["", "none", "a\0b", "x" * 100_000, "ball.ply"])
def test_what_is_no_folder_with_meshes_is_refused(folder, name):
    place = folder / (name or "empty")
    with pytest.raises(UserError, match=r"^prior\.folder: expected a folder with meshes"):
        read_catalog(str(place))


def test_links_out_of_a_folder_are_refused_and_hidden_files_do_not_count(folder):
    (folder / "._ball.ply").write_bytes(b"\0")
    assert len(read_catalog(str(folder)).entries) == 3
    (folder.parent / "secret.ply").write_bytes((folder / "ball.ply").read_bytes())
    (folder / "link.ply").symlink_to("../secret.ply")
    read_catalog.cache_clear()
    with pytest.raises(UserError, match=r"expected files that .* within the folder, got 'link\.ply'"):
        read_catalog(str(folder))


def test_a_suggestion_cannot_run_a_command(folder):
    listed(folder, BALL | {"name": 'ball $(reboot)`reboot`";reboot'})
    with pytest.raises(UserError) as raised:
        prior(folder).scene("ball reboots")
    assert not set("$`;") & set(str(raised.value).partition("Try: ")[2])


def test_a_folder_of_many_files_is_matched_in_a_moment(folder):
    listed(
        folder,
        *({"file": "ball.ply", "name": f"thing {number}", "tags": ["a", "b"]} for number in range(5000)),
    )
    model = prior(folder)
    started = time.process_time()
    assert len(model.named("thing 4711")) == 1
    with pytest.raises(UserError):
        model.scene("thong")
    assert time.process_time() - started < 3
