"""Laws of runs of any length: the default schedule keeps its shape, and resets leave time to recover."""

import re
from functools import cache
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf

from cadam3d.build import component
from cadam3d.core.schedule import as_schedule
from cadam3d.densifier.refine import Refine
from cadam3d.settings.compose import compose, parts

PROMPT = "prompt=a red cube"
# Every short length; of the longer ones a sample that meets each remainder of the parts of a run.
LENGTHS = (*range(1, 744), *range(744, 5000, 37))
RECIPES = ("default", "dreamgaussian", "flowdreamer", "gaussiandreamer", "lucid")


@cache
def schedules(*words: str) -> dict[int, Refine]:
    """Return the schedule of refinements for each of LENGTHS. OmegaConf would take a minute for it."""
    settings: Any = OmegaConf.to_container(compose([PROMPT, *words]).refine)
    settings.pop("_target_")
    return {
        steps: Refine(**{key: evaluated(value, steps) for key, value in settings.items()})
        for steps in LENGTHS
    }


def evaluated(value, steps: int):
    """Return what a value of a YAML file is in a run of ``steps`` steps."""
    if value == "${steps}":
        return steps
    call = re.fullmatch(r"\$\{cadam3d\.parts:(\d+),(\d+),\$\{steps\}(?:,(\d+))?\}", str(value))
    return parts(int(call[1]), int(call[2]), steps, int(call[3] or 1)) if call else value


@pytest.mark.parametrize(
    ("name", "end"),
    [
        ("sds_gaussiandreamer", (0.02, 0.55)),
        ("ism_luciddreamer", (0.02, 0.5)),
        ("vfds_flowdreamer", (0.02, 0.5)),
        ("ucm_flowdreamer", (0.02, 0.5)),
        ("gcs_beg", (0.02, 0.5)),
        ("sds_dreamgaussian", (0.02, 0.02)),
        ("sds_mvdream", (0.02, 0.5)),
        ("sdi_threestudio", (0.25, 0.25)),
    ],
)
def test_published_windows_follow_the_length_of_the_run_and_reach_their_ends(name, end):
    def at(steps):
        return component(compose([PROMPT, f"guidance={name}", f"steps={steps}"]).guidance)

    short, long = at(300), at(3000)
    for tenths in range(10):
        assert short.window(30 * tenths) == pytest.approx(long.window(300 * tenths))
        for key in ("delta", "clip"):
            values = [getattr(guidance, key, None) for guidance in (short, long)]
            if None not in values:
                values = [as_schedule(v)(n * tenths) for v, n in zip(values, (30, 300), strict=True)]
                assert values[0] == pytest.approx(values[1])
    assert long.window(2999) == pytest.approx(end, abs=1e-3)


def test_the_default_schedule_has_the_same_shape_at_every_length():
    for steps, refine in schedules().items():
        refinements, resets = len(refine.refinements), len(refine.resets)
        assert refinements == min(max(steps - 2, 0), 6)
        assert resets == (1 if steps >= 186 else 0)
        # The last third only optimises.
        assert all(step <= max(refine.steps * 2 / 3, 8) for step in refine.refinements)
        if resets:
            assert refine.resets[0] in refine.refinements
            assert abs(refine.resets[0] - steps / 2) <= 6


@pytest.mark.parametrize("name", RECIPES)
@pytest.mark.parametrize(
    "resets",
    [
        (),
        (
            *("refine.reset_interval=1", "refine.reset_from=0", "refine.reset_until=100000"),
            *("refine.min_opacity=0.001", "refine.prune_grace=0"),
        ),
    ],
)
def test_no_reset_comes_too_late_to_recover_whatever_the_settings(name, resets):
    for steps, refine in schedules(f"refine={name}", *resets).items():
        assert all(step + refine.recovery <= steps for step in refine.resets[-1:])
        assert not refine.resets_at(steps)
    if resets:
        assert list(refine.resets) == list(range(1, steps - 95))


@pytest.mark.parametrize(
    ("name", "refinements", "pieces"),
    [("lucid", 28, 50), ("flowdreamer", 13, 50), ("gaussiandreamer", 5, 12), ("dreamgaussian", 10, 10)],
)
def test_a_recipe_of_any_length_has_the_published_number_of_refinements(name, refinements, pieces):
    for steps, refine in schedules(f"refine={name}").items():
        if steps >= pieces:
            # DreamGaussian refines to the end. A run that is no multiple of its parts holds some more parts.
            more = steps // (steps // pieces) - pieces if name == "dreamgaussian" else 0
            assert len(refine.refinements) == refinements + more
        # Between two resets an opacity can recover.
        assert refine.reset_interval is None or refine.reset_interval >= refine.recovery


def test_recovery_is_long_enough_for_a_reset_opacity_to_reach_half():
    cfg = compose([PROMPT])
    logit = torch.tensor(cfg.refine.reset_value).logit().item()
    assert -logit / cfg.optimizer.opacity_lr <= cfg.refine.recovery
