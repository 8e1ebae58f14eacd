"""Candidates: pictures and histograms, written without changing the run."""

import imageio.v3 as imageio
import numpy as np
import pytest
import torch

from cadam3d.callback.candidates import OTHERS, SELECTED, histogram, marked
from cadam3d.core.cameras import turntable
from cadam3d.core.gaussians import Gaussians
from cadam3d.io.image import step_pictures
from cadam3d.io.jsonl import append_jsonl, read_jsonl
from cadam3d.rasterizer.reference import ReferenceRasterizer

LINE = (
    *("densifier.min_age=0", "callback=[candidates]", "callback.candidates.every=4"),
    *("callback.candidates.size=16", "callback.candidates.azimuths_deg=[30,210]"),
)


@pytest.fixture(scope="module")
def watched(train, tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    (folder / "candidates").mkdir()
    (folder / "candidates/step_000099.png").write_bytes(b"old")
    append_jsonl(folder / "candidates/histograms.jsonl", {"step": 99, "score": "old"})
    return folder, train(folder, *LINE)[0]


def test_a_run_with_the_callback_equals_one_without(watched, plain, alike):
    alike(watched[1], plain)


def test_pictures_come_at_multiples_and_histograms_at_every_refinement(watched):
    """What a killed run wrote after its last checkpoint is deleted."""
    assert [step for step, _ in step_pictures(watched[0] / "candidates")] == [4]
    lines = read_jsonl(watched[0] / "candidates/histograms.jsonl")
    assert {line["step"] for line in lines} == {2, 4, 6}
    assert {line["score"] for line in lines} >= {"snr", "drift"}


def test_a_picture_has_a_render_and_a_selection_for_each_view(watched):
    image = imageio.imread(watched[0] / "candidates/step_000004.png")
    assert image.shape == (16, 2 * 16 * 2, 3)


def test_every_histogram_counts_the_whole_population(watched):
    lines = read_jsonl(watched[0] / "candidates/histograms.jsonl")
    for line in lines:
        assert all(s <= n for s, n in zip(line["selected"], line["counts"], strict=True))
    first = [line for line in lines if line["step"] == 2]
    assert {sum(line["counts"]) + line["without_log"] for line in first} == {watched[1].num_initial}


def test_selected_gaussians_are_drawn_in_one_colour_and_the_others_in_another():
    gaussians = Gaussians(
        means=torch.tensor([[0.0, -0.5, 0.0], [0.0, 0.5, 0.0]]),
        log_scales=torch.full((2, 3), -2.0),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]] * 2),
        opacity_logits=torch.full((2,), 9.0),
        sh=torch.randn(2, 4, 3, generator=torch.Generator().manual_seed(0)),
    )
    camera = turntable(1, elevation_deg=0.0, distance=3.0, fov_y_deg=40.0, size=33)
    painted = marked(gaussians, torch.tensor([True, False]))
    image = ReferenceRasterizer().render(painted, camera, torch.ones(1, 3)).rgb[0]
    columns = [int(x) for x in (16.5 + 0.5 / 3 * camera.intrinsics[0, 0, 0] * torch.tensor([-1, 1])).tolist()]
    # The camera is on +x and looks at the origin, so +y is on its right.
    seen = image[16, columns]
    assert torch.allclose(seen, torch.tensor([SELECTED, OTHERS]), atol=0.03)


def test_bins_contain_the_values_between_their_edges():
    values = torch.tensor([0.0, 0.99e-2, 1.01e-2, 0.5, 0.99, 1.01, 9.9, float("inf")])
    line = histogram(values, values > 0.9, bins_per_decade=1)
    assert line == {
        "bins_per_decade": 1,
        "first": -3,
        "counts": [1, 1, 2, 2],  # from 0.001, 0.01, 0.1 and 1 on
        "selected": [0, 0, 1, 2],
        "without_log": 2,
    }


def test_bins_do_not_depend_on_the_data():
    """Histograms of two runs, or of two steps, can therefore be added."""
    generator = torch.Generator().manual_seed(0)
    values = torch.rand(500, generator=generator).double().exp()
    no_rows = torch.zeros(500, dtype=torch.bool)
    whole = histogram(values, no_rows, 10)
    lines = [histogram(part, no_rows[:250], 10) for part in values.sort().values.split(250)]
    total = np.zeros(60, dtype=int)
    for line in lines:
        at = line["first"] - whole["first"]
        total[at : at + len(line["counts"])] += line["counts"]
    assert total[: len(whole["counts"])].tolist() == whole["counts"]
    assert total.sum() == 500


def test_without_gaussians_there_are_no_bins():
    line = histogram(torch.empty(0), torch.empty(0, dtype=torch.bool), bins_per_decade=10)
    assert line["counts"] == line["selected"] == []
