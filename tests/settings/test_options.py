"""What can be chosen is read from the YAML files, without composing them."""

from functools import cache
from typing import Any

import pytest
from omegaconf import OmegaConf

from cadam3d.core.errors import UserError
from cadam3d.settings.compose import compose
from cadam3d.settings.options import (
    TARGET,
    config_dir,
    example_word,
    option_class,
    option_names,
    read_option,
)

OPTIONS = sorted(
    (path.parent.relative_to(config_dir()).as_posix(), path.stem)
    for path in config_dir().glob("*/**/*.yaml")
    if path.parent.name
    not in ("hydra", "launcher", "grid", "for", "experiment", "noise", "vram", "_simplify")
)


def contained(part: Any, whole: Any) -> bool:
    """Return whether all values of nested dicts are also in other ones, apart from interpolations."""
    if isinstance(part, dict):
        return isinstance(whole, dict) and all(contained(part[key], whole.get(key)) for key in part)
    return part == whole or "${" in str(part)


@cache
def together(number: int) -> Any:
    """Compose option ``number`` of every group at once, which takes less time than one by one."""
    groups = {group for group, _ in OPTIONS if "/" not in group}
    names = {group: option_names(group) for group in sorted(groups)}
    chosen = [f"{group}={each[number % len(each)]}" for group, each in names.items()]
    return OmegaConf.to_container(compose(["prompt=a", *chosen]))


@pytest.mark.parametrize(("group", "name"), OPTIONS)
def test_an_option_is_read_as_hydra_composes_it(group, name):
    kind, _, inner = group.partition("/")
    values = read_option(group, name)
    if inner or not contained(values, together(option_names(group).index(name))):
        # Another option of the round has changed the same setting.
        cfg = compose(["prompt=a", *([f"{kind}=shap_e"] if inner else []), f"{group}={name}"])
        assert contained(values, OmegaConf.to_container(cfg))


def test_the_class_of_an_option_is_the_one_that_it_builds():
    # One option of each group, because importing a class can take seconds.
    for group, name in dict(OPTIONS).items():
        target = read_option(group, name)
        for part in group.split("/"):
            target = target.get(part, {})
        path = target.get(name, target).get(TARGET)
        cls = option_class(group, name)
        assert cls is None if path is None else cls is not None and path.endswith(f".{cls.__name__}")


def test_an_option_of_another_folder_comes_before_that_of_the_package(tmp_path):
    (tmp_path / "camera").mkdir()
    (tmp_path / "camera" / "orbit.yaml").write_text("_target_: collections.OrderedDict\n")
    (tmp_path / "camera" / "mine.yaml").write_text("defaults: [sphere, _self_]\nsize: 3\n")
    folders = [tmp_path, config_dir()]
    assert "mine" in option_names("camera", folders)
    assert read_option("camera", "orbit", folders) == {"camera": {TARGET: "collections.OrderedDict"}}
    mine = read_option("camera", "mine", folders)["camera"]
    assert mine == {**read_option("camera", "sphere")["camera"], "size": 3}
    with pytest.raises(UserError, match=r"^camera: expected one of .*\|mine\|.*, got 'other'"):
        read_option("camera", "other", folders)


@pytest.mark.parametrize(
    ("key", "word"),
    [
        ("densifier.tau_Q", "densifier.tau_Q=0.9"),
        ("densifier.cap", "densifier.cap=20000"),
        ("exporter.mesh.format", "exporter.mesh.format=glb"),
        ("optimizer.means_lr.steps", "optimizer=adam"),
        ("optimizer.means_lr", "optimizer=adam"),
        ("prompt", "'prompt=a red torus'"),
        ("size", "size=384"),
        ("mystery", ""),
    ],
)
def test_the_example_of_a_setting_is_its_value_in_the_yaml_files(key, word):
    assert example_word(key) == word


def test_a_class_that_cannot_be_imported_is_one_message(tmp_path):
    (tmp_path / "camera").mkdir()
    for name, target in {"missing": "nowhere.Camera", "function": "os.getcwd", "number": 5}.items():
        (tmp_path / "camera" / f"{name}.yaml").write_text(f"_target_: {target}\n")
        with pytest.raises(UserError, match=rf"^camera={name}: "):
            option_class("camera", name, [tmp_path])
