"""A value of the wrong type gets a message that names its key, in every component and every command."""

import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import fields, replace
from functools import cache, partial
from typing import Any, get_args, get_type_hints

import jaxtyping
import pytest
import torch
import yaml
from hydra.utils import get_object
from omegaconf import DictConfig, OmegaConf

from cadam3d import cli
from cadam3d.build import build_trainer, component, components
from cadam3d.camera.progressive import require_widening
from cadam3d.camera.ranges import require_interval
from cadam3d.commands.messages import keeping_others
from cadam3d.core.checks import (
    declared,
    require_choice,
    require_color,
    require_each,
    require_range,
    require_whole,
)
from cadam3d.core.errors import UserError
from cadam3d.core.memory import is_out_of_memory
from cadam3d.core.pictures import require_angles
from cadam3d.core.schedule import Schedule, Steps
from cadam3d.settings.check import BOUNDS, _types_of_settings, require_settings
from cadam3d.settings.compose import compose
from cadam3d.settings.options import config_dir
from cadam3d.sweep.grid import MOST_JOBS, expand, read_grid, read_line

EXPORTER = {"_target_": "cadam3d.exporter.ply.PlyExporter", "up": "-y", "pad_sh": 0}
# Values that no setting of any component has.
NEVER: tuple[Any, ...] = (-math.inf, 10**400, 1e39, "\x1b[2J", [[{}]], EXPORTER, {"_target_": "os.getcwd"})
# Values that some settings have.
PERHAPS: tuple[Any, ...] = (None, True, -1, 2**62, [1, 2])
# Folders of options that are not components of one class.
NOT_COMPONENTS = ("hydra", "grid", "launcher", "experiment", "noise", "vram", "for")
SEVERAL = ("regularizer", "exporter", "callback", "metric")


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


# --- laws over all options -------------------------------------------------------------------------------


def options() -> Iterator[tuple[str, str]]:
    """Yield the place and the file of one option for each class that the YAML files name."""
    seen = set()
    for path in sorted(config_dir().glob("*/*.yaml")):
        group, name = path.parent.name, path.stem
        node = yaml.safe_load(path.read_text(encoding="utf-8"))
        if group not in NOT_COMPONENTS and "_target_" in node and node["_target_"] not in seen:
            seen.add(node["_target_"])
            yield f"{group}.{name}" if group in SEVERAL else group, f"{group}/{name}"


@cache
def with_option(node: str, file: str) -> DictConfig:
    """Return the settings with one option replaced. Only an option that builds on another one is composed."""
    option = OmegaConf.load(config_dir() / f"{file}.yaml")
    assert isinstance(option, DictConfig)
    is_alone = all(entry == "_self_" or OmegaConf.is_dict(entry) for entry in option.get("defaults", []))
    cfg = composed("camera=orbit" if is_alone else file.replace("/", "=")).copy()
    OmegaConf.set_struct(cfg, False)
    if not is_alone:
        return cfg
    option.pop("defaults", None)
    if OmegaConf.is_missing(option, "path"):
        option.path = "a.ply"
    OmegaConf.update(cfg, node, option, merge=False, force_add=True)
    return cfg


def places(node: DictConfig, prefix: str) -> Iterator[str]:
    """Yield the keys of all settings of a component, also of those inside of other objects."""
    for name in map(str, node):
        if name == "_target_":
            continue
        yield f"{prefix}.{name}"
        child = node._get_node(name)
        if isinstance(child, DictConfig) and not child._is_interpolation() and not child._is_none():
            yield from places(child, f"{prefix}.{name}")


def changed(choice: str, key: str, value: Any) -> DictConfig:
    cfg = composed(choice).copy()
    OmegaConf.set_struct(cfg, False)
    OmegaConf.update(cfg, key, value, merge=False, force_add=True)
    return cfg


def refusal(node: str, file: str, key: str, value: Any) -> str | None:
    """Return the message that refuses a value, or None if the component accepts it."""
    cfg = with_option(node, file)
    parent, _, name = key.rpartition(".")
    holder = OmegaConf.select(cfg, parent)
    before = holder._get_node(name)
    if before is not None:
        del holder[name]
    OmegaConf.update(cfg, key, value, merge=False, force_add=True)
    try:
        component(OmegaConf.select(cfg, node), object, node)
    except UserError as error:
        return str(error)
    finally:
        holder.pop(name)
        if before is not None:
            holder[name] = before
    return None


def wrong_values(value: Any, declared: Any) -> tuple[Any, ...]:
    """Return values of other types than that of a setting, which has a value and a declared type."""
    if declared is int:
        return (2.5, True, "abc", [1], None)
    if isinstance(value, bool):
        return (0, 1.0, "abc", None)
    if isinstance(value, int | float):
        return (True, "abc", ["a"])
    if OmegaConf.is_list(value) and all(isinstance(each, int | float) for each in value):
        return (5, "abc", ["a", "b", "c"], [True, True, True], [None, None])
    return ()


@pytest.mark.parametrize(("node", "file"), options())
def test_every_setting_of_every_component_refuses_what_it_cannot_use(node, file):
    settings = OmegaConf.select(with_option(node, file), node)
    types = get_type_hints(get_object(settings._target_))
    for key in list(places(settings, node)):
        own = key.removeprefix(f"{node}.")
        wrong = wrong_values(OmegaConf.select(settings, own), types.get(own))
        for value in (*NEVER, *wrong, *PERHAPS):
            message = refusal(node, file, key, value)
            assert message is not None or value in PERHAPS, f"{key}={value!r} is accepted"
            if message is not None:
                assert message.startswith(f"{key.partition('.')[0]}."), message
                assert "Try: " in message, message
                assert "\n" not in message, message


# Numbers whose bounds depend on other settings, or that the class checks itself.
BY_HAND = {
    *("prior.spread", "prior.edge_spread", "prior.model_error", "prior.samples_per_pixel"),
    *("prior.census_size", "prior.seed", "truth.samples_per_pixel", "truth.turns"),
}


def beyond(check: partial[None]) -> list[Any]:
    """Return values that a declared check must refuse."""
    bounds = check.keywords
    if check.func is require_whole:
        return [bounds[side] + step for side, step in (("low", -1), ("high", 1)) if side in bounds]
    if check.func is require_range:
        just = {"low": -math.inf, "high": math.inf}
        outside = [math.nextafter(bounds[side], just[side]) for side in just if side in bounds]
        return [*outside, *(bounds[side] for side in ("above", "below") if side in bounds)]
    if check.func is require_each:
        return [[value] for value in beyond(bounds["check"])]
    low, high, limit = (bounds.get(name, 0) for name in ("low", "high", "limit"))
    return {
        require_choice: [-1 if isinstance(next(iter(bounds.get("choices", "a"))), int) else "none of these"],
        require_interval: [[high, low], [low - 1, high], [low, high + 1], [low]],
        require_angles: [[], [limit + 1], [-limit - 1]],
        require_color: [[0, 0], [0, 0, 1.5], [-0.1, 0, 0]],
        require_widening: [],
    }[check.func]


@pytest.mark.parametrize(("node", "file"), options())
def test_every_number_declares_its_bounds_and_is_refused_beyond_them(node, file):
    built = component(OmegaConf.select(with_option(node, file), node), object, node)
    for name, hint in get_type_hints(type(built)).items():
        is_number = {int, float, Sequence[float]} & {hint, *get_args(hint)}
        is_setting = name in [each.name for each in fields(built) if each.init]
        checks = declared(type(built)).get(name, ((), False))[0]
        assert checks or not (is_number and is_setting) or f"{node}.{name}" in BY_HAND, name
        wrong = [value for check in checks for value in beyond(check)]
        if wrong:
            assert f"{node}.{name}: expected " in (refusal(node, file, f"{node}.{name}", wrong[0]) or ""), (
                name
            )
        if Schedule in get_args(hint):
            wrong += [Steps(values=[0.5, value], milestones=[7]) for value in wrong]
        for value in wrong:
            with pytest.raises(UserError, match=rf"^{type(built).__name__}\.{name}: expected "):
                replace(built, **{name: value})


@pytest.mark.parametrize(("node", "file"), options())
def test_no_component_accepts_unknown_keys(node, file):
    assert f"{node}.foo: no such setting." in (refusal(node, file, f"{node}.foo", True) or "")


SLOTS = ("camera", "background", "augmentation", "rasterizer", "prior", "guidance", "densifier", "refine")
SLOTS += ("optimizer", "exposure", "regularizer", "callback")


@pytest.mark.parametrize("value", [None, "abc", {"a": 1}, EXPORTER])
@pytest.mark.parametrize("slot", SLOTS)
def test_a_slot_of_the_trainer_takes_only_its_own_kind_of_component(slot, value):
    inner = f"{slot}.mine" if slot in SEVERAL else slot
    if slot in SEVERAL and value == {"a": 1}:
        return  # the settings of a member that is not chosen
    with pytest.raises(UserError, match=rf"^{inner}(\._target_)?: expected .* Try: "):
        # No other densifier is free of references to the schedule of refinements.
        build_trainer(changed("densifier=none", inner, value), torch.device("cpu"))


@pytest.mark.parametrize("value", [None, 5, "abc", [1]])
def test_a_list_of_options_is_a_list(value):
    with pytest.raises(UserError, match=r"^exporter: expected a list of options"):
        components(OmegaConf.create({"exporter": value}).exporter, object, "exporter")


@pytest.mark.parametrize(
    "name",
    ["prompt", "negative_prompt", "steps", "views", "seed", "device", "resume", "attempts", "select"],
)
@pytest.mark.parametrize("value", [[], 10**30, True, "\udcff"])
def test_a_setting_outside_of_components_has_a_value_of_its_type(name, value):
    with pytest.raises(UserError, match=rf"^{name}: expected .* Try: \S*{name}="):
        require_settings(changed("camera=orbit", name, value))


def test_numbers_outside_of_components_have_bounds_and_are_refused_beyond_them():
    number = {int, float}
    typed = {name: {hint, *get_args(hint)} for name, hint in _types_of_settings().items()}
    assert {name for name, hints in typed.items() if hints & number} <= BOUNDS.keys() | {"job"}
    for name, check in BOUNDS.items():
        for value in beyond(check):
            with pytest.raises(UserError, match=rf"^{name}: expected "):
                require_settings({name: value})


# --- command lines -----------------------------------------------------------------------------------------


def refused_line(capsys, monkeypatch, *words: str) -> str:
    """Run a command line that must be refused, and return its message."""
    monkeypatch.setattr(sys, "argv", ["cadam3d", *words])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    message = capsys.readouterr().err
    assert ended.value.code == 1
    assert message.startswith("cadam3d: ")
    assert message.count("\n") == 1
    assert "Try: " in message
    return message


WRONG_LINES = {
    "device=meta": "device: expected a device of this machine",
    "callback.progress=null": "callback.progress: expected an object of class Callback",
    "densifer=cadam": "densifer: no such setting. Did you mean densifier? Try: densifier=cadam\n",
    "densifier.tau_snr=0.3": "densifier.tau_snr: no such setting. Did you mean densifier.tau_SNR? Try: densi",
    "+densifier.tau_snr=0.3": "densifier.tau_snr: no such setting. Did you mean densifier.tau_SNR? Try: dens",
    "tau_q=0.3": "tau_q: no such setting. Did you mean densifier.tau_Q? Try: densifier.tau_Q=0.3",
    "+camera.foo.bar=1": "camera.foo: no such setting. Try: cadam3d train --cfg job",
    "+callback.foo.bar=1": "callback.foo: is not chosen",
    "callback.progress.refresh_seconds=abc": "callback.progress.refresh_seconds: expected a finite number",
    "camera.size=10000000": "camera.size: expected a number >= 1 and <= 16384",
    "views=100000000000": "views: expected a whole number",
    "initializer.count=1000000000000": "initializer.count: expected a whole number",
    "exporter.turntable.size=10000000": "exporter.turntable.size: expected a whole number",
    "metric.fidelity.views=1000000000000": "metric.fidelity.views: expected a whole number >= 1 and <=",
    "guidance.weight=1e308": "guidance.weight: expected a finite number below 2^63",
    "optimizer.means_lr=1e39": "optimizer.means_lr: expected a finite number",
    "initializer.scale=1e39": "initializer.scale: expected a finite number",
    "protocol.size=/dev/zero": "protocol.size: expected a whole number",
    "protocol.views=-3": "protocol.views: expected a whole number >= 1",
}


@pytest.mark.parametrize("line", WRONG_LINES)
def test_a_wrong_line_is_refused_before_any_work(line, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    words = ["train", "prompt=a cube", "prior=tiny", "rasterizer=reference", line]
    assert WRONG_LINES[line] in refused_line(capsys, monkeypatch, *words)
    assert not list(tmp_path.glob("**/summary.json"))


WRONG_FILES = {
    "broken": b"a: [1\n",
    "empty": b"",
    "a_list": b"- 1\n",
    "other_bytes": b"\xff\xfe\x00",
    "no_class": b"size: 3\n",
    "a_function": b"_target_: os.getcwd\n",
    "another_kind": b"_target_: cadam3d.exporter.ply.PlyExporter\n",
    "a_number": b"_target_: 5\n",
    "itself": b"defaults: [itself, _self_]\n",
    "a_tag": b"a: !!python/object:os.system 1\n",
    "deep": b"[" * 20_000,
    "wrong_package": b"# @package a b c\na: 1\n",
}


@pytest.mark.parametrize("name", WRONG_FILES)
def test_a_wrong_file_of_the_user_is_refused_in_one_line(name, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own" / "camera").mkdir(parents=True)
    (tmp_path / "own" / "camera" / f"{name}.yaml").write_bytes(WRONG_FILES[name])
    words = ["train", "--config-dir=own", "prompt=a cube", "prior=tiny", "rasterizer=reference"]
    refused_line(capsys, monkeypatch, *words, f"camera={name}")


# --- sweeps ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "values",
    [
        *("range(0)", "range(5,1)", "range(0,1,0)", "range(0,nan)", "range(0,inf)", "range(0,1000000000)"),
        *("range(0,1,1e-30)", "glob(*)", "interval(0,1)", "1," * 100_000 + "1"),
    ],
)
def test_a_sweep_without_values_or_with_too_many_is_refused(values):
    with pytest.raises(UserError, match=r"^seed: expected .* Try: "):
        read_line([f"seed={values}"])


def test_the_jobs_of_a_sweep_are_counted_before_they_are_made():
    line = read_line(
        [f"{key}=range(1,11)" for key in ("seed", "views", "steps", "camera.size", "refine.start")]
    )
    with pytest.raises(UserError, match=rf"^sweep: expected at most {MOST_JOBS} jobs, got 100000\."):
        expand(read_grid(None), line)


# --- memory ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("error", [MemoryError(), torch.OutOfMemoryError("out of memory"), UserError("a: b")])
def test_an_output_that_fails_costs_only_itself(error, capsys):
    warnings: list[str] = []
    with keeping_others("exporter.images", warnings):
        raise error
    assert len(warnings) == 1
    assert warnings[0] in capsys.readouterr().err


def test_torch_reports_a_failed_allocation_as_running_out_of_memory():
    for size in (2**45, 2**62):
        with pytest.raises(RuntimeError) as raised:
            torch.empty(size)
        assert is_out_of_memory(raised.value)


def test_a_bug_in_an_output_is_raised():
    with pytest.raises(ZeroDivisionError), keeping_others("exporter.images", []):
        raise ZeroDivisionError
