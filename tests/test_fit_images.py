"""scripts/fit_images.py: the layouts of images with known cameras, and a fit of a few steps."""

import csv
import json
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from PIL import Image

pytest.importorskip("gsplat", reason="pip install -e .[dev]")
sys.path.insert(0, str(Path(__file__).parents[1] / "scripts"))

import fit_images
import gsplat_on_cpu
import photos

from cadam3d.core.errors import UserError
from cadam3d.rasterizer import gsplat as gsplat_rasterizer
from cadam3d.rasterizer.reference import ReferenceRasterizer

SIZE = 24


@pytest.fixture(scope="module")
def horse():
    return photos.photograph("horse", 8, SIZE)


def pixels(cameras) -> torch.Tensor:
    """Return where some points of space are in every image."""
    points = 1.6 * torch.rand(50, 3, generator=torch.Generator().manual_seed(0)) - 0.8
    seen = (
        points @ cameras.world_to_camera[:, :3, :3].transpose(1, 2) + cameras.world_to_camera[:, None, :3, 3]
    )
    projected = seen @ cameras.intrinsics.transpose(1, 2)
    return projected[..., :2] / projected[..., 2:]


def layout_of(folder, horse) -> dict:
    photos.write_transforms(folder, horse)
    return json.loads((folder / "transforms.json").read_text())


def assert_same(found, expected):
    torch.testing.assert_close(pixels(found.cameras), pixels(expected.cameras), rtol=0, atol=1e-4)
    torch.testing.assert_close(found.images, expected.images, rtol=0, atol=0.51 / 255)


def test_renders_are_read_again_with_the_same_cameras(tmp_path, horse):
    photos.write_transforms(tmp_path, horse)
    assert_same(photos.read_transforms(tmp_path / "transforms.json", SIZE), horse)
    fitted, held_out = photos.read_data(str(tmp_path), 0, SIZE)
    assert (len(fitted.cameras), len(held_out.cameras)) == (7, 1)
    assert_same(held_out, horse.index(torch.tensor([0])))


def test_blenders_layout_has_an_angle_of_view_files_without_suffix_and_views_for_tests(tmp_path, horse):
    layout = layout_of(tmp_path, horse)
    frames = [
        {
            "file_path": f"./{frame['file_path'].removesuffix('.png')}",
            "transform_matrix": frame["transform_matrix"],
        }
        for frame in layout["frames"]
    ]
    for name, part in {"train": frames[2:], "test": frames[:2]}.items():
        content = {"camera_angle_x": layout["camera_angle_x"], "frames": part}
        (tmp_path / f"transforms_{name}.json").write_text(json.dumps(content))
    (tmp_path / "transforms.json").unlink()
    fitted, held_out = photos.read_data(str(tmp_path), 0, SIZE)
    assert_same(fitted, horse.index(torch.arange(2, 8)))
    assert_same(held_out, horse.index(torch.arange(2)))


def test_smaller_images_have_the_same_field_of_view_and_clear_pixels_are_white(tmp_path, horse):
    layout = layout_of(tmp_path, horse)
    Image.new("RGBA", (SIZE, SIZE)).save(tmp_path / layout["frames"][0]["file_path"])
    small = photos.read_transforms(tmp_path / "transforms.json", SIZE // 2)
    assert small.images.shape == (8, SIZE // 2, SIZE // 2, 3)
    assert (small.images[0] == 1).all()
    torch.testing.assert_close(2 * pixels(small.cameras), pixels(horse.cameras))


def test_a_focal_length_per_axis_and_an_off_centre_axis_are_kept(tmp_path, horse):
    layout = layout_of(tmp_path, horse)
    layout["frames"][3] |= {"fl_x": 30.0, "fl_y": 40.0, "cx": 10.0, "cy": 13.0}
    (tmp_path / "transforms.json").write_text(json.dumps(layout))
    cameras = photos.read_transforms(tmp_path / "transforms.json", SIZE).cameras
    expected = torch.tensor([[30.0, 0, 10], [0, 40, 13], [0, 0, 1]])
    torch.testing.assert_close(cameras.intrinsics[3], expected)
    torch.testing.assert_close(cameras.intrinsics[2], horse.cameras.intrinsics[2])


def test_distorted_images_and_unknown_objects_are_refused(tmp_path, horse):
    layout = layout_of(tmp_path, horse) | {"k1": 0.1, "p2": 0.0}
    (tmp_path / "transforms.json").write_text(json.dumps(layout))
    with pytest.raises(UserError, match="expected undistorted images, got 'k1'"):
        photos.read_transforms(tmp_path / "transforms.json", SIZE)
    with pytest.raises(SystemExit, match="expected a transforms"):
        fit_images.main(["no such object"])


def test_the_ball_that_all_cameras_see_is_that_of_the_renders(horse):
    moved = horse.cameras.map(lambda tensor: tensor.clone())
    offset = torch.tensor([3.0, -2.0, 1.0])
    moved.world_to_camera[:, :3, 3] -= moved.world_to_camera[:, :3, :3] @ offset
    centre, radius = photos.seen_ball(moved)
    torch.testing.assert_close(centre, offset, rtol=0, atol=1e-4)
    assert radius == pytest.approx(1.0, abs=1e-4)


@pytest.mark.parametrize(
    "strategy", ["default grow_grad2d=0.001", "default absgrad=True grow_grad2d=0.01", "cadam tau_Q=0.7"]
)
def test_a_short_fit_grows_and_comes_closer_to_views_that_it_has_not_seen(tmp_path, horse, strategy, capsys):
    photos.write_transforms(tmp_path / "data", horse)
    name, *settings = strategy.split()
    words = [str(tmp_path / "data"), "--strategy", name, *settings, "--width", str(SIZE)]
    words += ["--count", "150"]
    rows = []
    for steps in ("1", "90"):
        fit_images.main([*words, "--steps", steps, "--out", str(tmp_path / steps)])
        rows.append(eval(capsys.readouterr().out))
    assert rows[1]["psnr"] > rows[0]["psnr"] + 4
    assert rows[1]["count"] != rows[0]["count"] == 150
    assert Image.open(tmp_path / "90" / "held_out.png").size == (SIZE, 2 * SIZE)


def test_a_stopped_table_continues_with_the_rows_that_it_lacks(tmp_path, monkeypatch):
    fitted = []

    def run(args, data):
        fitted.append((args.data, args.strategy, *args.settings))
        return {
            "object": args.data,
            "strategy": args.strategy,
            "settings": " ".join(args.settings),
            "seed": 0,
        }

    monkeypatch.setattr(fit_images, "run", run)
    monkeypatch.setattr(fit_images, "photograph", lambda *settings: photos.photograph("horse", 8, 4))
    monkeypatch.setattr(fit_images, "ARMS", ["cadam", "cadam tau_Q=0.8"])
    path = tmp_path / "rows.csv"
    fit_images.main(["--table", str(path)])
    whole = path.read_text()
    assert len(fitted) == 2 * len(fit_images.OBJECTS) == len(list(csv.DictReader(whole.splitlines())))
    path.write_text("".join(whole.splitlines(keepends=True)[:-1]))
    fit_images.main(["--table", str(path)])
    assert path.read_text() == whole
    assert fitted[-1] == fitted[-2]


def test_the_schedule_is_scaled_and_settings_of_the_line_win():
    words = ["tau_Q=0.8", "tau_SNR=None", "reset=none", "refine_every=7"]
    strategy = fit_images.make_strategy("cadam", words, 3000)
    lengths = {"refine_start_iter": 50, "refine_stop_iter": 1500, "reset_every": 300, "refine_every": 7}
    assert strategy == fit_images.CAdamStrategy(**lengths, tau_Q=0.8, tau_SNR=None, reset="none")


def test_the_trainer_runs_with_gsplats_rasterization(monkeypatch, horse):
    """The kernels of gsplat need a GPU, so its pure torch functions take their place."""
    monkeypatch.setattr(gsplat_rasterizer, "load_rasterization", lambda device: gsplat_on_cpu.rasterization)
    gaussians = []
    for rasterizer in (gsplat_rasterizer.GsplatRasterizer(), ReferenceRasterizer()):
        strategy = fit_images.make_strategy(
            "default", ["absgrad=True", "grow_grad2d=0.001", "refine_every=2"], 10
        )
        options = SimpleNamespace(seed=0, count=30, sh_degree=1, steps=10)
        gaussians.append(fit_images.fit(horse, strategy, rasterizer, options))
    assert len(gaussians[0]) == len(gaussians[1]) > 30
    images = [fit_images.shown(each, horse.cameras, ReferenceRasterizer()) for each in gaussians]
    assert fit_images.psnr(*images) > 35
    assert gaussians[0].sh.shape[1:] == (4, 3)
