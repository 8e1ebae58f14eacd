"""ProgressExporter: the pictures of training in order, each with its step and its number of Gaussians."""

import imageio.v3 as imageio
import numpy as np
import pytest
import torch

from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.exporter.progress import ProgressExporter, count_at
from cadam3d.io.image import step_picture, write_png
from cadam3d.io.jsonl import append_jsonl
from cadam3d.io.records import counts, read_metrics

SETTINGS = {"run": None, "fps": 4, "hold": 0.5, "codec": "mp4"}
NONE = Gaussians(
    torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0, 4), torch.zeros(0), torch.zeros(0, 1, 3)
)


def never(cameras, background, shown=None):
    raise AssertionError("nothing is rendered")


@pytest.fixture
def run(tmp_path):
    folder = tmp_path / "a run"
    (folder / "previews").mkdir(parents=True)
    for step, size in ((100, 32), (20, 32), (250, 24)):
        write_png(step_picture(folder / "previews", step), torch.full((size, 2 * size, 3), step / 300))
    for line in (
        {"kind": "step", "step": 1, "num_gaussians": 4000},
        {"kind": "refine", "step": 100, "before": 4000, "after": 5000},
        {"kind": "step", "step": 100, "num_gaussians": 5000},
    ):
        append_jsonl(folder / "metrics.jsonl", line)
    return folder


@pytest.mark.parametrize("codec", ["mp4", "webm", "gif"])
def test_the_previews_are_shown_in_order_and_the_last_one_stays(run, tmp_path, codec):
    exporter = ProgressExporter(**{**SETTINGS, "run": str(run), "codec": codec})
    [path] = exporter.export(NONE, never, tmp_path)
    frames = imageio.imread(path)
    assert path.name == f"progress.{codec}"
    assert frames.shape[0] == 3 + 2
    assert frames.shape[1] > 32
    shades = frames[:, 4:20, 4:44, :3].mean(axis=(1, 2, 3)) / 255 * 300
    np.testing.assert_allclose(shades, [20, 100, 250, 250, 250], atol=6)


def test_without_a_run_the_previews_beside_the_video_are_shown(run):
    [path] = ProgressExporter(**SETTINGS).export(NONE, never, run)
    assert path == run / "progress.mp4"


def test_the_count_of_a_step_is_that_of_the_last_refinement_before_it(run):
    found = counts(read_metrics(run))
    texts = [count_at(step, found) for step in (0, 1, 99, 100, 250)]
    assert texts == ["", "4,000 Gaussians", "4,000 Gaussians", "5,000 Gaussians", "5,000 Gaussians"]


def test_a_run_without_previews_suggests_how_to_train_with_them(tmp_path):
    with pytest.raises(UserError, match=r"has no previews/. Try: cadam3d train .*every=20$"):
        ProgressExporter(**SETTINGS).export(NONE, never, tmp_path)


def test_a_gif_has_at_most_50_pictures_per_second():
    with pytest.raises(UserError, match=r"\.fps: expected at most 50 "):
        ProgressExporter(**{**SETTINGS, "codec": "gif", "fps": 60})
