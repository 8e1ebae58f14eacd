"""Launch: read a command line, refuse one that cannot work before any work starts, and run its command."""

import gc
import shlex
import shutil
from argparse import Namespace
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import InterpolationResolutionError

from cadam3d.core.errors import UserError
from cadam3d.io.run_folder import OVERRIDES, claim, holds_run
from cadam3d.settings.advice import explain, line_of, require_values, reraise_interrupt
from cadam3d.settings.compose import TEXT_KEYS
from cadam3d.settings.help_page import help_text
from cadam3d.settings.hydra import (
    compose_line,
    place_run,
    read_flags,
    refuse_missing_settings,
    run_composed,
    run_hydra,
)
from cadam3d.settings.line import RUN_FOLDER, key_of, quoted, resume_word, resumed, split

TRAINING = ("train", "sweep")  # the commands that have a run folder


@dataclass
class Task:
    """A command in the form in which Hydra runs it. It records whether the command itself has started."""

    command: str
    has_started: bool = False

    def __call__(self, cfg: DictConfig) -> Any:
        """Run the command on its composed configuration."""
        module = import_module(f"cadam3d.commands.{self.command}")
        # Imported modules stay in memory, so the garbage collector need not scan them.
        gc.freeze()
        gc.enable()
        self.has_started = True
        return module.run(cfg)


@dataclass(frozen=True)
class Line:
    """The parsed command line after ``cadam3d``."""

    command: str
    overrides: list[str]  # quoted for Hydra
    flags: list[str]
    options: Namespace  # the flags, parsed
    is_sweep: bool


def launch(command: str, words: Sequence[str]) -> int:
    """Run ``cadam3d <command> <words>`` and return its exit code.

    Raises ``UserError`` for mistakes of the user. The exceptions of Hydra and OmegaConf are translated here
    and nowhere else. An exception that the running command raises is a bug and keeps its traceback. Only a
    reference that cannot be resolved is still translated then, because some show up only in a running job.
    """
    if command == "doctor":
        words = ["json=true" if word == "--json" else word for word in words]
    task = Task(command)
    try:
        overrides, flags = split(words)
        options = read_flags(flags)
        if options.help:
            print(help_text(command, overrides, options))
            return 0
        line = read_line(command, overrides, flags, options)
        if line.is_sweep:
            return _sweep(line, task)
        return _command(line, task)
    except UserError:
        raise
    except Exception as error:
        if task.has_started and not isinstance(error, InterpolationResolutionError):
            raise
        reraise_interrupt(error)
        advice = explain(error, command, words)
        if advice is None:
            raise
        raise advice from error


def read_line(command: str, overrides: list[str], flags: list[str], options: Namespace) -> Line:
    """Parse a line: quote its overrides and, if it resumes a run, add the overrides of that run."""
    _refuse_bare_words(command, overrides, flags)
    is_sweep = command == "sweep" or options.multirun or "hydra.mode=MULTIRUN" in overrides
    if is_sweep and command not in TRAINING:
        kept = [override for override in overrides if override != "hydra.mode=MULTIRUN"]
        raise UserError(f"{command}: only training can be swept. Try: {line_of(command, kept)}")
    overrides = [quoted(override, is_sweep=is_sweep) for override in overrides]
    if command in TRAINING:
        overrides = resumed(overrides, is_sweep=is_sweep)
    return Line(command, overrides, flags, options, is_sweep)


def _command(line: Line, task: Task) -> int:
    """Run a command once, or show one of Hydra's pages about it."""
    options = line.options
    if _wants_page(options) or options.cfg or options.experimental_rerun:
        run_hydra(line.command, [*line.overrides, *line.flags], task)
        return 0
    cfg = compose_line(line.command, [*line.overrides, "hydra.mode=RUN"], options)
    require_values(cfg)
    refuse_missing_settings(cfg, line.command, line.overrides)
    if line.command in TRAINING:
        _train(cfg, line, task)
    else:
        run_composed(cfg, task)
    return 0


def _sweep(line: Line, task: Task) -> int:
    """Run a sweep, or show a page about it or the settings of its first job."""
    if _wants_page(line.options):
        run_hydra(line.command, [*line.overrides, *line.flags], task)
        return 0
    if line.options.cfg:
        from cadam3d.sweep.plan import read_sweep

        sweep, _ = read_sweep(line.command, line.overrides, line.options)
        parts = sweep.parts
        flags = [flag for flag in line.flags if flag not in ("-m", "--multirun")]
        own = [*parts.grid, *parts.launcher, *parts.folder]
        run_hydra("sweep", [*own, *sweep.jobs[0].overrides, *flags], task)
        return 0
    from cadam3d.commands import sweep as command

    return command.run(line.command, line.overrides, line.flags, line.options)


def _train(cfg: DictConfig, line: Line, task: Task) -> None:
    """Choose the output folder and train there."""
    text = OmegaConf.select(cfg, RUN_FOLDER)
    if not text:
        example = f"{RUN_FOLDER}=outputs/mine"
        raise UserError(f"{RUN_FOLDER}: expected a folder, got nothing. Try: {example}")
    wanted = Path(str(text)).expanduser()
    is_chosen = any(key_of(override) == RUN_FOLDER for override in line.overrides)
    existing = _nearest_existing(wanted if is_chosen else wanted.parent)
    folder = claim(wanted, RUN_FOLDER, is_chosen=is_chosen)
    place_run(cfg, folder)
    if cfg.resume is not None:
        _undoing_refusal(folder, lambda: run_composed(cfg, task))
    elif holds_run(folder):
        raise UserError(
            f"{RUN_FOLDER}: {folder} holds a run already. "
            f"Try: cadam3d train {resume_word(folder)}, or another folder"
        )
    else:
        _removing_refused(folder, existing, lambda: run_composed(cfg, task))


def _undoing_refusal(folder: Path, train: Callable[[], None]) -> None:
    """Resume the run in ``folder``. If the line is refused, restore the files that Hydra has overwritten."""
    before = {path: path.read_bytes() for path in (folder / OVERRIDES).parent.glob("*.yaml")}
    try:
        train()
    except (UserError, InterpolationResolutionError):
        for path, content in before.items():
            path.write_bytes(content)
        raise


def _removing_refused(folder: Path, existing: Path, train: Callable[[], None]) -> None:
    """Train in the new ``folder``. If the line is refused, remove it and its parents up to ``existing``."""
    try:
        train()
    except (UserError, InterpolationResolutionError, KeyboardInterrupt):
        is_untouched = all(path.name == ".hydra" or path.suffix == ".log" for path in folder.iterdir())
        if folder != existing and is_untouched:
            shutil.rmtree(folder, ignore_errors=True)
            for parent in folder.parents:
                if parent == existing or any(parent.iterdir()):
                    break
                parent.rmdir()
        raise


def _nearest_existing(folder: Path) -> Path:
    """Return ``folder``, or the nearest of its parents that exists."""
    return next((place for place in (folder, *folder.parents) if place.exists()), folder)


def _wants_page(options: Namespace) -> bool:
    """Return whether the line asks for one of Hydra's own pages or for completions."""
    return bool(options.hydra_help or options.info or options.shell_completion)


def _refuse_bare_words(command: str, overrides: Sequence[str], flags: Sequence[str]) -> None:
    """Refuse words without ``=``, as an unquoted prompt leaves them, with the line to type instead."""
    bare = [override for override in overrides if "=" not in override and not override.startswith("~")]
    if not bare:
        return
    before = [override for override in overrides[: overrides.index(bare[0])] if key_of(override) in TEXT_KEYS]
    others = [word for word in overrides if word not in (*bare, *before[-1:])] + list(flags)
    if command in TRAINING:
        key, _, start = before[-1].partition("=") if before else ("prompt", "", "")
        whole = " ".join([start, *bare]).strip()
        line = f"cadam3d {command} {key}={shlex.quote(whole)} {shlex.join(others)}".rstrip()
    elif command == "doctor":
        line = "cadam3d doctor"
    else:
        key = "ply" if bare[0].endswith(".ply") and command != "eval" else "run"
        line = line_of(command, [*others, f"{key}={bare[0]}"])
    raise UserError(f"{bare[0]!r}: expected key=value. Try: {line}")
