"""Settings: where the numbers live, how a command line changes them, and how they become objects."""

import re
import unicodedata
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import yaml  # comes with OmegaConf
from hydra import compose as hydra_compose
from hydra import initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from cadam3d.core.errors import UserError

VERSION_BASE = "1.3"  # Hydra's behaviour is pinned to this version, whatever is installed
WRONG_CALL = r"unexpected keyword|missing (?:a|\d+) required"  # how Python says it
TEXT_KEYS = ("prompt", "negative_prompt")  # always text, so quoted for the user
SLUG_LENGTH = 60  # characters; even of three bytes each they fit a file name


def config_dir() -> Path:
    """The folder of YAML files: inside the installed package, or ``configs/`` of a checkout."""
    package = Path(__file__).parent.parent
    packaged = package / "configs"
    return packaged if packaged.is_dir() else package.parent / "configs"


def compose(
    overrides: Sequence[str] = (),
    config_name: str = "train",
    *,
    folder: Path | None = None,
    search_path: str | None = None,
    with_hydra: bool = False,
) -> DictConfig:
    """The configuration that ``cadam3d <config_name> <overrides>`` would run with.

    ``folder`` replaces :func:`config_dir`, ``search_path`` is one more folder of YAML files, ``with_hydra``
    keeps Hydra's own node. Raises Hydra's exceptions; ``cadam3d.settings.advice`` puts them into words.
    """
    register_resolvers()
    extra = [] if search_path is None else [f"hydra.searchpath=[{quote('file://' + str(search_path))}]"]
    outer = GlobalHydra.instance().hydra  # we may be asked while a command runs, which is inside Hydra
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(str((folder or config_dir()).resolve()), version_base=VERSION_BASE):
            return hydra_compose(config_name, [*extra, *overrides], return_hydra_config=with_hydra)
    finally:
        GlobalHydra.instance().hydra = outer


def component(node: DictConfig | ListConfig | None) -> Any:
    """Build the object that ``node._target_`` names; nested nodes too; lists and dicts become plain Python.

    Raises ``UserError`` for what the configuration got wrong: values out of range, keys that the class does
    not have, keys that it misses, a target that cannot be imported. A bug in a constructor stays what it is.
    """
    try:
        return instantiate(node, _convert_="all")
    except InstantiationException as error:
        raise _construction_error(error) from error
    except OmegaConfBaseException as error:
        raise UserError(f"{error.full_key or 'configuration'}: {str(error.msg).splitlines()[0]}") from error


def components(group: DictConfig) -> dict[str, Any]:
    """Build every chosen member of a group of which several can be chosen, by name.

    An experiment may tune a member that the line did not choose; such a node has keys but no ``_target_``.
    """
    return {str(name): component(node) for name, node in group.items() if "_target_" in node}


def load(path: Path) -> DictConfig:
    """The resolved ``config.yaml`` of a run: what looks like an interpolation there is somebody's text."""
    return DictConfig(_escaped(yaml.safe_load(path.read_text(encoding="utf-8"))))


def flatten(node: object, prefix: str = "", *, with_nodes: bool = False) -> Iterator[tuple[str, object]]:
    """Dotted keys and values of nested dicts; ``with_nodes`` yields the inner dicts as well."""
    if not isinstance(node, dict):
        yield prefix, node
        return
    if with_nodes and prefix:
        yield prefix, node
    for key, value in node.items():
        yield from flatten(value, f"{prefix}.{key}" if prefix else str(key), with_nodes=with_nodes)


def register_resolvers() -> None:
    """Make ``${slug:...}`` and ``${span:...}`` known to OmegaConf; calling it again does nothing new."""
    OmegaConf.register_new_resolver("slug", slug, replace=True)
    OmegaConf.register_new_resolver("span", span, replace=True)


def span(share: float, start: object, *ends: object) -> int:
    """A part of the steps from ``start`` to the first of ``ends``, at least 1.

    Also 1 where they are no whole numbers: whoever owns the wrong key says so.
    """
    if not all(type(step) is int for step in (start, *ends)):
        return 1
    return max(1, round(share * (min(ends) - start)))  # pyright: ignore[reportOperatorIssue, reportArgumentType]


def slug(*parts: object) -> str:
    """A piece of a file name that says ``parts``: ``slug("A red car!")`` is ``"A-red-car"``."""
    text = unicodedata.normalize("NFKC", " ".join(str(part) for part in parts))
    text = re.sub(r"(?:[^\w.=]|(?<!\w)=)+", "-", text).strip("-.")
    return text[:SLUG_LENGTH].rstrip("-.") or "untitled"


def escape(text: str) -> str:
    """Text that OmegaConf reads back as ``text``, even if it holds ``${``."""
    return re.sub(r"(\\*)\$\{", lambda match: match.group(1) * 2 + r"\${", text)


def quote(text: str) -> str:
    r"""``text`` as a quoted value of Hydra's override grammar: it stays text, whatever it holds.

    Inside the quotes a backslash is special before a quote only, so only those are doubled.
    """
    escaped = re.sub(r"(\\*)'", lambda match: match.group(1) * 2 + r"\'", escape(text))
    trailing = len(escaped) - len(escaped.rstrip("\\"))
    return "'" + escaped + "\\" * trailing + "'"


def _construction_error(error: InstantiationException) -> BaseException:
    """What really went wrong: a mistake in the configuration as ``UserError``, a bug as itself."""
    cause = error.__cause__
    key = re.search(r"full_key: (\S+)", str(error))
    where = key.group(1) if key else "configuration"
    if isinstance(cause, TypeError) and (call := re.search(WRONG_CALL, str(cause))):
        names = ", ".join(re.findall(r"'(\w+)'", str(cause)))
        if call.group() == "unexpected keyword":
            return UserError(f"{where}: there is no key {names}. Try: without it; --cfg job lists the keys")
        return UserError(f"{where}: no value for {names}. Try: give one; --cfg job lists the keys")
    if cause is None or isinstance(cause, ImportError):
        reason = str(cause or error).splitlines()[-1]
        return UserError(f"{where}._target_: cannot be loaded ({reason}). Try: cadam3d doctor")
    return cause


def _escaped(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _escaped(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_escaped(item) for item in value]
    return escape(value) if isinstance(value, str) else value
