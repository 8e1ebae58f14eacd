"""Line: read the words after ``cadam3d COMMAND``: overrides, flags, quoting, and resuming a run."""

import argparse
import os
import re
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from omegaconf import OmegaConf

from cadam3d.core.checks import require
from cadam3d.core.errors import UserError
from cadam3d.io.records import read_config
from cadam3d.io.run_folder import (
    HYDRA_SETTINGS,
    LATEST,
    OVERRIDES,
    RUN_FOLDER,
    has_file,
    setting_word,
    shown,
    typed_path,
)
from cadam3d.settings.compose import TEXT_KEYS, flatten, quote, value_of
from cadam3d.settings.options import config_dir
from cadam3d.settings.trust import is_trusted, judge_overrides, read_overrides, require_contained

SWEEP_FOLDER = "hydra.sweep.dir"
# Values of these keys are quoted: paths, and a text that may be null.
PATH_KEYS = (
    *("run", "ply", "output", "resume", RUN_FOLDER, SWEEP_FOLDER),
    *("initializer.path", "initializer.prompt", "rasterizer.cache_dir", "runs", "answers", "key", "consent"),
    *("prompts", "prompts.file", "prompts.category", "prompts.shard"),
)
# Whether the jobs of a sweep are only listed, and where they run. No run has these settings.
DRY_RUN = "dry_run"
LAUNCHER_KEY = re.compile(r"launcher($|\.)|hydra[./]launcher($|\.)")
OF_SWEEPS = re.compile(rf"{DRY_RUN}$|{LAUNCHER_KEY.pattern}")
# Settings of a line that do not change what a run computes, so they may differ when it is continued.
NOT_OF_A_RUN = ("resume", "trust", "attempts", "select")
# Keys whose value may be a list of paths or of texts, such as run=[A,B].
LIST_KEYS = ("run", "runs", "labels", "arms", "answers")
QUOTED = re.compile(r"""'(?:[^'\\]|\\.)*'|"(?:[^"\\]|\\.)*\"""", re.DOTALL)
SWEEP_CALL = re.compile(r"(choice|range|interval|glob|sort|shuffle|tag)\(.*\)", re.DOTALL)
# A comma between two prompts; one before a space belongs to a sentence.
SEPARATOR = r",(?!\s|$)"
# The settings of Hydra that have an effect.
HYDRA_KEYS = re.compile(
    r"hydra\.(run\.dir|sweep\.dir|sweep\.subdir|searchpath)$|hydra[./](launcher|sweeper)\b"
)


@dataclass(frozen=True)
class Line:
    """The parsed command line after ``cadam3d``."""

    command: str
    words: list[str]  # the overrides as they were typed
    overrides: list[str]  # quoted for Hydra
    flags: list[str]
    options: argparse.Namespace  # the flags, parsed

    @property
    def folders(self) -> list[Path]:
        """Return the folders of YAML files, in the order in which Hydra searches them."""
        return [Path(self.options.config_dir), config_dir()] if self.options.config_dir else [config_dir()]

    @property
    def config_flags(self) -> list[str]:
        """Return the flag for more YAML files, which other lines about the same runs need as well."""
        return ["--config-dir", self.options.config_dir] if self.options.config_dir else []

    @property
    def wants_page(self) -> bool:
        """Return whether the line asks for a page, and not for work."""
        options = self.options
        return any((options.help, options.cfg, options.hydra_help, options.info))


def read_flags(words: Sequence[str]) -> tuple[argparse.Namespace, list[str]]:
    """Return the flags of a line, which may be anywhere in it, and its other words, the overrides.

    The flags are those of Hydra that are useful here. Raises ``UserError`` for unknown ones.
    """
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    for names in ("--help -h", "--hydra-help", "--resolve"):
        parser.add_argument(*names.split(), action="store_true")
    for names in ("--config-dir -cd", "--config-name -cn", "--package -p"):
        parser.add_argument(*names.split())
    parser.add_argument("--cfg", "-c", choices=("job", "hydra", "all"))
    pages = ("all", "config", "defaults", "defaults-tree", "plugins", "searchpath")
    parser.add_argument("--info", "-i", nargs="?", const="all", choices=pages)
    try:
        options, overrides = parser.parse_known_args(words)
    except argparse.ArgumentError as error:
        raise UserError(f"{error}. Try: cadam3d --help") from error
    if unknown := [word for word in overrides if word.startswith("-")]:
        raise UserError(f"{unknown[0]}: no such flag. Try: cadam3d --help")
    return options, overrides


def key_of(override: str) -> str:
    """Return the key of an override, without ``+`` or ``~``."""
    return override.partition("=")[0].lstrip("+~")


def text_of(override: str) -> str:
    """Return the value of an override as plain text."""
    value = value_of(override)
    return OmegaConf.create({"value": value}).value if isinstance(value, str) else str(value or "null")


def quoted(override: str, *, is_sweep: bool) -> str:
    """Quote a prompt or a path, so that commas, brackets, ``=`` or emoji in it are plain text to Hydra.

    In a sweep, a comma before a space belongs to the sentence and any other comma separates two prompts:
    ``prompt="a corgi, front view,a cat"`` is two. Values that are quoted already, and calls such as
    ``choice(...)``, do not change.
    """
    key, equals, value = override.partition("=")
    name = key.lstrip("+")
    is_path = name in (*PATH_KEYS, *LIST_KEYS) and "${" not in value
    if not equals or QUOTED.fullmatch(value):
        return override
    if is_path and name in LIST_KEYS and is_list(override):
        return f"{key}=[{','.join(map(_item, _pieces(value[1:-1], ',')))}]"
    if is_path and name in PATH_KEYS and value != "null":
        return f"{key}={quote(value)}"
    if name in TEXT_KEYS and not (is_sweep and SWEEP_CALL.fullmatch(value)):
        pieces = _pieces(value, SEPARATOR) if is_sweep else [value]
        return f"{key}=" + ",".join(map(_item, pieces))
    return override


def resumed(
    overrides: Sequence[str], *, is_sweep: bool, folders: Sequence[Path] = (), retry: str = ""
) -> list[str]:
    """Replace ``resume=RUN`` by the overrides that RUN was started with, followed by the others in the line.

    An override in the line replaces those of RUN with the same key. A line without ``resume=`` does not
    change. ``folders`` have the YAML files of the line, by default those of the package, and ``retry`` is the
    line with ``trust=true``. Raises ``UserError`` if RUN is not the folder of a run, or a checkpoint in one,
    if the line asks for another folder or for a sweep, or if the files of RUN may do more than continue it
    and the line does not trust them.
    """
    given = {key_of(override): override for override in overrides}
    text = text_of(given["resume"]) if "resume" in given else "null"
    if text in ("null", ""):
        return list(overrides)
    require(not is_sweep, "resume", expected="one run, not a sweep", got=text)
    path = typed_path(text)
    holders = [place for place in (path, *path.parents) if has_file(place, OVERRIDES)]
    is_run = holders and os.path.lexists(path) and (path == holders[0] or not path.is_dir())
    expected = f"the folder of a run (it contains {OVERRIDES})"
    require(bool(is_run), "resume", expected=expected, got=text, example=f"resume={LATEST}")
    folder = holders[0]
    place = text_of(given[RUN_FOLDER]) if RUN_FOLDER in given else text
    expected, example = f"{folder}, which is resumed", setting_word("resume", text)
    require(typed_path(place) in (folder, path), RUN_FOLDER, expected=expected, got=place, example=example)
    is_judged = not is_trusted(overrides)
    require_contained(folder, retry if is_judged else None)
    before = read_overrides(folder / OVERRIDES)
    if is_judged:
        before = judge_overrides(before, folder / OVERRIDES, given, folders or [config_dir()], retry)
    places = {"resume": f"resume={quote(str(path))}", RUN_FOLDER: f"{RUN_FOLDER}={quote(str(folder))}"}
    kept = [line for line in before if key_of(line) not in {*given, *places}]
    return [*kept, *(line for line in overrides if key_of(line) not in places), *places.values()]


def continuing(folder: Path) -> str:
    """Return the line that continues the run in ``folder``, with the flags that chose its YAML files."""
    flags: dict[str, object] = {}
    if has_file(folder, HYDRA_SETTINGS):
        hydra = dict(flatten(read_config(folder / HYDRA_SETTINGS)))
        # The folder of --config-dir is the first one in the search path.
        paths, name = hydra.get("hydra.searchpath"), hydra.get("hydra.job.config_name")
        if isinstance(paths, list) and paths:
            flags["--config-dir"] = shown(Path(str(paths[0]).removeprefix("file://")))
        if name != "train":
            flags["--config-name"] = name
    words = [str(word) for flag in flags.items() for word in flag]
    return shlex.join(["cadam3d", "train", *words, f"resume={shown(folder)}"])


def is_list(override: str) -> bool:
    """Return whether the value of an override is a list in brackets, not the path of such a name."""
    _, _, value = override.partition("=")
    return value.startswith("[") and value.endswith("]") and not os.path.lexists(value)


def _item(text: str) -> str:
    """Return a text, quoted for Hydra if it is not quoted already."""
    return text if QUOTED.fullmatch(text) else quote(text)


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
