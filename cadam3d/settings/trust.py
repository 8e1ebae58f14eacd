"""Trust: settings from the folder of a run are data, because a stranger may have written them.

Hydra builds whatever a ``_target_`` names, so a setting can run any code. This module therefore accepts from
a folder only what an honest run leaves there:

- A ``_target_`` must be one that the YAML files of this call (those of the package and of ``--config-dir``)
  name for the same place. Schedules may be anywhere inside a component.
- An override must change a setting of training. Nothing from a folder reaches Hydra's own settings.
- An interpolation may refer to other settings and call ``slug`` and ``span``, which compute from them.
- Folders of caches are never taken from a run, because compiled kernels are loaded from there.
- Everything in the folder is a file, a folder, or a link that stays inside, because a command writes there.

With ``trust=true`` in the command line, nothing is judged.
"""

import inspect
import logging
import os
import re
import shlex
import stat
from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import yaml  # comes with OmegaConf
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from hydra.utils import get_object
from omegaconf import DictConfig, OmegaConf

from cadam3d.core import schedule
from cadam3d.core.console import say
from cadam3d.core.errors import UserError
from cadam3d.io.reading import KINDS, read_yaml
from cadam3d.settings.compose import LONGEST_KEY, escaped
from cadam3d.settings.options import TARGET, config_dir

LISTS = (list, tuple)  # OmegaConf makes lists of both
# The last part of a key that names a folder from which this machine loads what it has computed earlier.
CACHE = "cache_dir"
# Characters of all overrides of a run. Hydra's parser needs a second for a thousand brackets.
LONGEST = 10_000
# Groups that change how commands run, not what a run computes.
MACHINERY = ("hydra", "launcher", "grid", "for")
# Settings of a line that a later line does not repeat.
NOT_REPEATED = ("trust", "grid", "launcher")
PLAIN_NAMES = f"names without an underscore in front, except {TARGET}"
WORD = r"[A-Za-z0-9_][\w-]*"
KEY = re.compile(rf"{WORD}(?:\.{WORD})*|{WORD}(?:/{WORD})+", re.ASCII)
OPTION = re.compile(rf"{WORD}(?:[./]{WORD})*", re.ASCII)
OVERRIDE = re.compile(r"(?:\+{0,2}|~)([^=+~]*)(?:=.*)?", re.DOTALL)
# What Hydra reads in the first line of a YAML file.
PACKAGE = re.compile(r"#\s*@package\s+(\S+)")
REFERENCE = re.compile(r"\$\{([\w.]+)\}", re.ASCII)
# An interpolation without another one inside it, of the kinds that only read other settings.
HARMLESS = re.compile(r"\$\{(?:[\w.]+|(?:slug|span):[^${}]*)\}", re.ASCII)
INTERPOLATION = re.compile(r"(?<!\\)(?:\\\\)*\$\{")
SCHEDULES = frozenset(
    f"{kind.__module__}.{kind.__qualname__}"
    for kind in vars(schedule).values()
    if isinstance(kind, type) and issubclass(kind, schedule.Schedule) and not inspect.isabstract(kind)
)

Where = tuple[str, ...]  # the parts of a key; an item of a list is "*"


@dataclass(frozen=True)
class Registry:
    """The components that may be built, by the place of the configuration where they belong."""

    slots: Mapping[str, Collection[str]]  # dotted key, or group and "*" where members have any name
    named: Collection[str] = field(default=())  # targets that this command line itself names

    @classmethod
    def of(cls, folders: Sequence[Path], named: Collection[str] = ()) -> "Registry":
        """Return the targets in the YAML files of the groups in ``folders``, and the ``named`` ones."""
        return cls(_slots(tuple(folders)), named)

    def accepts(self, where: Where, target: object) -> bool:
        """Return whether ``target`` may be built at ``where``."""
        if not isinstance(target, str):
            return False
        slot = _general(".".join(where), self.slots)
        if slot not in self.slots and len(where) > 1 and target in SCHEDULES:
            return True
        return target in self.slots.get(slot, ()) or target in self.named


@cache  # a sweep has many runs
def _slots(folders: tuple[Path, ...]) -> dict[str, set[str]]:
    """Return the targets that the YAML files in ``folders`` name, by place."""
    found: dict[str, set[str]] = defaultdict(set)
    references: dict[str, str] = {}
    for folder in folders:
        for path in _options(folder):
            for where, value in _leaves(*_content(path, folder)):
                if where[-1:] == (TARGET,) and value not in SCHEDULES:
                    found[".".join(where[:-1])].add(str(value))
                elif reference := REFERENCE.fullmatch(str(value)):
                    references[".".join(where)] = reference.group(1)
    # Such as prior.prompting, which refers to the group prompting.
    for slot, other in references.items():
        if other in found:
            found[slot] |= found[other]
    slots: dict[str, set[str]] = defaultdict(set)
    for slot, targets in found.items():
        slots[_general(slot, found)] |= targets
    return dict(slots)


def is_trusted(overrides: Sequence[str]) -> bool:
    """Return whether a command line says ``trust=true``. Raises ``UserError`` for other values of it."""
    value = False
    for override in overrides:
        if override.partition("=")[0].lstrip("+") == "trust":
            value = OverridesParser.create().parse_override(override).value()
    return require_trust(value)


def require_trust(value: object) -> bool:
    """Return the value of ``trust``. Raises ``UserError`` unless it is true or false."""
    if not isinstance(value, bool):
        raise UserError(f"trust: expected true or false, got {value!r}. Try: trust=false")
    return value


def search_folders(sources: Sequence[Any]) -> list[Path]:
    """Return the folders in which Hydra has searched for the YAML files of this call.

    ``sources`` is ``hydra.runtime.config_sources``, which nothing from a run can change.
    """
    return [Path(source.path) for source in sources if source.schema == "file"]


def targets_in(overrides: Sequence[str]) -> set[str]:
    """Return every target that the overrides of a command line name."""
    found = set()
    for override in OverridesParser.create().parse_overrides(list(overrides)):
        where = tuple(override.key_or_group.split("."))
        found |= {str(value) for place, value in _leaves(override.value(), where) if place[-1] == TARGET}
    return found


# --- overrides.yaml, which a resumed run repeats ----------------------------------------------------------


def read_overrides(path: Path) -> list[str]:
    """Return the overrides that a run was started with. Raises ``UserError`` if ``path`` is no such list."""
    lines = read_yaml(path)
    lines = [] if lines is None else lines
    if not isinstance(lines, list) or not all(isinstance(line, str) for line in lines):
        raise UserError(f"{path}: expected a list of key=value, got other data. Try: another run")
    return [line for line in lines if _root(line) not in NOT_REPEATED]


def judge_overrides(
    lines: Sequence[str], path: Path, given: Collection[str], folders: Sequence[Path], retry: str
) -> list[str]:
    """Return the overrides of a run that a command line may repeat.

    ``path`` is the file that holds them, ``given`` are the keys that the line itself sets, ``folders`` those
    of YAML files, and ``retry`` is the line that trusts the run. Raises ``UserError`` for an override that
    could do more than change a setting.
    """
    kept = []
    if (length := sum(map(len, lines))) > LONGEST:
        expected = f"overrides of at most {LONGEST:,} characters together"
        raise _refusal(path, f"{length:,} characters", expected, retry)
    for line in lines:
        override, expected = _judged(line, folders)
        if override is None or expected:
            raise _refusal(path, line, expected, retry)
        key = override.key_or_group
        if key.rpartition(".")[2] == CACHE:
            if key not in given:
                _note_cache(key, path, f"{key}=DIR")
        else:
            kept.append(line)
    return kept


def judge_composition(cfg: DictConfig, path: Path, named: Collection[str], retry: str) -> None:
    """Raise ``UserError`` unless every component of ``cfg`` may be built.

    ``cfg`` is composed of the overrides in ``path`` and those of this line, which names the targets
    ``named``. It still has Hydra's own node.
    """
    registry = Registry.of(search_folders(cfg.hydra.runtime.config_sources), named)
    for key in cfg:
        if key != "hydra":
            value = OmegaConf.select(cfg, str(key))
            plain = OmegaConf.to_container(value, resolve=True) if OmegaConf.is_config(value) else value
            _judge_targets(plain, (str(key),), registry, path, retry)


def _judged(line: str, folders: Sequence[Path]) -> tuple[Override | None, str]:
    """Parse an override, and return what it should have been; "" if it may be repeated."""
    try:
        override = OverridesParser.create().parse_override(line)
    # Brackets within brackets can be too deep for the parser.
    except (HydraException, RecursionError):
        return None, "key=value"
    key = override.key_or_group
    written = OVERRIDE.fullmatch(line)
    if len(key) > LONGEST_KEY:
        return override, f"a key of at most {LONGEST_KEY} characters"
    is_group = any((folder / key).is_dir() for folder in folders)
    expected = ""
    # A package (group@package=option) is not part of this key, so it is refused here too.
    if not KEY.fullmatch(key) or written is None or written.group(1) != key:
        expected = "a plain key"
    elif _root(line) not in _roots(folders):
        expected = "a setting of training"
    elif override.is_sweep_override():
        expected = "a single value"
    elif any(map(_is_special, [*re.split(r"[./]", key), *_keys(override.value())])):
        expected = PLAIN_NAMES
    elif is_group and not override.is_delete() and not _are_options(override.value()):
        expected = "the name of an option"
    elif not all(_is_harmless(value) for _, value in _leaves(override.value(), ("",))):
        expected = "interpolations that only refer to other settings"
    return override, expected


def _root(line: str) -> str:
    """Return the first part of the key of an override."""
    return re.split(r"[./@=]", line.lstrip("+~"), maxsplit=1)[0]


def _roots(folders: Sequence[Path]) -> set[str]:
    """Return the first parts that the key of a setting of training can have."""
    own = read_yaml(config_dir() / "train.yaml")
    groups = {path.name for folder in folders for path in folder.glob("*") if path.is_dir()}
    return (groups | own.keys()) - {*MACHINERY, "defaults"}


def _are_options(value: object) -> bool:
    """Return whether ``value`` names options. A name cannot leave the folder of its group."""
    names = value if isinstance(value, list) else [value]
    return all(name is None or (isinstance(name, str) and OPTION.fullmatch(name)) for name in names)


def _is_harmless(value: object) -> bool:
    """Return whether all interpolations in a value only read other settings."""
    if not isinstance(value, str):
        return True
    before = ""
    while before != value:
        before, value = value, HARMLESS.sub("_", value)
    return not INTERPOLATION.search(value)


def _is_special(key: object) -> bool:
    """Return whether a key would change how Hydra builds a component, such as ``_args_``."""
    return not isinstance(key, str) or (key.startswith("_") and key != TARGET)


def _keys(node: Any) -> Iterator[object]:
    """Yield every key in nested dicts and lists."""
    if isinstance(node, dict):
        yield from node
    for value in node.values() if isinstance(node, dict) else node if isinstance(node, LISTS) else ():
        yield from _keys(value)


# --- config.yaml, from which a finished run is measured ---------------------------------------------------


def read_components(
    path: Path,
    keys: Sequence[str],
    folders: Sequence[Path],
    *,
    is_trusted: bool,
    retry: str,
    optional: Collection[str] = (),
) -> DictConfig:
    """Return the prompt, the seed and the components ``keys`` of the run with the configuration ``path``.

    Those of ``optional`` that the file does not have are left out. Text that looks like an interpolation
    stays text. Raises ``UserError`` for a component that is not in the YAML files in ``folders``, unless the
    run is trusted, and for settings that the component does not have.
    """
    content = read_yaml(path)
    content = content if isinstance(content, dict) else {}
    keys = [key for key in keys if key in content or key not in optional]
    chosen = {key: content.get(key) for key in ("prompt", "seed", *keys)}
    if not isinstance(chosen.get("prompt"), str):
        raise UserError(f"{path}: expected the settings of a run, got no prompt. Try: another run")
    registry = Registry.of(folders)
    for key in keys:
        node = chosen[key]
        if not isinstance(node, dict) or not isinstance(node.get(TARGET), str):
            raise UserError(f"{path}: {key}: expected a component, got {node!r}. Try: another run")
        if not is_trusted:
            if special := [name for name in _keys(node) if _is_special(name)]:
                raise _refusal(path, f"{key}.{special[0]}", PLAIN_NAMES, retry)
            _judge_targets(node, (key,), registry, path, retry)
            if node.get(CACHE) is not None:
                _note_cache(f"{key}.{CACHE}", path, "trust=true")
                node[CACHE] = None
            _require_settings(node, key, path)
    return DictConfig(escaped(chosen))


def _require_settings(node: Any, key: str, path: Path) -> None:
    """Raise ``UserError`` unless every component in ``node`` has exactly the settings that it needs."""
    if isinstance(node, dict):
        if TARGET in node:
            try:
                call = inspect.signature(get_object(node[TARGET]))
            # Importing it may raise anything, which building the component reports.
            except Exception:
                return
            try:
                call.bind(**{name: None for name in node if name != TARGET})
            except TypeError as error:
                again = shlex.quote(f"resume={path.parent}")
                raise UserError(
                    f"{path}: {key}: expected the settings of {node[TARGET]} in this version, got others "
                    f"({error}). Try: cadam3d train {again}, which writes the file again"
                ) from error
        for name, value in node.items():
            _require_settings(value, f"{key}.{name}", path)
    elif isinstance(node, list):
        for value in node:
            _require_settings(value, key, path)


# --- the folder -------------------------------------------------------------------------------------------


def require_contained(folder: Path, retry: str | None) -> None:
    """Raise ``UserError`` unless ``folder`` holds only files, folders, and links to other places in it.

    A command that writes into the folder would otherwise change a file elsewhere, or wait for a pipe forever.
    ``retry`` is the line that trusts the folder; None if it is trusted, so that links may lead anywhere.
    """
    root = folder.resolve()
    waiting = [str(root)]
    try:
        while waiting:
            with os.scandir(waiting.pop()) as entries:
                for entry in entries:
                    if entry.is_symlink():
                        if retry is not None:
                            _require_inside(entry.path, root, retry)
                        if not entry.is_dir() and not entry.is_file() and Path(entry.path).exists():
                            raise _special(entry)
                    elif entry.is_dir():
                        waiting.append(entry.path)
                    elif not entry.is_file():
                        raise _special(entry)
    except OSError as error:
        reason = error.strerror or error
        raise UserError(
            f"{error.filename}: expected a folder that can be read ({reason}). Try: another folder"
        ) from error


def _special(entry: os.DirEntry[str]) -> UserError:
    """Return the error for a pipe, a device or a socket in the folder of a run."""
    kind = KINDS.get(stat.S_IFMT(entry.stat().st_mode), "something else")
    return UserError(f"{entry.path}: expected a file, got {kind}. Try: rm {shlex.quote(entry.path)}")


def _require_inside(link: str, root: Path, retry: str) -> None:
    target = os.path.realpath(link)
    if not Path(target).is_relative_to(root):
        raise UserError(
            f"{link}: expected a link to another place in {root.name}, got one to {target}. A command "
            f"that writes there would change files elsewhere. Try: {retry}"
        )


# --- shared -----------------------------------------------------------------------------------------------


def _judge_targets(node: Any, where: Where, registry: Registry, path: Path, retry: str) -> None:
    """Raise ``UserError`` unless the registry accepts every target in plain data."""
    if isinstance(node, dict):
        if TARGET in node and not registry.accepts(where, node[TARGET]):
            found = f"{'.'.join(where)}.{TARGET}={node[TARGET]}"
            raise _refusal(path, found, "a component of this version of cadam3d or of --config-dir", retry)
        for key, value in node.items():
            _judge_targets(value, (*where, str(key)), registry, path, retry)
    elif isinstance(node, LISTS):
        for value in node:
            _judge_targets(value, (*where, "*"), registry, path, retry)


def _leaves(node: Any, where: Where) -> Iterator[tuple[Where, Any]]:
    """Yield every value of nested dicts and lists with its key."""
    if isinstance(node, dict):
        for key, value in node.items():
            yield from _leaves(value, (*where, str(key)))
    elif isinstance(node, LISTS):
        for value in node:
            yield from _leaves(value, (*where, "*"))
    else:
        yield where, node


def _general(slot: str, slots: Collection[str]) -> str:
    """Return ``exporter.*`` for ``exporter.ply``: members of a group without its own target have names."""
    root, *rest = slot.split(".")
    return ".".join([root, "*", *rest[1:]]) if rest and root not in slots else slot


def _options(folder: Path) -> Iterator[Path]:
    """Yield the YAML files of the groups in ``folder`` that the package has too."""
    groups = sorted(path.name for path in config_dir().iterdir() if path.is_dir())
    for group in groups:
        if group not in MACHINERY:
            yield from sorted(path for path in (folder / group).rglob("*.yaml") if path.is_file())


def _content(path: Path, folder: Path) -> tuple[Any, Where]:
    """Return the plain content of a YAML file and the key under which it is composed.

    A file that cannot be read registers nothing; Hydra reports it where it is used.
    """
    try:
        text = path.read_text(encoding="utf-8")
        # The loader in C is ten times as fast, but not every build of PyYAML has it.
        content = yaml.load(text, getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    except (OSError, ValueError, yaml.YAMLError):
        return None, ("",)
    package = PACKAGE.match(text)
    if package is None:
        return content, path.parent.relative_to(folder).parts
    return content, () if package.group(1) == "_global_" else tuple(package.group(1).split("."))


def _refusal(path: Path, found: str, expected: str, retry: str) -> UserError:
    return UserError(
        f"{path}: expected {expected}, got {found[:200]!r}. With trust=true, all code that this folder names "
        f"runs, so use it only if you trust the author of the folder. Try: {retry}"
    )


def _note_cache(key: str, path: Path, how: str) -> None:
    say(
        f"Note: {key} in {path} is ignored, because code may be loaded from there. To set it, add {how}.",
        logging.WARNING,
    )
