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
from contextlib import suppress
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
from cadam3d.io.run_folder import expanded
from cadam3d.settings.compose import escaped
from cadam3d.settings.options import TARGET, config_dir

# The last parts of keys that are never taken from a run: a folder from which this machine would load compiled
# code, and an account to which the run would be sent.
CACHE = "cache_dir"
IGNORED = (CACHE, "entity")
# Parts of keys that name models on the hub, which would be downloaded into the user's cache.
HUB = ("ids", "revision", "model", "models", "base", "tokenizer")
# Groups that change how commands run, not what a run computes.
MACHINERY = ("hydra", "launcher", "grid", "for")
# Settings of a line that a later line does not repeat.
NOT_REPEATED = ("trust", "grid", "launcher")
WORD = r"[A-Za-z0-9_][\w-]*"
KEY = re.compile(rf"{WORD}(?:\.{WORD})*|{WORD}(?:/{WORD})+", re.ASCII)
OPTION = re.compile(rf"{WORD}(?:[./]{WORD})*", re.ASCII)
REFERENCE = re.compile(r"\$\{(?!hydra\b)[\w.]+\}", re.ASCII)
INTERPOLATION = re.compile(r"(?<!\\)(?:\\\\)*\$\{")
# In a YAML file: the targets, and everything that may be the name of a model.
TARGETS = rf"\b{TARGET}:\s*[\"']?([\w.]+)"
NAMES = r"[\w./@-]+"
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
    for line in lines:
        try:
            override = OverridesParser.create().parse_override(line)
        # Brackets within brackets can be too deep for the parser.
        except (HydraException, RecursionError) as error:
            raise _refusal(path, line, "key=value", retry) from error
        key = override.key_or_group
        if key in given:
            continue
        if not _is_setting(override, tuple(folders)):
            expected = "a setting of training with plain values, or components and models of cadam3d"
            raise _refusal(path, line, expected, retry)
        if key.rpartition(".")[2] in IGNORED:
            _note_ignored(key, path)
        else:
            kept.append(line)
    return kept


def read_components(
    path: Path, keys: Sequence[str], folders: Sequence[Path], *, is_trusted: bool, retry: str
) -> DictConfig:
    """Return the prompt, the seed and the components ``keys`` of the run with the configuration ``path``.

    Text that looks like an interpolation stays text. Raises ``UserError`` for a component that the YAML files
    in ``folders`` do not name, unless the run is trusted.
    """
    content = read_yaml(path)
    if not isinstance(content, dict) or not isinstance(content.get("prompt"), str):
        raise UserError(f"{path}: expected the settings of a run, got no prompt. Try: another run")
    chosen = {key: content.get(key) for key in ("prompt", "seed", *keys)}
    for key in keys:
        node = chosen[key]
        if not isinstance(node, dict) or not isinstance(node.get(TARGET), str):
            raise UserError(f"{path}: {key}: expected a component, got {node!r}. Try: another run")
        if is_trusted:
            continue
        if foreign := _foreign(node, tuple(folders)):
            raise _refusal(path, f"{key}: {foreign}", "components and models of cadam3d", retry)
        if node.get(CACHE) is not None:
            _note_ignored(f"{key}.{CACHE}", path)
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
            # A link to nothing, and a file that its process has removed, have no status.
            kind, names = stat.S_IFREG, 1
            with suppress(OSError):
                status = path.stat()
                kind, names = stat.S_IFMT(status.st_mode), status.st_nlink
            if retry is not None and not target.is_relative_to(root):
                got, example = f"a link to {target}", retry
            elif retry is not None and kind == stat.S_IFREG and names > 1:
                got, example = "a hard link", retry
            elif kind in (stat.S_IFREG, stat.S_IFDIR):
                continue
            else:
                got, example = KINDS.get(kind, "something else"), f"rm {shlex.quote(str(path))}"
            raise UserError(f"{path}: expected a file inside {root.name} only, got {got}. Try: {example}")


def _raise_unreadable(error: OSError) -> NoReturn:
    expected = f"a folder that can be read ({error.strerror})"
    raise fail("path", expected=expected, got=error.filename, example="another folder") from error


def _is_setting(override: Override, folders: tuple[Path, ...]) -> bool:
    """Return whether an override only chooses options, or gives plain values to settings of training."""
    key = override.key_or_group
    groups = {path.name for folder in folders for path in folder.glob("*") if path.is_dir()}
    known = groups.union(read_yaml(config_dir() / "train.yaml")) - {*MACHINERY, "defaults"}
    # With a package, as in group@package=option, the value would come to another place.
    is_elsewhere = override.package is not None or not KEY.fullmatch(key) or _root(key) not in known
    if is_elsewhere or override.is_sweep_override():
        return False
    value = override.value()
    if any((folder / key).is_dir() for folder in folders) and not override.is_delete():
        # A name cannot leave the folder of its group.
        names = value if isinstance(value, list) else [value]
        if not all(name is None or (isinstance(name, str) and OPTION.fullmatch(name)) for name in names):
            return False
    texts = [text for _, text in _entries([value]) if isinstance(text, str)]
    return not (
        _foreign(_nested(override), folders)
        or any(keys[-1] in IGNORED for keys, _ in _entries(value))
        or any(INTERPOLATION.search(REFERENCE.sub("_", text)) for text in texts)
    )


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
def _named(pattern: str, folders: tuple[Path, ...]) -> set[str]:
    """Return what matches ``pattern`` in the YAML files of all groups of components in ``folders``."""
    groups = [path.name for path in config_dir().iterdir() if path.is_dir() and path.name not in MACHINERY]
    files = [path for folder in folders for group in groups for path in (folder / group).rglob("*.yaml")]
    return {name for path in files for name in re.findall(pattern, read_text(path))}


def _foreign(node: Any, folders: tuple[Path, ...]) -> str:
    """Return the first entry of plain data that builds or downloads something unknown; "" if there is none.

    Keys with an underscore in front, such as ``_args_``, change how Hydra builds an object. A model is known
    if a YAML file names it, or if this disk has it.
    """
    for keys, value in _entries(node):
        key, is_text = keys[-1], isinstance(value, str)
        if key == TARGET and is_text and (value == CONSTANT or value in _named(TARGETS, folders)):
            continue
        is_model = is_text and set(HUB).intersection(keys) and not os.path.lexists(expanded(value))
        if is_model and value not in _named(NAMES, folders):
            return value
        if not isinstance(key, str) or key.startswith("_"):
            return f"{key}={value}"
    return ""


def _entries(node: Any, outer: tuple[Any, ...] = ()) -> Iterator[tuple[tuple[Any, ...], Any]]:
    """Yield every value in nested dicts and lists, with the keys that lead to it; in a list, it is "item"."""
    items = [("item", each) for each in node] if isinstance(node, list | tuple) else []
    for key, value in node.items() if isinstance(node, dict) else items:
        yield (*outer, key), value
        yield from _entries(value, (*outer, key))


def _refusal(path: Path, found: str, expected: str, retry: str) -> UserError:
    code = "With trust=true, all code that this folder names runs, so use it only if you trust its author."
    return UserError(f"{path}: expected {expected}, got {found[:200]!r}. {code} Try: {retry}")


def _note_ignored(key: str, path: Path) -> None:
    say(f"Note: {key} in {path} is ignored, because only a command line may set it.", logging.WARNING)
