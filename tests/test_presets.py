"""The published numbers of each family: one factor converts all lengths, and steps are as published."""

import re

import pytest
import torch

from cadam3d.build import component
from cadam3d.core.schedule import as_schedule
from cadam3d.core.sh import SH_C0
from cadam3d.initializer.shap_e import ColoredMesh
from cadam3d.prior.prompting import PerpNeg
from cadam3d.settings.compose import compose
from cadam3d.settings.options import config_dir

# Theirs in one of ours.
UNITS = {"gaussiandreamer": 1.5, "lucid": 0.5, "flowdreamer_near": 0.5, "dreamgaussian": 1.0}
EXTENT = {"gaussiandreamer": 4.0, "lucid": 3.5, "flowdreamer_near": 2.5, "dreamgaussian": 4.0}  # theirs
PERCENT_DENSE = {"gaussiandreamer": 0.01, "lucid": 0.003, "flowdreamer_near": 0.003, "dreamgaussian": 0.01}
MEANS_LR = {  # step: published
    "gaussiandreamer": {0: 2e-4, 30_000: 1e-4},
    "lucid": {0: 1.6e-4 * 3.5, 5000: 1.6e-6 * 3.5},
    "flowdreamer_near": {0: 1.6e-4 * 2.5, 5000: 1.6e-6 * 2.5},
    "dreamgaussian": {0: 1e-2, 300: 2e-4, 500: 2e-4},
}
DISTANCES = {  # at the first step; those of the LucidDreamer family come nearer
    "gaussiandreamer": (1.5, 4.0),
    "lucid": (5.2, 5.5),
    "flowdreamer_near": (3.7, 4.0),
    "dreamgaussian": (2.5, 2.5),
}
LAST_DISTANCES = {"lucid": (3.5, 5.0), "flowdreamer_near": (2.5, 3.5)}
STEPS = {"gaussiandreamer": 1200, "lucid": 5000, "flowdreamer_near": 5000, "dreamgaussian": 500}
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
    if family in LAST_DISTANCES:
        nearest = [unit * end for end in distance.at(100)]
        assert nearest == pytest.approx(LAST_DISTANCES[family], rel=1e-4)
        distance = distance.at(0)
    assert [unit * end for end in distance] == pytest.approx(DISTANCES[family], rel=1e-4)


def shape(initializer):
    """Return the Gaussians at a mesh that is 1 wide in Shap-E's units, as most of its objects are."""
    steps = torch.linspace(-0.5, 0.5, 5)
    vertices = torch.cartesian_prod(steps, steps, torch.tensor([-0.5, 0.5]))
    faces = torch.tensor([[0, 40, 48], [0, 48, 8], [1, 41, 49], [1, 49, 9]])
    mesh = ColoredMesh(vertices, faces, torch.full((50, 3), 0.2))
    return initializer.settle(mesh, torch.Generator().manual_seed(0), torch.device("cpu"))


def test_gaussiandreamer_starts_from_the_mesh_times_its_published_factor():
    made = shape(build("initializer", "gaussiandreamer", "initializer.grow_points=0"))
    assert 1.5 * float(made.means.abs().max()) == pytest.approx(1.6 * 0.5, rel=1e-4)
    # The published scale is the root of the mean squared distance to three neighbours.
    corner = made.means.abs().sum(dim=1).argmax()
    nearest = (made.means - made.means[corner]).norm(dim=1).sort().values[1:4]
    torch.testing.assert_close(made.scales[corner], nearest.square().mean().sqrt().expand(3))


@pytest.mark.parametrize(
    ("recipe", "lift"),
    [
        ("luciddreamer", 0.15),
        ("flowdreamer", 0.15),
        ("flowdreamer_near", 0.05),
        ("flowdreamer_ucm", 0.15),
        ("gcs_beg", 0.15),
    ],
)
def test_the_lucid_family_starts_from_lifted_grey_points(recipe, lift):
    cfg = compose(["prompt=a red cube", f"experiment={recipe}"])
    initializer = component(cfg.initializer)
    made = shape(initializer)
    points = 0.5 * made.means.view(4096, 20, 3)  # in its units
    low, high = points.mean(dim=1).amin(dim=0), points.mean(dim=1).amax(dim=0)
    assert (high - low).tolist() == pytest.approx([1.0, 1.0, 1.0], abs=0.02)
    assert float(low[2] + high[2]) / 2 == pytest.approx(lift, abs=0.03)
    # All offsets are within a ball of 0.05.
    assert float((points[0, :, None] - points[0]).norm(dim=-1).max()) <= 0.1
    torch.testing.assert_close(
        made.sh, torch.full_like(made.sh, (127 / 255 - 0.5) / SH_C0), atol=1e-5, rtol=0
    )


def test_dreamgaussian_starts_grey():
    made = build("initializer", "dreamgaussian").build(
        "", torch.Generator().manual_seed(0), torch.device("cpu")
    )
    assert 0 <= float(made.sh.min()) < float(made.sh.max()) < 1.01 / 255
    assert float(made.sh.max()) > 0.99 / 255


def test_mvdream_starts_inside_the_image():
    """No start is published for it, and its cameras are too close for the start of LucidDreamer."""
    cfg = compose(["prompt=a red cube", "experiment=mvdream"])
    assert float(shape(component(cfg.initializer)).means.norm(dim=1).max()) <= 0.9 + 0.1


def test_flowdreamer_has_the_lengths_of_luciddreamer():
    lucid, flow = build("refine", "lucid"), build("refine", "flowdreamer")
    assert {key for key, value in vars(lucid).items() if value != vars(flow)[key]} == {"end", "reset_until"}


@pytest.mark.parametrize(
    ("name", "calls"),
    [
        ("gaussiandreamer", range(400, 900, 100)),
        ("lucid", range(200, 3000, 100)),
        ("flowdreamer", range(200, 1500, 100)),
        ("flowdreamer_near", range(200, 1500, 100)),
        ("dreamgaussian", range(50, 501, 50)),
    ],
)
def test_refinements_are_at_the_published_steps(name, calls):
    steps = STEPS.get(name, 5000)
    refine = build("refine", name, f"steps={steps}")
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


def test_rates_fall_to_their_published_ends():
    lucid = build("optimizer", "lucid", "steps=5000")
    assert lucid.learning_rates(0) == pytest.approx(
        {"means": 1.12e-3, "sh_dc": 5e-3, "sh_rest": 2.5e-4, "opacity": 0.05, "scale": 5e-3, "quat": 1e-3}
    )
    assert lucid.learning_rates(5000) == pytest.approx(
        {"means": 1.12e-5, "sh_dc": 3e-3, "sh_rest": 2.5e-4, "opacity": 0.05, "scale": 1e-3, "quat": 2e-4}
    )


def test_cameras_change_at_the_same_share_of_a_run_of_any_length():
    lucid = {steps: build("camera", "progressive", f"steps={steps}") for steps in (5000, 400)}
    assert (lucid[5000].begin, lucid[5000].every) == (500, 500)
    assert [lucid[400].widenings(step * 400 // 5000) for step in range(0, 5000, 500)] == list(range(10))
    for steps, milestones in ((500, [150, 300]), (60, [18, 36])):
        size = build("camera", "dreamgaussian", f"steps={steps}").size
        assert list(size.milestones) == milestones
        assert [size(step) for step in (0, *milestones)] == [128, 256, 512]


def test_flowdreamers_cameras_are_its_codes_defaults_and_its_head_can_be_typed():
    cfg = compose(["prompt=a red cube", "experiment=flowdreamer"])
    camera = component(cfg.camera)
    assert camera.azimuth_deg.at(0) == (-180, 180)
    assert camera.elevation_deg.at(0) == (-15, 45)
    assert camera.gamma == 1
    head = ["camera.azimuth_deg.start=[-80,80]", "camera.gamma=1.5"]
    head += ["camera.elevation_deg.start=[0,45]", "camera.elevation_deg.end=[0,45]"]
    camera = component(compose(["prompt=a head", "experiment=flowdreamer", *head]).camera)
    assert [camera.azimuth_deg.at(count) for count in (0, 1, 2)] == [(-80, 80), (-120, 120), (-180, 180)]
    assert camera.elevation_deg.at(9) == (0, 45)


def test_sdis_option_names_the_perp_neg_of_its_source():
    text = (config_dir() / "guidance" / "sdi_threestudio.yaml").read_text()
    words = re.findall(r"prompting[.a-z_]*=\w+", text)
    prompting = component(compose(["prompt=a corgi", "guidance=sdi_threestudio", *words]).prompting)
    assert prompting == PerpNeg(curve="threestudio", overhead_deg=60)


def test_gcs_beg_clips_gradients_in_its_own_unit_of_length():
    optimizer = build("optimizer", "gcs_beg", "steps=5000")
    steps = (0, 500, 1000, 3000)
    assert [optimizer.largest_norm("scale", step) for step in steps] == [2, 5, 8, 8]
    # Twice the gradient is clipped at the published bound.
    assert [2 * optimizer.largest_norm("means", step) for step in steps] == [2, 5, 8, 8]
