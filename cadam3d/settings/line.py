"""Line: read the words after ``cadam3d COMMAND``: overrides, flags, quoting, and resuming a run."""

import argparse
import os
import re
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from cadam3d.core.errors import UserError
from cadam3d.io.run_folder import LATEST, OVERRIDES, RUN_FOLDER, has_file, setting_word, typed_path
from cadam3d.settings.compose import TEXT_KEYS, quote
from cadam3d.settings.options import config_dir
from cadam3d.settings.trust import is_trusted, judge_overrides, read_overrides, require_contained

SWEEP_FOLDER = "hydra.sweep.dir"
# Values of these keys are quoted if necessary: paths, and a text that may be null.
PATH_KEYS = (
    *("run", "ply", "output", "resume", RUN_FOLDER, SWEEP_FOLDER),
    *("initializer.path", "initializer.prompt", "rasterizer.cache_dir"),
    *("runs", "answers", "key", "consent"),
    *("prompts", "prompts.file", "prompts.category"),
    "prompts.shard",
)
# Whether the jobs of a sweep are only listed, and where they run. No run has these settings.
DRY_RUN = "dry_run"
LAUNCHER_KEY = re.compile(r"launcher($|\.)|hydra[./]launcher($|\.)")
# Settings of a line that trains several seeds, which its runs do not have.
OF_ATTEMPTS = ("attempts", "select")
# Settings of a line that do not change what a run computes, so they may differ when it is continued.
NOT_OF_A_RUN = ("resume", "trust", *OF_ATTEMPTS)
# Keys whose value may be a list of paths or of texts, such as run=[A,B].
LIST_KEYS = ("run", "runs", "labels", "arms", "answers")
# A path that Hydra's grammar reads without quotes. It cannot read "~".
PLAIN_PATH = re.compile(r"[\w./+-]*", re.ASCII)
# What the grammar reads as a number or a truth value, although it may be the name of a folder.
NOT_A_TEXT = re.compile(
    r"[+-]?([\d_.]*\d[\d_.]*(e[+-]?\d[\d_]*)?|nan|inf)|true|false", re.IGNORECASE | re.ASCII
)
QUOTED = re.compile(r"""'(?:[^'\\]|\\.)*'|"(?:[^"\\]|\\.)*\"""", re.DOTALL)
SWEEP_CALL = re.compile(r"(choice|range|interval|glob|sort|shuffle|tag)\(.*\)", re.DOTALL)
# A comma between two prompts; one before a space belongs to a sentence.
SEPARATOR = r",(?!\s|$)"
FLAGS_WITH_VALUE = (
    *("--cfg", "-c", "--package", "-p", "--info", "-i"),
    *("--config-path", "-cp", "--config-name", "-cn", "--config-dir", "-cd"),
)
# The settings of Hydra that have an effect.
HYDRA_KEYS = re.compile(
    r"hydra\.(run\.dir|sweep\.dir|sweep\.subdir|searchpath|mode)$|hydra[./](launcher|sweeper)\b"
)


@dataclass(frozen=True)
class Line:
    """The parsed command line after ``cadam3d``."""

    command: str
    overrides: list[str]  # quoted for Hydra
    flags: list[str]
    options: argparse.Namespace  # the flags, parsed
    is_sweep: bool
    words: list[str]  # the overrides as they were typed

    @property
    def trusting(self) -> str:
        """Return what to type to trust the folder of a resumed run."""
        return shlex.join(["cadam3d", self.command, *self.words, *self.flags, "trust=true"])

    @property
    def wants_page(self) -> bool:
        """Return whether the line asks for a page, and not for work."""
        options = self.options
        pages = (options.help, options.cfg, options.hydra_help, options.info, options.shell_completion)
        return any(pages)


class _Flags(argparse.ArgumentParser):
    """The flags of every command: the ones of Hydra that are useful here."""

    def __init__(self) -> None:
        super().__init__(add_help=False, allow_abbrev=False)
        for names in ("--help -h", "--hydra-help", "--multirun -m", "--resolve", "--shell-completion -sc"):
            self.add_argument(*names.split(), action="store_true")
        for names in ("--package -p", "--config-path -cp", "--config-name -cn", "--config-dir -cd"):
            self.add_argument(*names.split())
        self.add_argument("--cfg", "-c", choices=("job", "hydra", "all"))
        pages = ("all", "config", "defaults", "defaults-tree", "plugins", "searchpath")
        self.add_argument("--info", "-i", nargs="?", const="all", choices=pages)

    def error(self, message: str) -> NoReturn:
        """Raise ``UserError``."""
        raise UserError(f"{message}. Try: cadam3d --help")


def read_flags(flags: Sequence[str]) -> argparse.Namespace:
    """Parse the flags of a line. Raises ``UserError`` for unknown ones and for conflicting ones."""
    options = _Flags().parse_args(list(flags))
    if sum(map(bool, (options.multirun and not options.cfg, options.cfg, options.info))) > 1:
        raise UserError(f"{' '.join(flags)}: these flags cannot be combined. Try: cadam3d --help")
    return options


def split(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """Separate overrides from flags, which may be anywhere in the line."""
    overrides, flags = [], []
    takes_value = False
    for word in words:
        if takes_value or word.startswith("-"):
            flags.append(word)
            takes_value = not takes_value and word in FLAGS_WITH_VALUE
        else:
            overrides.append(word)
    return overrides, flags


def key_of(override: str) -> str:
    """Return the key of an override, without ``+`` or ``~``."""
    return override.partition("=")[0].lstrip("+~")


def text_of(override: str) -> str:
    """Return the value of an override as plain text."""
    value = OverridesParser.create().parse_override(override).value()
    return OmegaConf.create({"value": value}).value if isinstance(value, str) else str(value or "null")


def quoted(override: str, *, is_sweep: bool) -> str:
    """Quote a prompt or a path, so that commas, brackets, ``=`` or emoji in it are plain text to Hydra.

    In a sweep, a comma before a space belongs to the sentence and any other comma separates two prompts:
    ``prompt="a corgi, front view,a cat"`` is two. Values that are quoted already, and calls such as
    ``choice(...)``, do not change.
    """
    key, equals, value = override.partition("=")
    name = key.lstrip("+")
    if not equals or QUOTED.fullmatch(value):
        return override
    if name in LIST_KEYS and is_list(override) and "${" not in value:
        return f"{key}=[{','.join(map(_item, _pieces(value[1:-1], ',')))}]"
    is_plain = PLAIN_PATH.fullmatch(value) and not NOT_A_TEXT.fullmatch(value)
    if name in PATH_KEYS and not is_plain and "${" not in value:
        return f"{key}={quote(value)}"
    if name in TEXT_KEYS and not (is_sweep and SWEEP_CALL.fullmatch(value)):
        pieces = _pieces(value, SEPARATOR) if is_sweep else [value]
        return f"{key}=" + ",".join(part if QUOTED.fullmatch(part) else quote(part) for part in pieces)
    return override


def resumed(
    overrides: Sequence[str], *, is_sweep: bool, folders: Sequence[Path] = (), retry: str = ""
) -> list[str]:
    """Replace ``resume=RUN`` by the overrides that RUN was started with, changed by the others in the line.

    A line without ``resume=`` does not change. ``folders`` have the YAML files of the line, by default those
    of the package, and ``retry`` is the line with ``trust=true``. Raises ``UserError`` if RUN is not the
    folder of a run, or a checkpoint in one, if the line asks for another folder or for a sweep, or if the
    files of RUN may do more than continue it and the line does not trust them.
    """
    given = {_entry(override): override for override in overrides}
    if "resume" not in given or (text := text_of(given["resume"])) in ("null", ""):
        return list(overrides)
    if is_sweep:
        raise UserError(f"resume: continues one run, not a sweep. Try: {setting_word('resume', text)}")
    path = typed_path(text)
    holders = [place for place in (path, *path.parents) if has_file(place, OVERRIDES)]
    folder = holders[0] if holders and os.path.lexists(path) else None
    if folder is None or (path.is_dir() and path != folder):
        raise UserError(
            f"resume: expected the folder of a run (it contains {OVERRIDES}), got {text!r}. "
            f"Try: resume={LATEST}"
        )
    if RUN_FOLDER in given and typed_path(text_of(given[RUN_FOLDER])) != folder:
        raise UserError(
            f"{RUN_FOLDER}: a resumed run stays in its folder. Try: {setting_word('resume', text)}"
        )
    is_judged = not is_trusted(overrides)
    require_contained(folder, retry if is_judged else None)
    before = read_overrides(folder / OVERRIDES)
    if is_judged:
        keys = {key_of(override) for override in overrides}
        before = judge_overrides(before, folder / OVERRIDES, keys, folders or [config_dir()], retry)
    merged = {_entry(override): override for override in before}
    for override in given.values():
        _merge(merged, override)
    merged["resume"] = f"resume={quote(str(path))}"
    merged[RUN_FOLDER] = f"{RUN_FOLDER}={quote(str(folder))}"
    return list(merged.values())


def is_list(override: str) -> bool:
    """Return whether the value of an override is a list in brackets, not the path of such a name."""
    _, _, value = override.partition("=")
    return value.startswith("[") and value.endswith("]") and not os.path.lexists(value)


def _item(text: str) -> str:
    """Return one item of a list, quoted for Hydra if it is not quoted already."""
    text = text.strip()
    return text if QUOTED.fullmatch(text) else quote(text)


def _entry(override: str) -> str:
    """Return the entry that an override changes. Removing a key (``~key``) and setting it are two entries."""
    return ("~" if override.startswith("~") else "") + key_of(override)


def _merge(merged: dict[str, str], override: str) -> None:
    """Add one more override to a run's overrides, in place. Overrides that it cancels are removed."""
    entry, key = _entry(override), key_of(override)
    old = merged.get(key, "")
    if entry != key:  # ~key
        merged.pop(key, None)
        # If the run had added the key itself, dropping the addition is enough.
        if not old.startswith("+") or entry in merged:
            merged[entry] = override
    elif override.startswith("+"):
        merged[key] = override
    else:
        if not old:
            merged.pop(f"~{key}", None)
        merged[key] = old[: len(old) - len(old.lstrip("+"))] + override


def _pieces(text: str, comma: str) -> list[str]:
    """Split a text at the pattern ``comma``, but not inside quotation marks around a whole piece."""
    piece = re.compile(rf"\s*(?:{QUOTED.pattern})\s*(?=,|$)|(?:(?!{comma}).)*", re.DOTALL)
    pieces, position = [], 0
    while match := piece.match(text, position):
        pieces.append(match.group().strip())
        if match.end() == len(text):
            break
        position = match.end() + 1
    return pieces
