"""Qualities have labels and directions, every metric has an entry, and metrics agree with the directions."""

import pytest

from cadam3d.core.quality import QUALITIES
from cadam3d.metric.clip_r_precision import ClipRPrecision
from cadam3d.metric.clip_score import ClipScore
from cadam3d.metric.hps import Hps
from cadam3d.metric.image_reward import ImageReward
from cadam3d.metric.janus import Janus
from cadam3d.metric.niqe import Niqe
from cadam3d.metric.pick_score import PickScore
from cadam3d.metric.vqa import Vqa
from cadam3d.settings.options import config_dir


def test_every_metric_that_can_be_chosen_has_a_number_in_the_list():
    options = {path.stem for path in (config_dir() / "metric").glob("*.yaml")}
    assert options <= {quality.metric for quality in QUALITIES.values()}


def test_a_label_names_the_unit_and_a_value_is_written_with_it():
    assert QUALITIES["psnr"].heading == "PSNR (dB)"
    assert QUALITIES["psnr"].written(23.4149) == "23.41 dB"
    assert QUALITIES["num_gaussians"].written(12345.0) == "12,345"
    assert QUALITIES["iou"].fact == "Overlap of the outlines (IoU)"
    assert QUALITIES["median_scale"].fact == "Median scale (world units)"


def test_metrics_and_their_numbers_agree_about_what_is_better():
    kinds = [ClipRPrecision, ClipScore, Hps, ImageReward, Janus, Niqe, PickScore, Vqa]
    assert {kind.number: not kind.less_is_better for kind in kinds} == {
        kind.number: QUALITIES[kind.number].is_more_better for kind in kinds
    }


@pytest.mark.parametrize(
    ("name", "better", "worse"), [("psnr", 30.0, 20.0), ("niqe", 4.0, 9.0), ("image_reward", 0.1, -1.0)]
)
def test_the_merit_of_a_better_value_is_larger(name, better, worse):
    assert QUALITIES[name].merit(better) > QUALITIES[name].merit(worse)
