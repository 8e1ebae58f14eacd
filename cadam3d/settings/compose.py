"""Compose: read the YAML files and apply the overrides of a command line, as Hydra does."""

import os
import re
import sys
import unicodedata
from argparse import Namespace
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.utils import JobRuntime
from hydra.errors import HydraException
from hydra.version import VersionBase
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

from cadam3d.core.checks import require
from cadam3d.core.errors import UserError
from cadam3d.settings.options import config_dir

# Hydra behaves like this version even if a newer one is installed.
VERSION_BASE = "1.3"
# The beginning of Hydra's message for a group that is set to a number or to null.
NO_NAME_COMPLAINT = "Config group override must be a string or a list"
# Values of these keys are always text, so the user need not quote them for Hydra.
TEXT_KEYS = ("prompt", "negative_prompt")
# More folders of YAML files.
SEARCH_PATH = "hydra.searchpath"
# Characters. At three bytes each they still fit into a file name.
SLUG_LENGTH = 60


@dataclass(frozen=True)
class Call:
    """The way in which a command was called, apart from the settings."""

    words: Sequence[str]  # the flags and the overrides as they were typed
    hydra: DictConfig  # Hydra's own node
    folder: Path  # of a run, as the settings name it; absolute
    has_chosen_folder: bool  # whether the line names it

    @property
    def choices(self) -> Mapping[str, str]:
        """Return the chosen option of each group."""
        return self.hydra.runtime.choices

    @property
    def folders(self) -> list[Path]:
        """Return the folders in which Hydra has searched for YAML files. Nothing from a run changes them."""
        return [Path(source.path) for source in self.hydra.runtime.config_sources if source.schema == "file"]


def compose(
    overrides: Sequence[str] = (), config_name: str = "train", flags: Namespace | None = None
) -> DictConfig:
    """Return the configuration that ``cadam3d <config_name> <overrides>`` would run with.

    The ``flags`` of a line can name another configuration and one more folder of YAML files; with them,
    Hydra's own node is kept. Raises Hydra's exceptions, which ``cadam3d.settings.advice`` explains.
    """
    register_resolvers()
    words, place = list(overrides), "configuration"
    if flags is not None:
        config_name = flags.config_name or config_name
    if flags is not None and flags.config_dir is not None:
        place, folder = "--config-dir", Path(flags.config_dir)
        require(folder.is_dir(), place, expected="a folder", got=flags.config_dir, example=f"{place}=.")
        typed = [word for word in words if word.startswith(f"{SEARCH_PATH}=")]
        more = [path for word in typed for path in value_of(word)]
        folders = ",".join(map(quote, [f"file://{folder.absolute()}", *more]))
        words = [*(word for word in words if word not in typed), f"{SEARCH_PATH}=[{folders}]"]
    try:
        job = JobRuntime.instance().get("name")
        with _restoring(), hydra.initialize_config_dir(str(config_dir().resolve()), job, VERSION_BASE):
            cfg = hydra.compose(config_name, words, return_hydra_config=True)
    except (HydraException, OmegaConfBaseException, UserError):
        raise
    # A wrong YAML file, or a deeply nested value, raises an exception of a parser, of a codec or of Python.
    except Exception as error:
        if str(error).startswith(NO_NAME_COMPLAINT):
            raise
        reason = " ".join(str(error).split())[:300] or type(error).__name__
        raise UserError(f"{place}: cannot be read ({reason}). Try: cadam3d {config_name} --help") from error
    if flags is None:
        with open_dict(cfg):
            cfg.pop("hydra", None)
    return cfg


@contextmanager
def _restoring() -> Iterator[None]:
    """Let the block use Hydra, and restore it afterwards, because the calling program may use it."""
    outer, version = GlobalHydra.instance().hydra, VersionBase.instance().version_base
    job = JobRuntime.instance().get("name")
    GlobalHydra.instance().clear()
    try:
        yield
    finally:
        GlobalHydra.instance().hydra = outer
        VersionBase.instance().version_base = version
        JobRuntime.instance().set("name", job)


def run_hydra(
    command: str, arguments: Sequence[str], run: Callable[[DictConfig], Any] = lambda _: None
) -> None:
    """Run Hydra's main function on ``arguments`` and the YAML of ``command``.

    It prints one of Hydra's pages, or lets a launcher call ``run`` for each of many jobs. Raises Hydra's
    exceptions.
    """
    register_resolvers()
    arguments_before, switch_before = sys.argv, os.environ.get("HYDRA_FULL_ERROR")
    sys.argv = [sys.argv[0], *arguments]
    # Otherwise Hydra would print exceptions and exit.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    try:
        with _restoring():
            hydra.main(version_base=VERSION_BASE, config_path=str(config_dir()), config_name=command)(run)()
    finally:
        sys.argv = arguments_before
        os.environ.pop("HYDRA_FULL_ERROR")
        os.environ.update({} if switch_before is None else {"HYDRA_FULL_ERROR": switch_before})


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
    """Register the functions that YAML files call, as in ``${cadam3d.parts:9,12,${steps}}``.

    It is safe to call this again.
    """
    for function in (parts, slug, span):
        OmegaConf.register_new_resolver(f"cadam3d.{function.__name__}", function, replace=True)


def parts(count: int, pieces: int, steps: object, least: int = 1) -> int:
    """Return the number of steps in ``count`` of ``pieces`` equal parts of a run; a part has at least 1 step.

    Each part is rounded down, so keys that share ``pieces`` keep their order and ratio at any length. The
    result is at least ``least``. Returns ``count`` for non-integers; the command reports the error in
    ``steps``.
    """
    return max(least, count * max(1, steps // pieces)) if type(steps) is int else count


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


@cache  # the jobs of a sweep repeat their overrides
def value_of(override: str) -> Any:
    """Return the value of an override as Hydra reads it."""
    return OverridesParser.create().parse_override(override).value()


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
