"""Trust: settings from the folder of a run are data, because a stranger may have written them.

Hydra builds whatever a ``_target_`` names, so a setting could run any code. A folder may therefore say only
what changes the settings of training: options of the groups, and plain values for settings. A ``_target_``
must be one that the YAML files of this call (from the package and from ``--config-dir``) name themselves;
``cadam3d.settings.check`` refuses one in a wrong place. Nothing from a folder reaches Hydra's own settings,
an interpolation calls no function, and folders of caches are never taken from a run, because compiled kernels
are loaded from there. Everything in the folder is a file with one name, a folder, or a link that stays
inside.

With ``trust=true`` in the command line, nothing is judged.
"""

import logging
import os
import re
import shlex
import stat
from collections.abc import Collection, Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NoReturn

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import DictConfig

from cadam3d.core.checks import fail
from cadam3d.core.console import say
from cadam3d.core.errors import UserError
from cadam3d.io.reading import KINDS, read_text, read_yaml
from cadam3d.io.run_folder import expanded, numbered
from cadam3d.settings.compose import escaped
from cadam3d.settings.options import TARGET, config_dir

# The last part of a key that names a folder from which this machine loads what it has computed earlier.
CACHE = "cache_dir"
# The last parts of keys that are never taken from a run, and why.
IGNORED = {CACHE: "code may be loaded from there", "entity": "the run would be sent to this account"}
# Parts of keys that name models on the hub, which would be downloaded into the user's cache.
HUB = ("ids", "revision", "model", "models", "base", "tokenizer")
# Characters of all overrides of a run. Hydra's parser needs a second for a thousand brackets.
LONGEST = 10_000
# Groups that change how commands run, not what a run computes.
MACHINERY = ("hydra", "launcher", "grid", "for")
# Settings of a line that a later line does not repeat.
NOT_REPEATED = ("trust", "grid", "launcher")
WORD = r"[A-Za-z0-9_][\w-]*"
KEY = re.compile(rf"{WORD}(?:\.{WORD})*|{WORD}(?:/{WORD})+", re.ASCII)
OPTION = re.compile(rf"{WORD}(?:[./]{WORD})*", re.ASCII)
REFERENCE = re.compile(r"\$\{(?!hydra\b)[\w.]+\}", re.ASCII)
INTERPOLATION = re.compile(r"(?<!\\)(?:\\\\)*\$\{")
NAMED_TARGET = re.compile(rf"\b{TARGET}:\s*[\"']?([\w.]+)")
# The only class of this package that a setting may name although no YAML file does.
CONSTANT = "cadam3d.core.schedule.Constant"


def is_trusted(overrides: Sequence[str]) -> bool:
    """Return whether a command line says ``trust=true``, and does not take it back."""
    given = [override.lstrip("+").lower() for override in overrides if _root(override) == "trust"]
    return given[-1:] == ["trust=true"]


def read_overrides(path: Path) -> list[str]:
    """Return the overrides that a run was started with. Raises ``UserError`` if ``path`` is no such list."""
    lines = read_yaml(path) or []
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
    if sum(map(len, lines)) > LONGEST:
        _refuse(path, str(lines), f"overrides of at most {LONGEST:,} characters", retry)
    for line in lines:
        try:
            override = OverridesParser.create().parse_override(line)
        # Brackets within brackets can be too deep for the parser.
        except (HydraException, RecursionError):
            _refuse(path, line, "key=value", retry)
        if expected := _lacking(override, tuple(folders)):
            _refuse(path, line, expected, retry)
        key = override.key_or_group
        if key not in given and _foreign_model(_nested(override), tuple(folders)):
            expected = "a model that the YAML files of cadam3d name"
            got = f"got {line[:200]!r}, which may be downloaded. To allow that, type this setting yourself"
            raise UserError(f"{path}: expected {expected}, {got}. Try: {key}=NAME")
        if (last := key.rpartition(".")[2]) not in IGNORED:
            kept.append(line)
        elif key not in given:
            _note_ignored(key, path, IGNORED[last])
    return kept


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
    stays text. Raises ``UserError`` for a component that the YAML files in ``folders`` do not name, unless
    the run is trusted.
    """
    content = read_yaml(path)
    if not isinstance(content, dict) or not isinstance(content.get("prompt"), str):
        raise UserError(f"{path}: expected the settings of a run, got no prompt. Try: another run")
    keys = [key for key in keys if key in content or key not in optional]
    chosen = {key: content.get(key) for key in ("prompt", "seed", *keys)}
    for key in keys:
        node = chosen[key]
        if not isinstance(node, dict) or not isinstance(node.get(TARGET), str):
            raise UserError(f"{path}: {key}: expected a component, got {node!r}. Try: another run")
        if not is_trusted:
            if unknown := _unknown(node, tuple(folders)):
                _refuse(path, f"{key}: {unknown}", "components that this version of cadam3d has", retry)
            if name := _foreign_model(node, tuple(folders)):
                _refuse(path, f"{key}: {name}", "models that the YAML files of cadam3d name", retry)
            if node.get(CACHE) is not None:
                _note_ignored(f"{key}.{CACHE}", path, IGNORED[CACHE])
                node[CACHE] = None
    return DictConfig(escaped(chosen))


def require_contained(folder: Path, retry: str | None) -> None:
    """Raise ``UserError`` unless ``folder`` holds only files, folders, and links to other places in it.

    A command that writes into the folder would otherwise change a file elsewhere, or wait for a pipe forever.
    A file with a second name (a hard link) is refused too, because that name may be anywhere.
    ``retry`` is the line that trusts the folder; None if it is trusted, so that links may lead anywhere.
    """
    root = folder.resolve()
    for place, folders, files in os.walk(root, onerror=_raise_unreadable):
        for path in (Path(place, name) for name in (*folders, *files)):
            target = Path(os.path.realpath(path))
            if retry is not None and not target.is_relative_to(root):
                expected = f"a link to a place in {root.name}"
                raise UserError(f"{path}: expected {expected}, got one to {target}. Try: {retry}")
            try:
                status = path.stat()
            except OSError:  # a link to nothing, or a file that its process has removed
                continue
            kind = stat.S_IFMT(status.st_mode)
            if retry is not None and kind == stat.S_IFREG and status.st_nlink > 1:
                copy = shlex.join(["cp", "-r", str(root), str(numbered(root))])
                raise UserError(f"{path}: expected a file with one name, got a hard link. Try: {copy}")
            if kind not in (stat.S_IFREG, stat.S_IFDIR):
                got = KINDS.get(kind, "something else")
                raise UserError(f"{path}: expected a file, got {got}. Try: rm {shlex.quote(str(path))}")


def _raise_unreadable(error: OSError) -> NoReturn:
    expected = f"a folder that can be read ({error.strerror})"
    raise fail("path", expected=expected, got=error.filename, example="another folder") from error


def _lacking(override: Override, folders: tuple[Path, ...]) -> str:
    """Return what an override should have been; "" if it may be repeated."""
    key = override.key_or_group
    if override.is_sweep_override():
        return "a single value"
    groups = {path.name for folder in folders for path in folder.glob("*") if path.is_dir()}
    known = groups.union(read_yaml(config_dir() / "train.yaml")) - {*MACHINERY, "defaults"}
    # With a package, as in group@package=option, the value would come to another place.
    if not KEY.fullmatch(key) or override.package is not None or _root(key) not in known:
        return "a setting of training"
    value = override.value()
    if any((folder / key).is_dir() for folder in folders) and not override.is_delete():
        # A name cannot leave the folder of its group.
        names = value if isinstance(value, list) else [value]
        if not all(name is None or (isinstance(name, str) and OPTION.fullmatch(name)) for name in names):
            return "the name of an option"
    if _unknown(_nested(override), folders) or any(name in IGNORED for name, _ in _pairs(value)):
        without = f"without {' or '.join(IGNORED)} in a value"
        return f"plain values and components that this version of cadam3d has, {without}"
    texts = [text for _, text in _pairs([value]) if isinstance(text, str)]
    if any(INTERPOLATION.search(REFERENCE.sub("_", text)) for text in texts):
        return "interpolations that only refer to other settings"
    return ""


def _nested(override: Override) -> Any:
    """Return the value of an override inside dicts with the parts of its key."""
    node: Any = override.value()
    for part in reversed(re.split(r"[./]", override.key_or_group)):
        node = {part: node}
    return node


def _root(line: str) -> str:
    """Return the first part of the key of an override."""
    return re.split(r"[./@=]", line.lstrip("+~"), maxsplit=1)[0]


@cache  # a sweep has many runs
def _yaml_texts(folders: tuple[Path, ...]) -> tuple[str, ...]:
    """Return the YAML files of all groups of components in ``folders``, as text."""
    groups = [path.name for path in config_dir().iterdir() if path.is_dir() and path.name not in MACHINERY]
    files = [path for folder in folders for group in groups for path in (folder / group).rglob("*.yaml")]
    return tuple(map(read_text, files))


@cache
def _known_targets(folders: tuple[Path, ...]) -> frozenset[str]:
    """Return the targets that the YAML files of all groups of components in ``folders`` name."""
    return frozenset([CONSTANT]).union(*map(NAMED_TARGET.findall, _yaml_texts(folders)))


def _foreign_model(node: Any, folders: tuple[Path, ...]) -> str:
    """Return the first name of a model that neither a YAML file names nor this disk has; "" if none is."""
    for name in _hub_names(node):
        named = re.compile(rf"(?<![\w./@-]){re.escape(name)}(?![\w./@-])")
        if not any(map(named.search, _yaml_texts(folders))) and not os.path.lexists(expanded(name)):
            return name
    return ""


def _hub_names(node: Any, is_name: bool = False) -> Iterator[str]:
    """Yield the texts in plain data that may name models on the hub, or versions of them."""
    if isinstance(node, dict):
        for key, value in node.items():
            yield from _hub_names(value, is_name or key in HUB)
    elif isinstance(node, list | tuple):
        for each in node:
            yield from _hub_names(each, is_name)
    elif is_name and isinstance(node, str):
        yield node


def _unknown(node: Any, folders: tuple[Path, ...]) -> str:
    """Return the first key or target in plain data that would build something unknown; "" if there is none.

    Keys with an underscore in front, such as ``_args_``, change how Hydra builds an object.
    """
    for key, value in _pairs(node):
        if key == TARGET and isinstance(value, str) and value in _known_targets(folders):
            continue
        if not isinstance(key, str) or key.startswith("_"):
            return f"{key}={value}"
    return ""


def _pairs(node: Any) -> Iterator[tuple[Any, Any]]:
    """Yield every key with its value in nested dicts and lists; the items of a list have the key "item"."""
    items = [("item", each) for each in node] if isinstance(node, list | tuple) else []
    for key, value in node.items() if isinstance(node, dict) else items:
        yield key, value
        yield from _pairs(value)


def _refuse(path: Path, found: str, expected: str, retry: str) -> NoReturn:
    code = "With trust=true, all code that this folder names runs, so use it only if you trust its author."
    raise UserError(f"{path}: expected {expected}, got {found[:200]!r}. {code} Try: {retry}")


def _note_ignored(key: str, path: Path, why: str) -> None:
    say(f"Note: {key} in {path} is ignored, because {why}.", logging.WARNING)
