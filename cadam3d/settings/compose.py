"""Compose: read the YAML files, apply the overrides of a command line, and build the objects."""

import difflib
import re
import shlex
import unicodedata
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import yaml  # comes with OmegaConf
from hydra import version
from hydra._internal.hydra import Hydra
from hydra._internal.utils import create_config_search_path
from hydra.core.config_search_path import SearchPathQuery
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import InstantiationException
from hydra.types import RunMode
from hydra.utils import instantiate
from omegaconf import DictConfig, ListConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

from cadam3d.core.errors import UserError

# Hydra behaves like this version even if a newer one is installed.
VERSION_BASE = "1.3"
# Python's wording of the two kinds of wrong calls.
WRONG_CALL = r"unexpected keyword|missing (?:a|\d+) required"
# Values of these keys are always text, so the user need not quote them for Hydra.
TEXT_KEYS = ("prompt", "negative_prompt")
# Characters. At three bytes each they still fit into a file name.
SLUG_LENGTH = 60


def config_dir() -> Path:
    """Return the folder of YAML files: inside the installed package, or ``configs/`` of a checkout."""
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
    """Return the configuration that ``cadam3d <config_name> <overrides>`` would run with.

    ``folder`` replaces :func:`config_dir`, ``search_path`` is one more folder of YAML files, ``with_hydra``
    keeps Hydra's own node. Raises Hydra's exceptions; ``cadam3d.settings.advice`` explains them to the user.
    """
    register_resolvers()
    places = create_config_search_path(str((folder or config_dir()).resolve()))
    if search_path is not None:
        own = Path(search_path).absolute()
        if not own.is_dir():
            raise UserError(f"--config-dir: expected a folder, got {search_path!r}. Try: {_folder_like(own)}")
        places.prepend("command-line", f"file://{own}", anchor=SearchPathQuery(provider="schema"))
    # A command that runs inside Hydra may compose too, so Hydra's global state is restored afterwards.
    outer = GlobalHydra.instance().hydra
    GlobalHydra.instance().clear()
    version.setbase(VERSION_BASE)
    try:
        cfg = Hydra.create_main_hydra2("cadam3d", places).compose_config(
            config_name, list(overrides), run_mode=RunMode.RUN, from_shell=False
        )
    finally:
        GlobalHydra.instance().hydra = outer
    if not with_hydra:
        with open_dict(cfg):
            cfg.pop("hydra", None)
    return cfg


def _folder_like(missing: Path) -> str:
    """Return the flag for the folder whose name is nearest to ``missing``, or for the current folder."""
    beside = sorted(place.name for place in missing.parent.glob("*/") if place.is_dir())
    near = difflib.get_close_matches(missing.name, beside, n=1)
    return shlex.quote(f"--config-dir={missing.with_name(near[0]) if near else '.'}")


def component(node: DictConfig | ListConfig | None) -> Any:
    """Build the object that ``node._target_`` names, and nested ones; lists and dicts become plain Python.

    Raises ``UserError`` for mistakes in the configuration: values out of range, unknown keys, missing keys, a
    target that cannot be imported. A bug in a constructor raises its own exception.
    """
    try:
        return instantiate(node, _convert_="all")
    except InstantiationException as error:
        raise _construction_error(error) from error
    except OmegaConfBaseException as error:
        reason = str(error.msg).splitlines()[0]
        raise UserError(
            f"{error.full_key or 'configuration'}: {reason}. Try: cadam3d train --cfg job"
        ) from error


def components(group: DictConfig) -> dict[str, Any]:
    """Build every chosen member of a group of which several can be chosen, by name.

    An experiment may tune a member that the line has not chosen; such a node has keys but no ``_target_``.
    """
    return {str(name): component(node) for name, node in group.items() if "_target_" in node}


def load_config(path: Path) -> DictConfig:
    """Return the resolved ``config.yaml`` of a run. Text that looks like an interpolation stays text."""
    return DictConfig(_escaped(yaml.safe_load(path.read_text(encoding="utf-8"))))


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
    """Register ``${slug:...}`` and ``${span:...}`` with OmegaConf. It is safe to call this again."""
    OmegaConf.register_new_resolver("slug", slug, replace=True)
    OmegaConf.register_new_resolver("span", span, replace=True)


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


def quote(text: str) -> str:
    r"""Return ``text`` as a quoted value of Hydra's override grammar, which reads it as plain text.

    Inside the quotes, a backslash is special only before a quote, so only such backslashes are doubled.
    """
    escaped = re.sub(r"(\\*)'", lambda match: match.group(1) * 2 + r"\'", escape(text))
    trailing = len(escaped) - len(escaped.rstrip("\\"))
    return "'" + escaped + "\\" * trailing + "'"


def _construction_error(error: InstantiationException) -> BaseException:
    """Return ``UserError`` for a mistake in the configuration, or else the exception of the constructor."""
    cause = error.__cause__
    key = re.search(r"full_key: (\S+)", str(error))
    where = key.group(1) if key else "configuration"
    if isinstance(cause, TypeError) and (call := re.search(WRONG_CALL, str(cause))):
        names = ", ".join(re.findall(r"'(\w+)'", str(cause)))
        if call.group() == "unexpected keyword":
            return UserError(f"{where}: there is no key {names}. Try: cadam3d train --cfg job")
        return UserError(f"{where}: no value for {names}. Try: cadam3d train --cfg job")
    if cause is None or isinstance(cause, ImportError):
        reason = str(cause or error).splitlines()[-1]
        return UserError(f"{where}._target_: cannot be loaded ({reason}). Try: cadam3d doctor")
    if isinstance(cause, UserError) and key:
        # A schedule or a regularizer does not know the key under which it is used.
        return UserError(re.sub(r"\b(?:schedule|regularizer\.\*)\.", f"{where}.", str(cause)))
    return cause


def _escaped(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _escaped(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_escaped(item) for item in value]
    return escape(value) if isinstance(value, str) else value
