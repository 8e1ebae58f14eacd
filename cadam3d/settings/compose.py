"""Compose: read the YAML files, apply the overrides of a command line, and build the objects."""

import difflib
import math
import re
import shlex
import unicodedata
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

from hydra import version
from hydra._internal.hydra import Hydra
from hydra._internal.utils import create_config_search_path
from hydra.core.config_search_path import SearchPathQuery
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException, InstantiationException
from hydra.types import RunMode
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException, UnsupportedValueType

from cadam3d.core.checks import fail, require_choice
from cadam3d.core.errors import UserError
from cadam3d.io.reading import read_yaml
from cadam3d.settings.check import require_declared
from cadam3d.settings.options import config_dir, option_names, read_option

# Hydra behaves like this version even if a newer one is installed.
VERSION_BASE = "1.3"
# The beginning of Hydra's message for a group that is set to a number or to null.
NO_NAME_COMPLAINT = "Config group override must be a string or a list"
# Values of these keys are always text, so the user need not quote them for Hydra.
TEXT_KEYS = ("prompt", "negative_prompt")
# Characters. At three bytes each they still fit into a file name.
SLUG_LENGTH = 60
# Characters of a key. Hydra looks for a folder with the name of every key.
LONGEST_KEY = 200


def compose(
    overrides: Sequence[str] = (),
    config_name: str = "train",
    *,
    folder: Path | None = None,
    search_path: str | None = None,
    with_hydra: bool = False,
) -> DictConfig:
    """Return the configuration that ``cadam3d <config_name> <overrides>`` would run with.

    ``folder`` replaces :func:`config_dir`, ``search_path`` is one more folder of YAML files, ``with_hydra``
    keeps Hydra's own node. Raises Hydra's exceptions; ``cadam3d.settings.advice`` explains them to the user.
    """
    register_resolvers()
    require_files(folder or config_dir(), "--config-path")
    places = create_config_search_path(str((folder or config_dir()).resolve()))
    if search_path is not None:
        own = Path(search_path).absolute()
        require_files(own, "--config-dir")
        places.prepend("command-line", f"file://{own}", anchor=SearchPathQuery(provider="schema"))
    # A command that runs inside Hydra may compose too, so Hydra's global state is restored afterwards.
    outer = GlobalHydra.instance().hydra
    GlobalHydra.instance().clear()
    version.setbase(VERSION_BASE)
    try:
        cfg = Hydra.create_main_hydra2("cadam3d", places).compose_config(
            config_name, list(overrides), run_mode=RunMode.RUN, from_shell=False
        )
    except (HydraException, OmegaConfBaseException, UserError):
        raise
    # A wrong YAML file, or a deeply nested value, raises an exception of a parser, of a codec or of Python.
    except Exception as error:
        if str(error).startswith(NO_NAME_COMPLAINT):
            raise
        reason = " ".join(str(error).split())[:300] or type(error).__name__
        place = "--config-dir" if search_path is not None else "configuration"
        raise UserError(f"{place}: cannot be read ({reason}). Try: cadam3d {config_name} --help") from error
    finally:
        GlobalHydra.instance().hydra = outer
    if not with_hydra:
        with open_dict(cfg):
            cfg.pop("hydra", None)
    return cfg


def require_files(folder: Path, flag: str) -> None:
    """Raise ``UserError`` unless ``folder`` is one, and its YAML files are regular files.

    Reading a named pipe would never end. Only the folders of groups are searched.
    """
    if not folder.is_dir():
        raise UserError(f"{flag}: expected a folder, got {str(folder)!r}. Try: {_folder_like(flag, folder)}")
    groups = [path.relative_to(config_dir()) for path in config_dir().rglob("*") if path.is_dir()]
    for path in [path for group in (Path(), *groups) for path in (folder / group).glob("*.yaml")]:
        if path.exists() and not path.is_file() and not path.is_dir():
            raise UserError(f"{flag}: {path} is not a regular file. Try: cadam3d train --help")


def _folder_like(flag: str, missing: Path) -> str:
    """Return the flag for the folder whose name is nearest to ``missing``, or for the current folder."""
    beside = sorted(place.name for place in missing.parent.glob("*/") if place.is_dir())
    near = difflib.get_close_matches(missing.name, beside, n=1)
    return shlex.quote(f"{flag}={missing.with_name(near[0]) if near else '.'}")


def component(node: Any, kind: type = object, key: str = "") -> Any:
    """Build the object that ``node._target_`` names, and nested ones; lists and dicts become plain Python.

    ``kind`` is the class of the object; ``key`` is the place of the node, in case that it is not a dict.
    Raises ``UserError`` for mistakes in the configuration: values of a wrong type or out of range, unknown
    keys, missing keys, a target that cannot be imported or is of another kind. Nothing is built if a type is
    wrong. A bug in a constructor raises its own exception.
    """
    try:
        place = node._get_full_key("") if OmegaConf.is_config(node) else ""
        require_declared(node, (kind,), place or key or "configuration")
        return instantiate(_resolved(node), _convert_="all")
    except InstantiationException as error:
        raise _construction_error(error, node) from error
    except OmegaConfBaseException as error:
        reason = str(error.msg).splitlines()[0]
        raise UserError(
            f"{error.full_key or 'configuration'}: {reason}. Try: cadam3d train --cfg job"
        ) from error


def _resolved(node: Any) -> Any:
    """Return ``node``, or a copy of it if a text in it would become an interpolation once it is resolved.

    Hydra resolves a component twice. A prompt such as ``${oc.env:HOME}``, which is plain text after the first
    time, would be replaced the second time, so the copy is escaped twice.
    """
    if not OmegaConf.is_config(node):
        return node
    content = OmegaConf.to_container(node, resolve=True)
    if not any(isinstance(value, str) and "${" in value for value in _values(content)):
        return node
    copy = OmegaConf.create(escaped(escaped(content)))
    copy._set_parent(node._get_parent())
    copy._set_key(node._key())
    return copy


def _values(content: Any) -> Iterator[Any]:
    """Yield every value of nested dicts and lists."""
    inner = content.values() if isinstance(content, dict) else content if isinstance(content, list) else None
    if inner is None:
        yield content
    for item in inner or ():
        yield from _values(item)


def option(group: str, name: str, kind: type, changes: Mapping[str, Any] = MappingProxyType({})) -> Any:
    """Build one option of a group from its YAML file in this package, without a command line.

    ``changes`` replace values of the file. Raises ``UserError`` for an unknown option and for the mistakes
    that :func:`component` reports.
    """
    require_choice(group, name, option_names(group))
    values = read_option(group, name)
    values[group].get(name, values[group]).update({key: escaped(value) for key, value in changes.items()})
    try:
        node = OmegaConf.create(values)[group]
    except UnsupportedValueType as error:
        expected = "a number, a text or a list of them"
        raise fail(
            error.full_key or group, expected=expected, got=dict(changes), example=f"{group}={name}"
        ) from None
    return component(node.get(name, node), kind, group)


def components(group: Any, kind: type = object, key: str = "") -> dict[str, Any]:
    """Build every chosen member of a group of which several can be chosen, by name.

    An experiment may tune a member that the line has not chosen; such a node has keys but no ``_target_``.
    """
    if not isinstance(group, DictConfig):
        raise fail(key, expected="a list of options", got=group, example=f"'{key}=[]'")
    place = group._get_full_key("") or key
    return {
        str(name): component(node, kind, f"{place}.{name}")
        for name, node in group.items()
        if not isinstance(node, DictConfig) or "_target_" in node
    }


def load_config(path: Path) -> DictConfig:
    """Return the resolved ``config.yaml`` of a run. Text that looks like an interpolation stays text.

    Raises ``UserError`` if the file cannot be read. What it names must not be built without the checks of
    ``cadam3d.settings.trust``.
    """
    content = read_yaml(path)
    if not isinstance(content, dict):
        raise UserError(f"{path}: expected the settings of a run, got other data. Try: another run")
    return DictConfig(escaped(content))


def flatten(node: object, prefix: str = "", *, with_nodes: bool = False) -> Iterator[tuple[str, object]]:
    """Yield dotted keys and values of nested dicts; ``with_nodes`` yields the inner dicts as well."""
    if not isinstance(node, dict):
        yield prefix, node
        return
    if with_nodes and prefix:
        yield prefix, node
    for key, value in node.items():
        yield from flatten(value, f"{prefix}.{key}" if prefix else str(key), with_nodes=with_nodes)


def register_resolvers() -> None:
    """Register the functions that YAML files call, as in ``${parts:9,12,${steps}}``.

    It is safe to call this again.
    """
    OmegaConf.register_new_resolver("copies", copies, replace=True)
    OmegaConf.register_new_resolver("parts", parts, replace=True)
    OmegaConf.register_new_resolver("slug", slug, replace=True)
    OmegaConf.register_new_resolver("span", span, replace=True)


def parts(count: int, pieces: int, steps: object, least: int = 1) -> int:
    """Return the number of steps in ``count`` of ``pieces`` equal parts of a run; a part has at least 1 step.

    Each part is rounded down, so keys that share ``pieces`` keep their order and ratio at any length. The
    result is at least ``least``. Returns ``count`` for non-integers; the command reports the error in
    ``steps``.
    """
    return max(least, count * max(1, steps // pieces)) if type(steps) is int else count


def copies(count: object, times: object, usual: int) -> int:
    """Return ``count`` times ``times``; ``usual`` replaces a count that is null.

    A factor that is not an integer counts as 1; the component that owns the key reports the error.
    """
    numbers = [usual if count is None else count, times]
    return math.prod(number if type(number) is int else 1 for number in numbers)


def span(share: float, start: object, *ends: object) -> int:
    """Return a share of the steps from ``start`` to the smallest of ``ends``, at least 1.

    Returns 1 for non-integers; the component that owns the key reports the error.
    """
    if not all(type(step) is int for step in (start, *ends)):
        return 1
    return max(1, round(share * (min(ends) - start)))  # pyright: ignore[reportOperatorIssue, reportArgumentType]


def slug(*parts: object) -> str:
    """Return a piece of a file name made of ``parts``: ``slug("A red car!")`` is ``"A-red-car"``."""
    text = unicodedata.normalize("NFKC", " ".join(str(part) for part in parts))
    text = re.sub(r"(?:[^\w.=]|(?<!\w)=)+", "-", text).strip("-.")
    return text[:SLUG_LENGTH].rstrip("-.") or "untitled"


def escape(text: str) -> str:
    """Return ``text`` in a form that OmegaConf reads literally, even if it contains ``${``."""
    return re.sub(r"(\\*)\$\{", lambda match: match.group(1) * 2 + r"\${", text)


def escaped(value: Any) -> Any:
    """Return plain data in which OmegaConf reads every text literally."""
    if isinstance(value, dict):
        return {key: escaped(item) for key, item in value.items()}
    if isinstance(value, list):
        return [escaped(item) for item in value]
    return escape(value) if isinstance(value, str) else value


def quote(text: str) -> str:
    r"""Return ``text`` as a quoted value of Hydra's override grammar, which reads it as plain text.

    Inside the quotes, a backslash is special only before a quote, so only such backslashes are doubled.
    """
    escaped = re.sub(r"(\\*)'", lambda match: match.group(1) * 2 + r"\'", escape(text))
    trailing = len(escaped) - len(escaped.rstrip("\\"))
    return "'" + escaped + "\\" * trailing + "'"


def _construction_error(error: InstantiationException, node: Any) -> BaseException:
    """Return ``UserError`` for a mistake in the configuration, or else the exception of the constructor."""
    cause = error.__cause__
    key = re.search(r"full_key: (\S+)", str(error))
    where = _typed_place(node, key.group(1)) if key else "configuration"
    if isinstance(cause, UserError):
        return _placed(cause, where)
    if cause is None:
        return UserError(f"{where}: {str(error).splitlines()[0]}. Try: cadam3d train --cfg job")
    return cause


def _typed_place(node: Any, where: str) -> str:
    """Return the place at which the user types a setting of the node ``where``, which is in ``node``.

    It is another place if the inner node is an interpolation: ``protocol`` for ``metric.niqe.protocol``.
    """
    if not isinstance(node, DictConfig):
        return where
    name = where.removeprefix(f"{node._get_full_key('')}.")
    raw: Any = OmegaConf.to_container(node, resolve=False)
    taken = re.fullmatch(r"\$\{([\w.]+)\}", str(raw.get(name)))
    return taken.group(1) if taken else where


def _placed(error: UserError, where: str) -> UserError:
    """Return the error of a constructor with the place of its node, which the constructor cannot know.

    A schedule, for example, writes ``schedule.steps``, which is ``optimizer.means_lr.steps`` here.
    """
    text = str(error)
    if not (named := re.match(r"([\w.*]+)\.\w+: ", text)) or f"{named.group(1)}.".startswith(f"{where}."):
        return error
    return UserError(text.replace(f"{named.group(1)}.", f"{where}."))
