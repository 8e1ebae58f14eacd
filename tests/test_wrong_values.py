"""A value of the wrong type gets a message that names its key, in every component."""

from functools import cache

import jaxtyping
import pytest
import torch
import yaml
from omegaconf import DictConfig, OmegaConf

from cadam3d.core.errors import UserError
from cadam3d.settings.compose import component, compose

# Options, and their keys that count something.
WHOLE = {
    "camera=orbit": ["camera.size"],
    "camera=sphere": ["camera.size"],
    "camera=multiview": ["camera.size"],
    "camera=progressive": ["camera.size", "camera.begin", "camera.every"],
    "initializer=ball": ["initializer.count", "initializer.sh_degree"],
    "initializer=mesh": ["initializer.count", "initializer.sh_degree"],
    "initializer=ply": ["initializer.count", "initializer.sh_degree", "initializer.replicate"],
    "initializer=shap_e": [
        "initializer.steps",
        "initializer.grid_size",
        "initializer.count",
        "initializer.grow_points",
        "initializer.replicate",
        "initializer.sh_degree",
    ],
    "prior=shapes": [
        "prior.samples_per_pixel",
        "prior.census_size",
        "prior.seed",
        "prior.noise_path.train_steps",
    ],
    "prior=tiny": ["prior.width", "prior.downscale", "prior.seed", "prior.noise_path.train_steps"],
    "guidance=ucm": ["guidance.inversion_steps"],
    "refine=default": [
        "refine.start",
        "refine.end",
        "refine.interval",
        "refine.split_children",
        "refine.prune_from",
        "refine.reset_interval",
        "refine.reset_from",
        "refine.reset_until",
        "refine.prune_grace",
        "refine.max_gaussians",
    ],
    "densifier=cadam": ["densifier.min_age", "densifier.reset_min_age"],
    "densifier=mcmc": ["densifier.cap"],
    "exposure=beg": ["exposure.begin", "exposure.end"],
    "exporter=[images]": ["exporter.images.views", "exporter.images.size"],
    "exporter=[preview]": ["exporter.preview.views", "exporter.preview.size"],
    "exporter=[turntable]": [
        "exporter.turntable.views",
        "exporter.turntable.size",
        "exporter.turntable.fps",
    ],
    "exporter=[ply]": ["exporter.ply.pad_sh"],
    "metric=[fidelity]": ["metric.fidelity.views", "metric.fidelity.size"],
    "callback=[metrics]": ["callback.metrics.every"],
    "callback=[previews]": ["callback.previews.every", "callback.previews.views", "callback.previews.size"],
    "callback=[checkpoint]": ["callback.checkpoint.every", "callback.checkpoint.keep"],
}
LISTS = {
    "camera=orbit": ["camera.azimuth_deg", "camera.elevation_deg", "camera.distance", "camera.fov_y_deg"],
    "camera=sphere": ["camera.distance", "camera.fov_y_deg"],
    "camera=multiview": ["camera.elevation_deg", "camera.relative_distance", "camera.fov_y_deg"],
    "camera=progressive": [
        *("camera.azimuth_deg.start", "camera.elevation_deg.end", "camera.distance.end"),
        *("camera.fov_y_deg.start", "camera.fov_y_deg.factor", "camera.distance.factor"),
    ],
    "background=grey": ["background.color"],
    "background=random": ["background.color"],
    "background=lucid": ["background.color"],
    "initializer=ball": ["initializer.color"],
    "initializer=mesh": ["initializer.color"],
    "initializer=ply": ["initializer.color"],
    "exporter=[images]": ["exporter.images.elevations_deg", "exporter.images.background"],
    "exporter=[preview]": ["exporter.preview.elevations_deg", "exporter.preview.background"],
    "exporter=[turntable]": ["exporter.turntable.background"],
    "callback=[previews]": ["callback.previews.background"],
    "metric=[fidelity]": ["metric.fidelity.elevations_deg", "metric.fidelity.background"],
}
SWITCHES = {
    "densifier=cadam_open": ["densifier.reset_moments"],
    "guidance=sds": ["guidance.shared_t"],
    "guidance=ism": ["guidance.shared_t"],
    "guidance=gcs": ["guidance.shared_t", "guidance.fixed_noise"],
    "exporter=[preview]": ["exporter.preview.labels"],
    "prior=stable_diffusion_3": ["prior.t5"],
}
# The keys among them that may be null.
NULLABLE = {
    "callback=[previews]": ("callback.previews.every",),
    "refine=default": ("refine.reset_interval", "refine.max_gaussians"),
    "initializer=ply": ("initializer.count", "initializer.sh_degree"),
    "initializer=shap_e": ("initializer.count",),
}
NEVER_WHOLE = ("2.5", "16.0", "true", "abc", "[1]", "-1000000000000.5")
NEVER_A_LIST = ("5", "null", "abc", "[a,b,c]", "[true,true,true]", "[null,null]", "[]")
NEVER_A_SWITCH = ("0", "1", "1.0", "null", "abc")


@pytest.fixture(autouse=True)
def without_type_checks():
    """Switch off the type checks of the suite, which would refuse a wrong type before the component does."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@cache
def composed(choice: str) -> DictConfig:
    path = ["initializer.path=a.ply"] if choice in ("initializer=mesh", "initializer=ply") else []
    return compose(["prompt=a red cube", choice, *path])


def build(choice: str, *lines: str):
    """Build the component of ``choice`` after setting the YAML values of ``lines``."""
    group, _, name = choice.partition("=")
    cfg = composed(choice).copy()
    for line in lines:
        key, _, value = line.partition("=")
        OmegaConf.update(cfg, key, yaml.safe_load(value), merge=False, force_add=True)
    return component(cfg[group][name.strip("[]")] if name.startswith("[") else cfg[group])


def pairs(table: dict[str, list[str]]) -> list[tuple[str, str]]:
    return [(choice, key) for choice, keys in table.items() for key in keys]


def refuses(choice: str, line: str) -> None:
    key = line.partition("=")[0]
    with pytest.raises(UserError) as raised:
        build(choice, line)
    message = str(raised.value)
    assert message.startswith(f"{key}: expected ")
    assert f"{key}=" in message.partition("Try: ")[2]
    assert "\n" not in message


@pytest.mark.parametrize(("choice", "key"), pairs(WHOLE))
def test_a_count_must_be_a_whole_number(choice, key):
    for value in NEVER_WHOLE:
        refuses(choice, f"{key}={value}")
    if key not in NULLABLE.get(choice, ()):
        refuses(choice, f"{key}=null")


@pytest.mark.parametrize(("choice", "key"), pairs(LISTS))
def test_a_list_of_numbers_holds_only_numbers(choice, key):
    for value in NEVER_A_LIST:
        refuses(choice, f"{key}={value}")


@pytest.mark.parametrize(("choice", "key"), pairs(SWITCHES))
def test_a_switch_is_true_or_false(choice, key):
    for value in NEVER_A_SWITCH:
        refuses(choice, f"{key}={value}")


@pytest.mark.parametrize("value", [*NEVER_A_LIST, "[10,20]"])
def test_a_range_that_widens_has_a_start_an_end_and_a_factor(value):
    refuses("camera=progressive", f"camera.fov_y_deg={value}")
    if value not in ("5", "[10,20]"):
        refuses("camera=progressive", f"camera.elevation_deg.about={value}")


def test_a_name_is_refused_as_a_fallback_initializer():
    with pytest.raises(
        UserError, match=r"^initializer\.fallback: expected .* Try: initializer/fallback=ball$"
    ):
        build("initializer=shap_e", "initializer.fallback=ball")


def test_a_boolean_is_refused_as_a_bound():
    refuses("guidance=sds", "guidance.clip=true")
    refuses("guidance=sds", "guidance.clip=abc")


def test_the_number_of_split_children_is_bounded():
    assert build("refine=default", "refine.split_children=16").split_children == 16
    refuses("refine=default", "refine.split_children=17")


@pytest.mark.parametrize("key", ["steps", "begin"])
@pytest.mark.parametrize("value", ["2.5", "true", "null", "abc"])
def test_a_schedule_counts_whole_steps(key, value):
    with pytest.raises(UserError, match=rf"^optimizer\.means_lr\.{key}: expected a whole number"):
        build("optimizer=adam", f"optimizer.means_lr.{key}={value}")


@pytest.mark.parametrize("key", ["start", "end"])
@pytest.mark.parametrize("kind", ["Linear", "LogLinear"])
@pytest.mark.parametrize("value", ["true", "null", "abc"])
def test_a_schedule_starts_and_ends_at_a_number(key, kind, value):
    with pytest.raises(UserError, match=rf"^optimizer\.means_lr\.{key}: expected a"):
        build(
            "optimizer=adam",
            f"optimizer.means_lr._target_=cadam3d.core.schedule.{kind}",
            f"optimizer.means_lr.{key}={value}",
        )


def test_an_integer_is_accepted_as_a_decay_rate():
    gaussians = build("initializer=ball", "initializer.count=3").build(
        "", torch.Generator().manual_seed(0), torch.device("cpu")
    )
    lines = ["optimizer.beta1=0", "optimizer.beta2=0", "optimizer.eps=1", "optimizer.quat_lr=0"]
    optimizer = build("optimizer=adam", *lines).start(gaussians)
    optimizer.step(0)
    assert torch.equal(optimizer.gaussians.quats, gaussians.quats)
