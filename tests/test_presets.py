"""The published numbers of each family: one factor converts all lengths, and steps are as published."""

import pytest

from cadam3d.core.schedule import as_schedule
from cadam3d.settings.compose import component, compose

UNITS = {"gaussiandreamer": 1.5, "lucid": 0.5, "dreamgaussian": 1.0}  # of theirs in one of ours
EXTENT = {"gaussiandreamer": 4.0, "lucid": 3.5, "dreamgaussian": 4.0}  # theirs
PERCENT_DENSE = {"gaussiandreamer": 0.01, "lucid": 0.003, "dreamgaussian": 0.01}
MEANS_LR = {  # step: published
    "gaussiandreamer": {0: 2e-4, 30_000: 1e-4},
    "lucid": {0: 1.6e-4 * 3.5, 5000: 1.6e-6 * 3.5},
    "dreamgaussian": {0: 1e-2, 300: 2e-4, 500: 2e-4},
}
DISTANCES = {"gaussiandreamer": (1.5, 4.0), "lucid": (5.2, 5.5), "dreamgaussian": (2.5, 2.5)}
STEPS = {"gaussiandreamer": 1200, "lucid": 5000, "dreamgaussian": 500}
CAMERAS = {"lucid": "progressive"}


def build(group: str, name: str, *lines: str):
    return component(compose(["prompt=a red cube", f"{group}={name}", *lines])[group])


@pytest.mark.parametrize("family", UNITS)
def test_all_lengths_of_a_family_are_converted_by_one_factor(family):
    unit = UNITS[family]
    refine = build("refine", family)
    assert refine.tau_scale * unit == pytest.approx(PERCENT_DENSE[family] * EXTENT[family], rel=1e-4)
    assert refine.max_scale * unit == pytest.approx(0.1 * EXTENT[family], rel=1e-4)
    optimizer = build("optimizer", family, f"steps={STEPS[family]}")
    for step, rate in MEANS_LR[family].items():
        assert as_schedule(optimizer.means_lr)(step) * unit == pytest.approx(rate, rel=1e-4)
    distance = build("camera", CAMERAS.get(family, family)).distance
    distance = distance.at(0) if family == "lucid" else distance
    assert [unit * end for end in distance] == pytest.approx(DISTANCES[family], rel=1e-4)


def test_flowdreamer_has_the_lengths_of_luciddreamer():
    lucid, flow = build("refine", "lucid"), build("refine", "flowdreamer")
    assert {key for key, value in vars(lucid).items() if value != vars(flow)[key]} == {"end", "reset_until"}


@pytest.mark.parametrize(
    ("name", "calls"),
    [
        ("gaussiandreamer", range(400, 900, 100)),
        ("lucid", range(200, 3000, 100)),
        ("flowdreamer", range(200, 1500, 100)),
        ("dreamgaussian", range(50, 501, 50)),
    ],
)
def test_refinements_are_at_the_published_steps(name, calls):
    steps = STEPS.get(name, 5000)
    refine = build("refine", name, f"steps={steps}")
    assert refine.made_for == steps
    assert [step for step in range(1, steps + 1) if refine.refines_at(step)] == list(calls)


@pytest.mark.parametrize(
    ("name", "resets"),
    [
        ("gaussiandreamer", []),
        ("lucid", range(600, 3000, 300)),
        ("flowdreamer", [600, 900, 1200]),
        ("dreamgaussian", []),
    ],
)
def test_resets_are_at_the_published_steps_after_the_warm_up(name, resets):
    refine = build("refine", name, "steps=5000")
    assert [step for step in range(1, 5001) if refine.resets_at(step)] == list(resets)


def test_luciddreamers_own_baseline_resets_from_step_300_on():
    refine = build("refine", "lucid", "refine.reset_from=300")
    assert next(step for step in range(1, 5001) if refine.resets_at(step)) == 300


def test_rates_fall_to_their_published_ends():
    lucid = build("optimizer", "lucid", "steps=5000")
    assert lucid.learning_rates(0) == pytest.approx(
        {"means": 1.12e-3, "sh_dc": 5e-3, "sh_rest": 2.5e-4, "opacity": 0.05, "scale": 5e-3, "quat": 1e-3}
    )
    assert lucid.learning_rates(5000) == pytest.approx(
        {"means": 1.12e-5, "sh_dc": 3e-3, "sh_rest": 2.5e-4, "opacity": 0.05, "scale": 1e-3, "quat": 2e-4}
    )


@pytest.mark.parametrize("family", UNITS)
def test_higher_coefficients_learn_twenty_times_as_slowly_as_in_3dgs(family):
    rates = build("optimizer", family).learning_rates(0)
    assert rates["sh_rest"] == pytest.approx(rates["sh_dc"] / 20)


def test_gradients_are_clipped_on_demand_as_in_gcs_beg():
    schedule = "{_target_: cadam3d.core.schedule.Linear, start: 2.0, end: 8.0, steps: 1000}"
    optimizer = build("optimizer", "lucid", f"optimizer.clip_norm={schedule}")
    assert [optimizer.largest_norm(step) for step in (0, 500, 1000, 3000)] == [2, 5, 8, 8]
