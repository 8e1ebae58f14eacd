"""Options: read the YAML files of the groups, for everything that asks what can be chosen.

A group such as ``densifier`` is a folder of YAML files, and each file is an option. ``folders`` are the
folders with groups, in the order in which Hydra searches them: that of ``--config-dir`` before those of the
package. Nothing is composed here.
"""

import re
import shlex
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache
from inspect import isabstract, isclass
from pathlib import Path
from typing import Any

from hydra.utils import get_object
from omegaconf import OmegaConf

from cadam3d.core.checks import fail, nearest
from cadam3d.core.errors import UserError
from cadam3d.io.reading import read_text, read_yaml
from cadam3d.io.run_folder import LATEST

TARGET = "_target_"
NOTHING = "???"  # a value that the user has to give
# Examples of what has no default, because it is chosen for each run.
CHOSEN = {"prompt": "a red torus", "run": LATEST, "resume": LATEST}
# What Hydra reads in the first line of a YAML file.
PACKAGE = re.compile(r"#\s*@package\s+(\S+)")


def config_dir() -> Path:
    """Return the folder of YAML files: inside the installed package, or ``configs/`` of a checkout."""
    package = Path(__file__).parent.parent
    packaged = package / "configs"
    return packaged if packaged.is_dir() else package.parent / "configs"


def option_names(group: str, folders: Sequence[Path] = ()) -> list[str]:
    """Return the sorted names of the options of a group, such as ``camera`` or ``initializer/fallback``."""
    places = folders or (config_dir(),)
    return sorted({path.stem for folder in places for path in (folder / group).glob("*.yaml")})


def option_file(group: str, name: str, folders: Sequence[Path] = ()) -> Path:
    """Return the file of an option. Raises ``UserError`` for an unknown one."""
    for folder in folders or (config_dir(),):
        if (path := folder / group / f"{name}.yaml").is_file():
            return path
    raise unknown_option(group, name, option_names(group, folders))


def unknown_option(group: str, got: str, known: Sequence[str], command: str = "train") -> UserError:
    """Return the error for an option that a group does not have, with the nearest one."""
    near = nearest(got, known)
    example = f"{group}={near}" if near else option_word(group, command)
    return fail(group, expected=f"one of {'|'.join(known)}", got=got, example=example)


def unknown_setting(key: str, known: Iterable[str], value: object, command: str = "train") -> UserError:
    """Return the error for a key that does not exist, with ``value`` given to the nearest known one."""
    names = [name for name in known if name != key]
    parent, _, last = key.rpartition(".")
    inside = {name.removeprefix(f"{parent}."): name for name in names if name.startswith(f"{parent}.")}
    by_last = {name.rpartition(".")[2].lower(): name for name in names}
    near = inside.get(nearest(last, inside)) if inside else by_last.get(key.lower()) or nearest(key, names)
    if near:
        word = shlex.quote(f"{near}={spelled(value)}")
        return UserError(f"{key}: no such setting. Did you mean {near}? Try: {word}")
    return UserError(f"{key}: no such setting. Try: {settings_page(command)}")


def settings_page(command: str) -> str:
    """Return the line that prints the settings of a command. A sweep has those of training."""
    return f"cadam3d {'train' if command == 'sweep' else command} --cfg job"


def read_option(group: str, name: str, folders: Sequence[Path] = ()) -> dict[str, Any]:
    """Return the plain values of an option by their place, such as ``{"camera": {"size": 112}}``.

    Those of the options that it builds on are merged. Interpolations stay text. Raises ``UserError`` for an
    option that is unknown or is no dict of YAML.
    """
    values = _merged(group, name, folders)
    for part in reversed(package_of(group, option_file(group, name, folders))):
        values = {part: values}
    return values


def package_of(group: str, path: Path) -> list[str]:
    """Return the keys under which the file of an option is composed, such as ``["exporter", "ply"]``."""
    package = PACKAGE.match(read_text(path))
    place = package.group(1).split(".") if package else group.split("/")
    return [part for part in place if part != "_global_"]


def option_class(group: str, name: str, folders: Sequence[Path] = ()) -> type | None:
    """Return the class that an option builds, or None if it builds nothing, as ``regularizer=none``.

    Raises ``UserError`` if there is no such option, or if its class cannot be imported.
    """
    values = read_option(group, name, folders)
    place = package_of(group, option_file(group, name, folders)) or group.split("/")
    target = _inside(values, [*place, TARGET])
    return None if target == NOTHING else load_class(target, f"{group}={name}")


def load_class(target: object, key: str) -> type:
    """Return the class with the path ``target``, which is a value of ``key``. Nothing is called.

    Raises ``UserError`` unless it can be imported and is a class that can be built.
    """
    try:
        found = get_object(target) if isinstance(target, str) else None
    # A module can raise anything while it is imported.
    except Exception as error:
        reason = (str(error.__cause__ or error).splitlines() or [type(error).__name__])[-1]
        raise UserError(f"{key}: {target} cannot be loaded ({reason}). Try: cadam3d doctor") from error
    if not isclass(found) or isabstract(found):
        raise fail(key, expected="the path of a class", got=target, example=option_word(key))
    return found


def command_files(command: str) -> list[Path]:
    """Return the YAML file of a command, after those of the commands that it builds on."""
    path = config_dir() / f"{command}.yaml"
    bases = [entry for entry in read_yaml(path)["defaults"] if isinstance(entry, str) and entry != "_self_"]
    return [*(file for base in bases for file in command_files(base)), path]


def default_options(command: str = "train") -> dict[str, str | list[str] | None]:
    """Return the option that each group of a command has by default: a list where several can be chosen.

    Groups of the command that it builds on come first, so ``sweep`` begins with the groups of ``train``.
    """
    entries = [entry for path in command_files(command) for entry in read_yaml(path)["defaults"]]
    return {group: name for each in entries if isinstance(each, Mapping) for group, name in each.items()}


def declared_names(command: str) -> set[str]:
    """Return the settings and groups that the YAML of a command declares, with those that it builds on."""
    settings = {name for path in command_files(command) for name in read_yaml(path)}
    return settings.union(default_options(command)) - {"defaults"}


def option_word(key: str, command: str = "train") -> str:
    """Return an argument that chooses an option for the slot ``key``, such as ``camera=orbit``.

    It removes the slot if it belongs to no group.
    """
    group = key.removesuffix(f".{TARGET}").replace(".", "/")
    if names := option_names(group):
        return shlex.quote(f"{group}={spelled(default_options(command).get(group) or names[0])}")
    return f"~{key}"


@cache
def example_word(key: str) -> str:
    """Return ``key=value`` with a value from the YAML files of the package, as it is typed into a shell.

    This is the value of the default option, or of another one of its group. For the slot of a group, and
    without such a value, it is an argument that chooses an option of the group; "" outside of all groups.
    """
    if option_names(key.replace(".", "/")):
        return option_word(key)
    for values in _places(key):
        found = _inside(values, key.split("."))
        if not isinstance(found, dict) and NOTHING not in str(found) and "${" not in str(found):
            return shlex.quote(f"{key}={spelled(found)}")
    root = key.partition(".")[0]
    return option_word(root) if option_names(root) else ""


def with_example(error: UserError) -> UserError:
    """Return an error with what to type, if it lacks this and the YAML files have an example for its key."""
    word = example_word(error.key) if error.key else ""
    return UserError(f"{error} Try: {word}") if word else error


def spelled(value: Any) -> str:
    """Return a plain value in Hydra's grammar of overrides."""
    if isinstance(value, list):
        return f"[{','.join(map(spelled, value))}]"
    if value is None or isinstance(value, bool):
        return str(value).lower().replace("none", "null")
    return str(value)


def _merged(group: str, name: str, folders: Sequence[Path]) -> Any:
    """Return the values of an option, merged with those that it builds on."""
    path = option_file(group, name, folders)
    content = read_yaml(path)
    if not isinstance(content, dict):
        raise UserError(f"{path}: expected keys with values, got other data. Try: {option_word(group)}")
    merged: list[Any] = []
    for base in content.pop("defaults", ()):
        if isinstance(base, str) and base != "_self_":
            file, _, below = base.partition("@")
            other, _, option = file.rpartition("/")
            values = _merged(other.lstrip("/") or group, option, folders)
            merged.append(values if below in ("", "_here_") else {below: values})
    # Hydra merges in the same way.
    return OmegaConf.to_container(OmegaConf.merge(*merged, content))


def _places(key: str) -> Iterator[dict[str, Any]]:
    """Yield the nested values of every YAML file that may have a setting, the likeliest first."""
    yield CHOSEN
    group = key.partition(".")[0]
    for path in sorted(config_dir().glob("*.yaml"), key=lambda path: path.stem != "train"):
        yield read_yaml(path)
    default = default_options().get(group)
    for name in sorted(option_names(group), key=lambda name: name != default):
        yield read_option(group, name)


def _inside(values: Any, parts: Sequence[str]) -> Any:
    """Return the value at a path in nested dicts, or ``NOTHING``."""
    for part in parts:
        if not isinstance(values, dict) or part not in values:
            return NOTHING
        values = values[part]
    return values
