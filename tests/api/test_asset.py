"""Assets in Python are read, rendered, exported and meshed as the command line does it."""

import copy
import json
import pickle
import sys
from pathlib import Path
from types import SimpleNamespace

import imageio.v3 as imageio
import numpy as np
import pytest
import torch
from formats import matched
from splats import make_cameras, make_gaussians

import cadam3d
from cadam3d.api import asset as module
from cadam3d.api.asset import Asset, load

SMALL = {"views": 2, "size": 16}


@pytest.fixture(scope="module")
def ball() -> Asset:
    """Return a dense ball of Gaussians, in the order in which files have them."""
    gaussians = make_gaussians(200, spread=0.3, log_scale=-2.0, opacity=2.0)
    return Asset(
        gaussians, title="a ball", rasterizer=module.option("rasterizer", "reference", module.Rasterizer)
    )


@pytest.fixture
def file(ball, tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    [path] = ball.export("ball.ply")
    return path


@pytest.mark.parametrize("name", ["a.ply", "a.compressed.ply", "a.splat", "a.spz"])
def test_a_format_that_is_exported_can_be_loaded(ball, file, name):
    assert ball.export(name) == [Path(name)]
    back = load(name).gaussians
    near = matched(back, ball.gaussians)
    torch.testing.assert_close(near.means, ball.gaussians.means, atol=2e-3, rtol=0)
    torch.testing.assert_close(near.opacities, ball.gaussians.opacities, atol=1e-2, rtol=0)
    if name == "a.ply":
        assert all(torch.equal(back.tensors()[key], each) for key, each in ball.gaussians.tensors().items())


def test_a_simplified_asset_is_what_an_export_with_the_count_has(ball, tmp_path):
    [path] = ball.export(tmp_path / "few.ply", "exporter.ply.count=20")
    few = ball.simplified(20)
    assert (len(few), few.title, len(ball)) == (20, ball.title, 200)
    assert torch.equal(load(path).gaussians.means, few.gaussians.means)
    assert len(ball.simplified(fraction=0.5, simplify="opacity")) == 100
    assert len(ball.simplified(40, simplify="contribution")) == 40
    assert ball.simplified(200).gaussians is ball.gaussians


@pytest.mark.parametrize("name", ["b.spz", "b.html", "b.compressed.ply"])
def test_an_export_has_the_bytes_of_the_command_line(file, name, type_line):
    done = type_line(
        "export", "ply=ball.ply", f"output={name}", *(["exporter.html.title=ball"] * ("html" in name))
    )
    assert done.code == 0, done.err
    assert load(file).export(f"python_{name}") == [Path(f"python_{name}")]
    assert Path(f"python_{name}").read_bytes() == Path(name).read_bytes()


def test_a_setting_of_an_export_and_a_folder(ball, file):
    ball.export("z.ply", "exporter.ply.up=+z")
    assert load("z.ply").gaussians.means.equal(ball.gaussians.means)
    assert Path("z.ply").read_bytes() != file.read_bytes()
    paths = ball.export("folder", "exporter=[ply,spz]")
    assert sorted(paths) == [Path("folder/asset.ply"), Path("folder/asset.spz")]


@pytest.mark.parametrize(
    ("name", "words", "message"),
    [
        ("ball.ply", (), "output: expected another place than ball.ply"),
        ("a.xyz", (), "output: expected a file with suffix"),
        ("a.ply", ("exporter.ply.up=z",), "exporter.ply.up: expected one of"),
        ("a.ply", ("exporter=[plx]",), "exporter: expected one of"),
        ("a.ply", ("output=b.ply",), "output: expected one value"),
        ("a.ply", ("run=b",), "run: expected one value"),
    ],
)
def test_an_export_that_cannot_work_is_refused(file, name, words, message):
    before = file.read_bytes()
    with pytest.raises(cadam3d.UserError, match=message):
        load(file).export(name, *words)
    assert file.read_bytes() == before
    assert list(Path().iterdir()) == [file]


def test_pictures_have_the_pixels_of_the_command_line(ball, file, type_line):
    words = ("exporter=[images]", "exporter.images.views=2", "exporter.images.size=16", "output=pictures")
    done = type_line(
        "render", "ply=ball.ply", "rasterizer=reference", *words, "exporter.images.kinds=[rgb,depth]"
    )
    assert done.code == 0, done.err
    for kind, ending in (("rgb", "20.png"), ("depth", "_depth.png")):
        files = sorted(Path("pictures/images").glob(f"*{ending}"))
        expected = np.stack([imageio.imread(each) for each in files])
        np.testing.assert_array_equal(ball.render(**SMALL, kind=kind), expected)


def test_pictures_may_be_transparent_and_of_any_cameras(ball):
    turn = ball.render(**SMALL, background="transparent")
    assert turn.shape == (2, 16, 16, 4)
    assert turn[..., 3].min() == 0 < turn[..., 3].max()
    cameras = make_cameras(5, 8, 12)
    pictures = ball.render(cameras, background=(0, 0, 0))
    assert pictures.shape == (5, 8, 12, 3)
    output = ball.rasterize(cameras)
    assert output.rgb.shape == (5, 8, 12, 3)
    np.testing.assert_array_equal(pictures, (output.rgb.clamp(0, 1) * 255).round().numpy().astype(np.uint8))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"size": 0}, "exporter.images.size: expected"),
        ({"kind": "rbg"}, "exporter.images.kinds: expected one of"),
        ({"background": "red"}, "exporter.images.background: expected three numbers"),
        (
            {"cameras": make_cameras(1, 4, 4), "views": 3},
            r"cameras: expected None with settings of a turn",
        ),
    ],
)
def test_wrong_settings_of_pictures_are_refused(ball, settings, message):
    with pytest.raises(cadam3d.UserError, match=message):
        ball.render(**settings)


def test_settings_may_be_numbers_of_numpy_and_torch(ball, without_type_checks):
    settings = {"views": np.int64(2), "size": np.int32(16)}
    colours = [
        (1, 0.5, 0),
        np.array([1, 0.5, 0]),
        torch.tensor([1, 0.5, 0]),
        [np.float32(1), np.float32(0.5), 0],
    ]
    expected, *others = (ball.render(**settings, background=each) for each in colours)
    assert all(np.array_equal(each, expected) for each in others)
    with pytest.raises(cadam3d.UserError, match=r"exporter\.images\.views: expected a number"):
        ball.render(views=object())


def test_the_modes_of_torch_of_the_caller_change_nothing(ball, file):
    cameras = make_cameras(2, 8, 8)
    expected, mesh = ball.rasterize(cameras).rgb, ball.mesh(resolution=16)
    dtype = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    torch.set_default_device("meta")
    try:
        assert load(file).gaussians.means.equal(ball.gaussians.means)
        assert ball.rasterize(cameras).rgb.equal(expected)
        assert np.array_equal(ball.mesh(resolution=16).vertices, mesh.vertices)
    finally:
        torch.set_default_dtype(dtype)
        torch.set_default_device(None)


def test_a_copy_shows_its_own_gaussians(ball):
    pictures = ball.render(**SMALL)
    for another in (copy.deepcopy(ball), pickle.loads(pickle.dumps(ball))):
        assert np.array_equal(another.render(**SMALL), pictures)
        another.gaussians.means.add_(0.3)
        assert not np.array_equal(another.render(**SMALL), pictures)
    assert np.array_equal(ball.render(**SMALL), pictures)


def test_the_mesh_is_closed_and_in_world_axes(ball):
    mesh = ball.mesh(resolution=16)
    assert mesh.is_watertight
    assert mesh.visual.vertex_colors.shape == (len(mesh.vertices), 4)
    np.testing.assert_allclose(mesh.bounds.mean(axis=0), ball.gaussians.means.mean(dim=0), atol=0.3)
    with pytest.raises(cadam3d.UserError, match=r"mesh: expected one of .*, got 'texture'"):
        ball.mesh(texture=64)


def test_outside_of_a_notebook_a_page_is_written(ball, capsys):
    path = ball.show()
    assert str(path) in capsys.readouterr().out
    assert "a ball" in path.read_text(encoding="utf-8")
    path.unlink()
    path.parent.rmdir()


def test_in_a_notebook_the_page_is_in_a_frame(ball, monkeypatch):
    display = pytest.importorskip("IPython.display")
    shown = []
    monkeypatch.setattr(display, "display", lambda data, raw: shown.append(data))
    monkeypatch.setattr(sys.modules["IPython"], "get_ipython", lambda: SimpleNamespace(kernel=None))
    assert ball.show(height=300) is None
    [data] = shown
    assert data["text/html"].startswith('<iframe srcdoc="&lt;!DOCTYPE html&gt;')
    assert "height: 300px" in data["text/html"]
    assert data["text/plain"] == repr(ball)


@pytest.mark.parametrize("path", ["nowhere", "nowhere.ply", "text.ply", "."])
def test_what_cannot_be_read_has_the_text_of_the_command_line_but_for_the_hint(path, file, type_line):
    Path("text.ply").write_text("no file of Gaussians")
    done = type_line("render", f"{'ply' if '.ply' in path else 'run'}={path}", "exporter=[preview]")
    with pytest.raises(cadam3d.UserError) as caught:
        load(path)
    assert str(caught.value) == done.message.replace("Try: run=outputs/latest", 'Try: "outputs/latest"')


def test_the_prompt_of_a_run_is_the_title_of_its_asset(file):
    Path("run").mkdir()
    file.rename("run/asset.ply")
    Path("run/config.yaml").write_text("prompt: a red cube\n")
    Path("run/summary.json").write_text(json.dumps({"prompt": "a red cube"}))
    assert load("run").title == "a red cube"
