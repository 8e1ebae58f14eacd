"""Hydra: refuse settings that have no effect, and run Hydra's main function for its pages and launchers."""

import os
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import hydra
from omegaconf import DictConfig, OmegaConf

from cadam3d.core.errors import UserError
from cadam3d.settings.advice import declared_names, did_you_mean
from cadam3d.settings.compose import VERSION_BASE, register_resolvers
from cadam3d.settings.line import key_of
from cadam3d.settings.options import TARGET, config_dir, default_option, option_word

# A reference to other settings, such as ${steps}.
REFERENCE = re.compile(r"\$\{[^}]*")
# The groups of which several options can be chosen.
LISTS = ("regularizer", "exporter", "callback", "metric")


def refuse_missing_settings(cfg: DictConfig, command: str, overrides: Sequence[str]) -> None:
    """Refuse a line that removes a top-level setting or refers to something that does not exist.

    Raises ``UserError`` for the former and OmegaConf's ``InterpolationResolutionError`` for the latter.
    """
    for override in overrides:
        key = key_of(override)
        if override.startswith("~") and "." not in key and "/" not in key and key not in cfg:
            page = "train" if command == "sweep" else command
            raise UserError(
                f"~{key}: a setting can be changed but not removed. Try: cadam3d {page} --cfg job"
            )
        if override.endswith("=[]") and key not in cfg and default_option(key, command):
            raise UserError(f"{key}: expected the name of an option, got []. Try: {option_word(key)}")
    raw = OmegaConf.to_container(cfg, resolve=False)
    assert isinstance(raw, dict)
    # Plain values come first, so that the message names the wrong value and not a setting that refers to it.
    for key in sorted(raw, key=lambda key: isinstance(raw[key], dict)):
        if key != "hydra" and "${" in str(raw[key]) and OmegaConf.is_config(value := cfg[key]):
            OmegaConf.to_container(value, resolve=True)


def refuse_unread_settings(cfg: DictConfig, command: str, overrides: Sequence[str]) -> None:
    """Refuse what changes nothing: unknown top-level settings, ``camera={}``, and settings of unused members.

    An example of the last kind is ``+callback.candidates.every=5`` if that callback is not chosen. The keys
    of chosen components are checked when these are built. A top-level setting of the user's own YAML is
    accepted if another setting refers to it.
    """
    raw = OmegaConf.to_container(cfg, resolve=False)
    assert isinstance(raw, dict)
    references = " ".join(REFERENCE.findall(str(raw)))
    known = {"hydra", *declared_names(command)}
    for name in map(str, raw):
        if name not in known and not re.search(rf"\b{re.escape(name)}\b", references):
            near = did_you_mean(name, sorted(known))
            meant = f" Did you mean {near[0]}?" if near else ""
            # A sweep has such a page only for a line with jobs.
            page = "train" if command == "sweep" else command
            raise UserError(f"{name}: no such setting.{meant} Try: cadam3d {page} --cfg job")
    folders = [Path(source.path) for source in cfg.hydra.runtime.config_sources if source.schema == "file"]
    for override in overrides:
        key = key_of(override)
        group, _, rest = key.partition(".")
        node = raw.get(group)
        if not isinstance(node, dict) or override.startswith("~"):
            continue
        if not rest and override.endswith("={}"):
            raise UserError(f"{key}: {{}} changes nothing. Try: {option_word(key)}")
        member = rest.partition(".")[0]
        if group in LISTS and isinstance(node.get(member), dict) and TARGET not in node[member]:
            if not any((folder / group / f"{member}.yaml").is_file() for folder in folders):
                raise UserError(f"{key}: {group} has no option {member}. Try: cadam3d {command} --help")
            chosen = ",".join([*(name for name in node if name != member), member])
            raise UserError(f"{group}.{member}: is not chosen. Try: '{group}=[{chosen}]'")


def print_nothing(_cfg: DictConfig) -> None:
    """Do nothing, as the function that Hydra does not call when it prints a page."""


def run_hydra(
    command: str, arguments: Sequence[str], run: Callable[[DictConfig], Any] = print_nothing
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
        hydra.main(version_base=VERSION_BASE, config_path=str(config_dir()), config_name=command)(run)()
    finally:
        sys.argv = arguments_before
        os.environ["HYDRA_FULL_ERROR"] = switch_before or "0"
