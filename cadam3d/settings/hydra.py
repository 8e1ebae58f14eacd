"""Hydra: read its flags, compose the configuration of a line, and run a command as one of its jobs."""

import os
import re
import sys
from argparse import Namespace
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

import yaml  # comes with OmegaConf
from hydra import main as hydra_main
from hydra._internal.callbacks import Callbacks
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.utils import create_config_search_path, get_args_parser
from hydra.core.utils import JobRuntime, JobStatus, configure_log, run_job
from hydra.types import HydraContext
from hydra.version import VersionBase
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.basecontainer import BaseContainer
from omegaconf.errors import InterpolationKeyError, InterpolationResolutionError

from cadam3d.core.errors import UserError
from cadam3d.settings.advice import default_option, did_you_mean, line_of
from cadam3d.settings.compose import VERSION_BASE, compose, quote, register_resolvers
from cadam3d.settings.line import RUN_FOLDER, key_of
from cadam3d.settings.options import TARGET, config_dir, option_word

# A reference to other settings, such as ${steps}.
REFERENCE = re.compile(r"\$\{[^}]*")
# The groups of which several options can be chosen.
LISTS = ("regularizer", "exporter", "callback", "metric")
Run = Callable[[DictConfig], Any]  # a command, given its composed configuration


def read_flags(flags: Sequence[str]) -> Namespace:
    """Parse the flags of a line. Raises ``UserError`` for unknown ones and for conflicting ones."""
    parser = get_args_parser()
    parser.error = _refuse_flags  # type: ignore[method-assign]
    options = parser.parse_args(list(flags))
    modes = [options.run, options.multirun and not options.cfg, bool(options.cfg), options.info is not None]
    if sum(map(bool, modes)) > 1:
        raise UserError(f"{' '.join(flags)}: these flags cannot be combined. Try: cadam3d --help")
    return options


def compose_line(config_name: str, overrides: Sequence[str], options: Namespace) -> DictConfig:
    """Return the configuration of a line, with Hydra's own node. Raises Hydra's exceptions."""
    return compose(
        overrides,
        options.config_name or config_name,
        folder=Path(options.config_path) if options.config_path else None,
        search_path=options.config_dir,
        with_hydra=True,
    )


def refuse_missing_settings(cfg: DictConfig, command: str, overrides: Sequence[str]) -> None:
    """Refuse a line that removes a top-level setting or refers to a setting that does not exist.

    Raises ``UserError`` for the former and OmegaConf's ``InterpolationKeyError`` for the latter.
    """
    for override in overrides:
        key = key_of(override)
        if override.startswith("~") and "." not in key and "/" not in key and key not in cfg:
            rest = [other for other in overrides if other != override]
            # A job of a sweep is also a line of train.
            line = line_of("train" if command == "sweep" else command, rest)
            raise UserError(f"~{key}: a setting can be changed but not removed. Try: {line}")
        if override.endswith("=[]") and key not in cfg and default_option(key, command):
            raise UserError(f"{key}: expected the name of an option, got []. Try: {option_word(key)}")
    raw = OmegaConf.to_container(cfg, resolve=False)
    assert isinstance(raw, dict)
    # Plain values come first, so that the message names the wrong value and not a setting that refers to it.
    for key in sorted(raw, key=lambda key: isinstance(raw[key], dict)):
        # Hydra's own node refers to values that exist only in a running job.
        if key == "hydra" or "${" not in str(raw[key]):
            continue
        try:
            value = cfg[key]
            if OmegaConf.is_config(value):
                OmegaConf.to_container(value, resolve=True)
        except InterpolationKeyError:
            raise
        except InterpolationResolutionError:
            continue  # such as ${hydra:...}, which only a running job can resolve


def refuse_unread_settings(cfg: DictConfig, command: str, overrides: Sequence[str]) -> None:
    """Refuse what changes nothing: unknown top-level settings, ``camera={}``, and settings of unused members.

    An example of the last kind is ``+callback.candidates.every=5`` if that callback is not chosen. The keys
    of chosen components are checked when these are built. A top-level setting of the user's own YAML is
    accepted if another setting refers to it.
    """
    raw = OmegaConf.to_container(cfg, resolve=False)
    assert isinstance(raw, dict)
    references = " ".join(REFERENCE.findall(str(raw)))
    known = {"hydra", *_declared_names(command)}
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


def place_run(cfg: DictConfig, folder: Path) -> None:
    """Change ``cfg``, in place, as if the line had set ``hydra.run.dir`` to ``folder``."""
    with open_dict(cfg):
        cfg.hydra.run.dir = str(folder)
        kept = [override for override in cfg.hydra.overrides.hydra if key_of(override) != RUN_FOLDER]
        cfg.hydra.overrides.hydra = [f"{RUN_FOLDER}={quote(str(folder))}", *kept]


def run_composed(cfg: DictConfig, run: Run, *, has_log: bool = True) -> None:
    """Run a command on its composed configuration as a job of Hydra.

    The job has its ``.hydra`` folder, ``HydraConfig`` and, if it ``has_log``, its log, for which Hydra
    replaces the handlers of this process. Raises whatever the command raises, which Hydra itself would print
    before it exits.
    """
    if has_log:
        configure_log(cfg.hydra.hydra_logging, cfg.hydra.verbose)
    name, callbacks = cfg.hydra.job.config_name, Callbacks(cfg)
    callbacks.on_run_start(config=cfg, config_name=name)
    loader = ConfigLoaderImpl(config_search_path=create_config_search_path(str(config_dir())))
    job = run_job(
        task_function=run,
        config=cfg,
        job_dir_key=RUN_FOLDER,
        job_subdir_key=None,
        hydra_context=HydraContext(config_loader=loader, callbacks=callbacks),
        configure_logging=has_log,
    )
    callbacks.on_run_end(config=cfg, config_name=name, job_return=job)
    if job.status is JobStatus.FAILED:
        # The property ``return_value`` would print a line first.
        raise job._return_value


@contextmanager
def keeping_globals() -> Iterator[None]:
    """Restore the global state of Hydra and OmegaConf after the block, for programs that use them too.

    This is the version whose behaviour Hydra has, the name of the job, and the functions that YAML files can
    call. :func:`cadam3d.settings.compose.compose` and Hydra itself restore the rest.
    """
    version, runtime = VersionBase.instance(), JobRuntime.instance()
    base, name, resolvers = version.version_base, runtime.get("name"), dict(BaseContainer._resolvers)
    try:
        yield
    finally:
        version.version_base = base
        runtime.set("name", name)
        BaseContainer._resolvers.clear()
        BaseContainer._resolvers.update(resolvers)


def run_hydra(command: str, arguments: Sequence[str], run: Run) -> None:
    """Run Hydra's main function on ``arguments`` and the YAML of ``command``, for a page or for many jobs.

    Raises Hydra's exceptions.
    """
    register_resolvers()
    arguments_before, switch_before = sys.argv, os.environ.get("HYDRA_FULL_ERROR")
    sys.argv = [sys.argv[0], *arguments]
    # Otherwise Hydra would print exceptions and exit.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    try:
        hydra_main(version_base=VERSION_BASE, config_path=str(config_dir()), config_name=command)(run)()
    finally:
        sys.argv = arguments_before
        os.environ["HYDRA_FULL_ERROR"] = switch_before or "0"


def _declared_names(command: str) -> set[str]:
    """Return the settings and groups that the YAML of a command declares, with those that it builds on."""
    page = yaml.safe_load((config_dir() / f"{command}.yaml").read_text(encoding="utf-8"))
    names = set(page) - {"defaults"}
    for entry in page["defaults"]:
        if isinstance(entry, dict):
            names |= set(entry)
        elif entry != "_self_":
            names |= _declared_names(entry)
    return names


def _refuse_flags(message: str) -> NoReturn:
    raise UserError(f"{message}. Try: cadam3d --help")
