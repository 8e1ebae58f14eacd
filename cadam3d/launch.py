"""Launch: prepare a line for Hydra, refuse what cannot work before any work starts, and hand over."""

import os
import re
import shlex
import shutil
import sys
import tempfile
from argparse import Namespace
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, NoReturn

import hydra
import yaml
from hydra._internal.utils import get_args_parser
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import InterpolationKeyError, InterpolationResolutionError

from cadam3d.core.errors import UserError
from cadam3d.settings.advice import ask_for, explain, missing_values
from cadam3d.settings.compose import TEXT_KEYS, VERSION_BASE, compose, config_dir, quote, register_resolvers
from cadam3d.settings.help_page import help_text

TRAINING = ("train", "sweep")  # the commands that own a run folder
OVERRIDES = ".hydra/overrides.yaml"  # in a run folder: what its line said
PATH_KEYS = (  # quoted if need be; so is a text that may be null
    *("run", "ply", "output", "resume", "hydra.run.dir", "hydra.sweep.dir"),
    *("initializer.path", "initializer.prompt", "rasterizer.cache_dir"),
)
RUN_MARKS = ("summary.json", "checkpoints")  # what a run folder holds, and an empty one does not
PLAIN_PATH = re.compile(r"[\w./+-]*", re.ASCII)  # to Hydra's grammar; it cannot read "~"
QUOTED = re.compile(r"""'(?:[^'\\]|\\.)*'|"(?:[^"\\]|\\.)*\"""", re.DOTALL)
SWEEP_CALL = re.compile(r"(choice|range|interval|glob|sort|shuffle|tag)\(.*\)", re.DOTALL)
PIECE = re.compile(r"(?:[^,]|,(?=\s|$))*", re.DOTALL)  # up to a comma that no blank follows
FLAGS_WITH_VALUE = (
    *("--cfg", "-c", "--package", "-p", "--info", "-i", "--experimental-rerun"),
    *("--config-path", "-cp", "--config-name", "-cn", "--config-dir", "-cd"),
)


class Task:
    """What Hydra calls for each job: ``run`` of the command. A mistake of the user waits here, unprinted."""

    def __init__(self, module: str) -> None:
        self.module = module
        self.mistake: UserError | None = None
        self.has_started = False

    def __call__(self, cfg: DictConfig) -> Any:
        """Run the command on its composed configuration."""
        command = import_module(f"cadam3d.commands.{self.module}")
        self.has_started = True
        try:
            return command.run(cfg)
        except UserError as error:
            self.mistake = error
        except InterpolationResolutionError as error:  # such as ${hydra:...}, which only a job can resolve
            self.mistake = explain(error, self.module, ())
        return None


def launch(command: str, words: Sequence[str]) -> int:
    """Run ``cadam3d <command> <words>`` and return its exit code; the user's mistakes raise ``UserError``."""
    if command == "doctor":
        words = ["json=true" if word == "--json" else word for word in words]
    overrides, flags = split(words)
    options = _read_flags(flags)
    if options.help:
        print(help_text(command, overrides, options))
        return 0
    _refuse_bare_words(command, overrides)
    is_sweep = command == "sweep" or options.multirun or "hydra.mode=MULTIRUN" in overrides
    overrides = [quoted(line, is_sweep=is_sweep) for line in overrides]
    if command in TRAINING:
        overrides = resumed(overrides, is_sweep=is_sweep)
    elif is_sweep:
        raise UserError(f"{command}: only training can be swept. Try: cadam3d {command} once for each asset")
    if options.hydra_help or options.info or options.shell_completion:
        return run_hydra(command, [*overrides, *flags])
    if is_sweep:
        return _sweep(command, overrides, flags, options)
    if options.cfg:
        return run_hydra(command, [*overrides, *flags])
    return _run(command, overrides, flags, options)


def split(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """Tell overrides from flags, wherever the flags stand in the line."""
    overrides, flags = [], []
    takes_value = False
    for word in words:
        if takes_value or word.startswith("-"):
            flags.append(word)
            takes_value = not takes_value and word in FLAGS_WITH_VALUE
        else:
            overrides.append(word)
    return overrides, flags


def quoted(line: str, *, is_sweep: bool) -> str:
    """One override with its prompt or path quoted, so that commas, brackets, ``=`` or emoji are just text.

    In a sweep a comma before a blank belongs to the sentence and any other comma separates two prompts, so
    ``prompt="a corgi, front view,a cat"`` is two. What is quoted already, or ``choice(...)``, stays as it is.
    """
    key, equals, value = line.partition("=")
    name = key.lstrip("+")
    if not equals or QUOTED.fullmatch(value):
        return line
    if name in PATH_KEYS and not PLAIN_PATH.fullmatch(value) and "${" not in value:
        return f"{key}={quote(value)}"
    if name in TEXT_KEYS and not (is_sweep and SWEEP_CALL.fullmatch(value)):
        pieces = _prompts(value) if is_sweep else [value]
        return f"{key}=" + ",".join(part if QUOTED.fullmatch(part) else quote(part) for part in pieces)
    return line


def resumed(overrides: Sequence[str], *, is_sweep: bool) -> list[str]:
    """With ``resume=RUN`` in the line: what RUN was started with, changed by what the line says anew."""
    given = {_entry(line): line for line in overrides}
    if "resume" not in given or (text := _text(given["resume"])) in ("null", ""):
        return list(overrides)
    if is_sweep:
        raise UserError(f"resume: continues one run, not a sweep. Try: cadam3d train {_resume(text)}")
    path = Path(text).expanduser().resolve()
    holders = [place for place in (path, *path.parents) if (place / OVERRIDES).is_file()]
    folder = holders[0] if path.exists() and holders else None
    if folder is None or (path.is_dir() and path != folder):
        raise UserError(
            f"resume: expected the folder of a run (it holds {OVERRIDES}), got {text!r}. "
            "Try: cadam3d train resume=outputs/latest"
        )
    if "hydra.run.dir" in given and Path(_text(given["hydra.run.dir"])).expanduser().resolve() != folder:
        raise UserError(
            f"hydra.run.dir: a resumed run stays in its folder. Try: cadam3d train {_resume(text)}"
        )
    before = yaml.safe_load((folder / OVERRIDES).read_text(encoding="utf-8")) or []
    merged = {_entry(line): line for line in before if key_of(line) != "grid"}
    for entry, line in given.items():
        _merge(merged, entry, line)
    merged["resume"] = f"resume={quote(str(path))}"
    merged["hydra.run.dir"] = f"hydra.run.dir={quote(str(folder))}"
    return list(merged.values())


def run_hydra(command: str, arguments: Sequence[str], task: Task | None = None) -> int:
    """Let Hydra read ``arguments`` with the YAML of ``command``; its complaints come out as ``UserError``."""
    task = task or Task(command)
    register_resolvers()
    arguments_before, switch_before = sys.argv, os.environ.get("HYDRA_FULL_ERROR")
    sys.argv = [sys.argv[0], *arguments]
    os.environ["HYDRA_FULL_ERROR"] = "1"  # exceptions reach us instead of Hydra's printer
    try:
        hydra.main(version_base=VERSION_BASE, config_path=str(config_dir()), config_name=command)(task)()
    except Exception as error:
        if not task.has_started:
            _pass_on_interrupt(error)
        advice = None if task.has_started else explain(error, command, split(arguments)[0])
        if advice is None:
            raise
        raise advice from error
    finally:
        sys.argv = arguments_before
        os.environ["HYDRA_FULL_ERROR"] = switch_before or "0"
    if task.mistake is not None:
        raise task.mistake
    return 0


def _run(command: str, overrides: list[str], flags: list[str], options: Namespace) -> int:
    """Check what can be checked without working, fix the output folder, and start."""
    cfg = compose_line(command, overrides, options)
    if missing := missing_values(cfg):
        raise ask_for(missing, command)
    refuse_holes(cfg, command, overrides)
    if command not in TRAINING:
        return run_hydra(command, [*overrides, *flags])
    key = "hydra.run.dir"
    is_chosen = any(key_of(line) == key for line in overrides)
    try:
        place = OmegaConf.select(cfg, key)
    except InterpolationResolutionError as error:
        raise explain(error, command, overrides) or error from error
    if not place:
        raise UserError(f"{key}: expected a folder, got nothing. Try: {key}=outputs/mine, or without it")
    wanted = Path(str(place)).expanduser()
    stood = _standing(wanted if is_chosen else wanted.parent)
    folder = claim(wanted, key, is_chosen=is_chosen)
    if cfg.resume is None and any((folder / name).exists() for name in RUN_MARKS):
        raise UserError(
            f"{key}: {folder} holds a run already. Try: cadam3d train {_resume(folder)}, or another folder"
        )
    arguments = [line for line in overrides if key_of(line) != key] + [f"{key}={quote(str(folder))}"]
    if cfg.resume is not None:
        return _run_again(command, [*arguments, *flags], folder)
    return _run_anew(command, [*arguments, *flags], folder, stood)


def _run_anew(command: str, arguments: Sequence[str], folder: Path, stood: Path) -> int:
    """Run in a new ``folder``. A refused line leaves nothing behind but ``stood``, which was there."""
    try:
        return run_hydra(command, arguments)
    except (UserError, KeyboardInterrupt):
        if folder != stood and all(
            path.name == ".hydra" or path.suffix == ".log" for path in folder.iterdir()
        ):
            shutil.rmtree(folder, ignore_errors=True)
            for parent in folder.parents:
                if parent == stood or any(parent.iterdir()):
                    break
                parent.rmdir()
        raise


def _run_again(command: str, arguments: Sequence[str], folder: Path) -> int:
    """Resume the run in ``folder``. A line that is refused leaves no trace in what the run remembers."""
    remembered = {path: path.read_bytes() for path in (folder / OVERRIDES).parent.glob("*.yaml")}
    try:
        return run_hydra(command, arguments)
    except UserError:
        for path, content in remembered.items():  # Hydra has written the refused line there already
            path.write_bytes(content)
        raise


def _sweep(command: str, overrides: list[str], flags: list[str], options: Namespace) -> int:
    """Run a sweep, or show the settings of its first job."""
    from cadam3d.sweep.plan import read_sweep
    from cadam3d.sweep.start import start

    if not options.cfg:
        return start(command, overrides, flags, options)
    sweep, _ = read_sweep(command, overrides, options)
    line = sweep.line
    shown = [flag for flag in flags if flag not in ("-m", "--multirun")]
    return run_hydra("sweep", [*line.grid, *line.launcher, *line.folder, *sweep.jobs[0].overrides, *shown])


def refuse_holes(cfg: DictConfig, command: str, overrides: Sequence[str]) -> None:
    """Refuse a line that takes a whole setting away or refers to one that does not exist."""
    for line in overrides:
        key = key_of(line)
        if line.startswith("~") and "." not in key and "/" not in key and key not in cfg:
            raise UserError(
                f"~{key}: a setting can be changed, not taken away. "
                f"Try: cadam3d {command} without it; cadam3d {command} --help lists the choices"
            )
    raw = OmegaConf.to_container(cfg, resolve=False)
    assert isinstance(raw, dict)
    for key in sorted(raw, key=lambda key: isinstance(raw[key], dict)):  # a culprit before what refers to it
        if key == "hydra":  # holds what only a running job knows
            continue
        try:
            value = cfg[key]
            if OmegaConf.is_config(value):
                OmegaConf.to_container(value, resolve=True)
        except InterpolationKeyError as error:
            raise explain(error, command, overrides) or error from error
        except InterpolationResolutionError:  # may be resolved while the job runs: ${hydra:...}
            continue


def compose_line(command: str, overrides: Sequence[str], options: Namespace) -> DictConfig:
    """The configuration of a line, with Hydra's node. Raises ``UserError`` if it cannot be composed."""
    try:
        return compose(
            overrides,
            options.config_name or command,
            folder=Path(options.config_path) if options.config_path else None,
            search_path=os.path.abspath(options.config_dir) if options.config_dir else None,  # noqa: PTH100
            with_hydra=True,
        )
    except Exception as error:
        _pass_on_interrupt(error)
        advice = explain(error, command, overrides)
        if advice is None:
            raise
        raise advice from error


def _standing(folder: Path) -> Path:
    """``folder``, or the nearest of those around it that exists."""
    return next((place for place in (folder, *folder.parents) if place.exists()), folder)


def claim(folder: Path, key: str, *, is_chosen: bool) -> Path:
    """Make the folder and prove that it can be written; a name of our own that is taken gets a number."""
    number = 1
    wanted = folder
    while not is_chosen and folder.exists():
        number += 1
        folder = wanted.with_name(f"{wanted.name}-{number}")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise UserError(
            f"{key}: cannot write to {folder} ({error.strerror}). Try: {key}=/tmp/cadam3d"
        ) from error
    return folder


def _read_flags(flags: Sequence[str]) -> Namespace:
    parser = get_args_parser()
    parser.error = _refuse_flags  # type: ignore[method-assign]
    options = parser.parse_args(list(flags))
    modes = [options.run, options.multirun and not options.cfg, bool(options.cfg), options.info is not None]
    if sum(map(bool, modes)) > 1:
        raise UserError(f"{' '.join(flags)}: these flags exclude one another. Try: one of them")
    return options


def _refuse_bare_words(command: str, overrides: Sequence[str]) -> None:
    """A word without ``=`` is what the shell makes of a prompt that was not quoted: give it back whole."""
    bare = [line for line in overrides if "=" not in line and not line.startswith("~")]
    if bare:
        before = [line for line in overrides[: overrides.index(bare[0])] if key_of(line) in TEXT_KEYS]
        key, _, start = before[-1].partition("=") if before else ("prompt", "", "")
        whole = " ".join([start, *bare]).strip()
        example = f"cadam3d {command} {key}={shlex.quote(whole)}" if command in TRAINING else f"run={bare[0]}"
        raise UserError(f"{bare[0]!r}: expected key=value. Try: {example}")


def _refuse_flags(message: str) -> NoReturn:
    raise UserError(f"{message}. Try: cadam3d --help")


def _prompts(value: str) -> list[str]:
    """The prompts of a sweep, as they stand between separating commas."""
    pieces, rest = [], value
    while True:
        match = QUOTED.match(rest)
        if match is None or rest[match.end() : match.end() + 1] not in ("", ","):
            match = PIECE.match(rest)
        assert match is not None, "PIECE matches the empty string too"
        pieces.append(match.group().strip())
        if match.end() == len(rest):
            return pieces
        rest = rest[match.end() + 1 :]


def key_of(line: str) -> str:
    """The key of an override."""
    return line.partition("=")[0].lstrip("+~")


def _entry(line: str) -> str:
    """What an override is about; taking a key away (``~key``) and giving it a value are two entries."""
    return ("~" if line.startswith("~") else "") + key_of(line)


def _merge(merged: dict[str, str], entry: str, line: str) -> None:
    """Add one more override to those of a run, in place; it takes the place of what it makes void."""
    key = key_of(line)
    old = merged.get(key, "")
    if entry != key:  # ~key
        merged.pop(key, None)
        if not old.startswith("+") or entry in merged:  # else the key was an addition and is just gone
            merged[entry] = line
    elif line.startswith("+"):
        merged[key] = line
    else:
        if not old:
            merged.pop(f"~{key}", None)  # the key is back
        merged[key] = old[: len(old) - len(old.lstrip("+"))] + line


def _resume(place: str | Path) -> str:
    return shlex.quote(f"resume={place}")


def _pass_on_interrupt(error: BaseException) -> None:
    """Raise ``KeyboardInterrupt`` if ``error`` only hides one, as OmegaConf's clean-up can make it do."""
    seen: BaseException | None = error
    while seen is not None:
        if isinstance(seen, KeyboardInterrupt):
            raise KeyboardInterrupt from error
        seen = seen.__cause__ or seen.__context__


def _text(line: str) -> str:
    """The value of an override as plain text."""
    value = OverridesParser.create().parse_override(line).value()
    return OmegaConf.create({"value": value}).value if isinstance(value, str) else str(value or "null")
