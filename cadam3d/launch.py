"""Launch: read a command line, refuse one that cannot work before any work starts, and run its command."""

import gc
import shlex
from argparse import Namespace
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import InterpolationResolutionError

from cadam3d.core.errors import UserError
from cadam3d.io.run_folder import JOBS, expanded, has_file, typed_path
from cadam3d.settings.advice import explain, is_refused_path, line_of, require_values, reraise_interrupt
from cadam3d.settings.check import require_settings
from cadam3d.settings.compose import LONGEST_KEY, TEXT_KEYS
from cadam3d.settings.help_page import help_text
from cadam3d.settings.hydra import (
    compose_line,
    place_run,
    read_flags,
    refuse_missing_settings,
    refuse_unread_settings,
    run_composed,
    run_hydra,
)
from cadam3d.settings.line import (
    DRY_RUN,
    LAUNCHER_KEY,
    RUN_FOLDER,
    key_of,
    quoted,
    resumed,
    split,
    text_of,
)
from cadam3d.settings.options import config_dir
from cadam3d.settings.output import exporting
from cadam3d.settings.place import occupied
from cadam3d.settings.target import require_target
from cadam3d.sweep.plan import require_attempts

TRAINING = ("train", "sweep")  # the commands that have a run folder
EXPORTING = ("render", "export")  # the commands with output=
COMPARING = "render"  # the command that accepts several runs


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
    typed: list[str]  # the overrides without those of a resumed run
    words: list[str]  # the same as they were typed, for messages
    trusting: str  # what to type to trust the folder of a resumed run


def launch(command: str, words: Sequence[str]) -> int:
    """Run ``cadam3d <command> <words>`` and return its exit code.

    Raises ``UserError`` for mistakes of the user.
    """
    if command == "doctor":
        words = ["json=true" if word == "--json" else word for word in words]
    task = Task(command)
    with explaining(task, words):
        overrides, flags = split(words)
        options = read_flags(flags)
        if options.experimental_rerun:
            raise UserError(
                f"--experimental-rerun: expected a line without it, got {options.experimental_rerun}, which "
                "may hold any code. Try: cadam3d train resume=outputs/latest"
            )
        if options.help:
            print(help_text(command, overrides, options))
            return 0
        line = read_line(command, overrides, flags, options)
        if line.is_sweep:
            return _sweep(line, task)
        return _command(line, task)


@contextmanager
def explaining(task: Task, words: Sequence[str]) -> Iterator[None]:
    """Translate the exceptions of Hydra and OmegaConf into ``UserError``, here and nowhere else.

    An exception that the running command raises is a bug and keeps its traceback. Only a reference that
    cannot be resolved and a path that the system refuses for its form are still translated then, because some
    show up only in a running job.
    """
    try:
        yield
    except UserError:
        raise
    except Exception as error:
        is_mistake = isinstance(error, InterpolationResolutionError) or is_refused_path(error)
        if task.has_started and not is_mistake:
            raise
        reraise_interrupt(error)
        advice = explain(error, task.command, words)
        if advice is None:
            raise
        raise advice from error


def read_words(command: str, words: Sequence[str]) -> Line:
    """Parse a line that runs a command once, for callers in Python.

    Raises ``UserError`` for a line that sweeps or shows a page, which only the command line can do.
    """
    overrides, flags = split(words)
    options = read_flags(flags)
    line = read_line(command, overrides, flags, options)
    is_page = wants_page(options) or options.help or options.cfg or options.experimental_rerun
    if line.is_sweep or is_page:
        shell = shlex.join(["cadam3d", command, *words])
        raise UserError(
            f"{' '.join(flags) or command}: expected the settings of one run, got a line of which only the "
            f"command line knows what to do. Try, in a shell: {shell}"
        )
    return line


def read_line(command: str, overrides: list[str], flags: list[str], options: Namespace) -> Line:
    """Parse a line: quote its overrides and, if it resumes a run, add the overrides of that run."""
    _refuse_bare_words(command, overrides, flags)
    for override in overrides:
        if len(key := key_of(override)) > LONGEST_KEY:
            expected = f"a key of at most {LONGEST_KEY} characters"
            line = f"cadam3d {command} --help"
            raise UserError(f"{key[:40]}...: expected {expected}, got {len(key)} of them. Try: {line}")
    trusting = shlex.join(["cadam3d", command, *overrides, *flags, "trust=true"])
    is_sweep = command == "sweep" or options.multirun or "hydra.mode=MULTIRUN" in overrides
    if is_sweep and command not in TRAINING:
        kept = [override for override in overrides if override != "hydra.mode=MULTIRUN"]
        raise UserError(f"{command}: only training can be swept. Try: {line_of(command, kept)}")
    if command == "export":
        require_target(overrides)
    words = overrides
    overrides = typed = [quoted(override, is_sweep=is_sweep) for override in overrides]
    folders = [Path(options.config_path) if options.config_path else config_dir()]
    folders += [Path(options.config_dir)] if options.config_dir else []
    if command in TRAINING:
        _refuse_resumed_jobs(typed)
        overrides = resumed(typed, is_sweep=is_sweep, folders=folders, retry=trusting)
    elif command in EXPORTING:
        overrides = exporting(typed, folders)
    return Line(command, overrides, flags, options, is_sweep, typed, words, trusting)


def _command(line: Line, task: Task) -> int:
    """Run a command once, or show one of Hydra's pages about it."""
    options = line.options
    if wants_page(options) or options.cfg:
        has_attempts = any(key_of(override) == "attempts" for override in line.overrides)
        shown = [each for each in line.overrides if not (has_attempts and _is_of_sweeps(each))]
        run_hydra(line.command, [*shown, *line.flags], task)
        return 0
    if line.command == "train":
        return _train_once_or_more(line, task)
    run_line(line, compose_checked(line), task)
    return 0


def _train_once_or_more(line: Line, task: Task) -> int:
    """Train a run, or several attempts at it. Attempts are the jobs of a sweep and can have its settings."""
    own = [override for override in line.overrides if _is_of_sweeps(override)]
    rest = [override for override in line.overrides if not _is_of_sweeps(override)]
    cfg = _composed(replace(line, overrides=rest))
    if cfg.get("attempts", 1) > 1:
        from cadam3d.commands import attempts

        return attempts.run(cfg, line.overrides, line.flags, line.options, line.words)
    run_line(line, compose_checked(line) if own else cfg, task)
    return 0


def _is_of_sweeps(override: str) -> bool:
    """Return whether an override is a setting of sweeps and not of the runs in them."""
    return key_of(override) == DRY_RUN or LAUNCHER_KEY.match(key_of(override)) is not None


def compose_checked(line: Line) -> DictConfig:
    """Return the configuration of a line that starts a single run or another command, with Hydra's own node.

    All checks have passed except those that run when components are built. Raises ``UserError`` for several
    attempts at a run too.
    """
    words = [word for word in line.words if key_of(word) != DRY_RUN]
    if line.command == "train" and len(words) < len(line.words):
        page = shlex.join(["cadam3d", "train", *words, *line.flags, "--cfg", "job"])
        raise UserError(
            f"{DRY_RUN}: expected a sweep or several attempts, which it lists, got a single run. The "
            f"settings of a run can be printed instead. Try: {page}"
        )
    cfg = _composed(line)
    if line.command == "train" and cfg.get("attempts", 1) > 1:
        shell = shlex.join(["cadam3d", "train", *line.words, *line.flags])
        raise UserError(
            f"attempts: expected 1, got {cfg.attempts}. Attempts are processes, which only the command line "
            f"starts. Try, in a shell: {shell}"
        )
    return cfg


def _composed(line: Line) -> DictConfig:
    """Return the configuration of a line. Raises ``UserError`` and Hydra's exceptions."""
    cfg = compose_line(line.command, [*line.overrides, "hydra.mode=RUN"], line.options)
    require_values(cfg)
    refuse_missing_settings(cfg, line.command, line.overrides)
    refuse_unread_settings(cfg, line.command, line.overrides)
    require_settings(cfg)
    _refuse_several_runs(cfg, line)
    if line.command == "train":
        require_attempts(cfg.get("attempts", 1))
    return cfg


def run_line(line: Line, cfg: DictConfig, task: Task, *, has_log: bool = True) -> None:
    """Run a command on the configuration of its line; training runs in a folder that it locks.

    Without ``has_log``, the logging of this process stays as it is.
    """
    if line.command in TRAINING:
        _train(cfg, line, task, has_log=has_log)
    else:
        run_composed(cfg, task, has_log=has_log)


def _sweep(line: Line, task: Task) -> int:
    """Run a sweep, or show a page about it or the settings of its first job."""
    if wants_page(line.options):
        run_hydra(line.command, [*line.overrides, *line.flags], task)
        return 0
    if line.options.cfg:
        from cadam3d.sweep.plan import read_sweep

        sweep = read_sweep(line.command, line.overrides, line.options)
        flags = [flag for flag in line.flags if flag not in ("-m", "--multirun")]
        run_hydra("sweep", [*sweep.parts.own, *sweep.jobs[0].overrides, *flags], task)
        return 0
    from cadam3d.commands import sweep as command

    return command.run(line.command, line.overrides, line.flags, line.options)


def _train(cfg: DictConfig, line: Line, task: Task, *, has_log: bool) -> None:
    """Choose the output folder and train there."""
    text = OmegaConf.select(cfg, RUN_FOLDER)
    if not text:
        example = f"{RUN_FOLDER}=outputs/mine"
        raise UserError(f"{RUN_FOLDER}: expected a folder, got nothing. Try: {example}")
    wanted = expanded(str(text))
    # No numbered folder can be made beside ".", which hydra=tool sets.
    is_chosen = not wanted.name or any(key_of(override) == RUN_FOLDER for override in line.overrides)
    resume = Path(str(cfg.resume)) if cfg.resume else None
    with occupied(wanted, is_chosen=is_chosen, resume=resume) as folder:
        place_run(cfg, folder)
        run_composed(cfg, task, has_log=has_log)


def _refuse_several_runs(cfg: DictConfig, line: Line) -> None:
    """Raise ``UserError`` if a line names several runs and its command does not compare them."""
    runs = cfg.get("run")
    if line.command != COMPARING and OmegaConf.is_list(runs):
        typed = f"run=[{','.join(map(str, runs))}]"
        raise UserError(
            f"run: expected one run, got a list of {len(runs)}, which only cadam3d {COMPARING} compares. "
            f"Try: {shlex.join(['cadam3d', COMPARING, typed])}"
        )


def _refuse_resumed_jobs(overrides: Sequence[str]) -> None:
    """Refuse ``resume=`` with the folder of a sweep or of attempts, with the line that continues its jobs."""
    texts = [text_of(override) for override in overrides if key_of(override) == "resume"]
    if not texts or not has_file(folder := typed_path(texts[-1]), JOBS):
        return
    from cadam3d.sweep.folder import read_plan

    plan = read_plan(folder)
    line = shlex.join(["cadam3d", plan.command, *plan.line]) if plan.line else "cadam3d sweep --help"
    noun = "attempts at a run" if plan.command == "train" else "jobs of a sweep"
    raise UserError(
        f"resume: expected the folder of a run, got {texts[-1]!r}, which has {len(plan.jobs)} {noun}. "
        f"The line that started them continues them. Try: {line}"
    )


def wants_page(options: Namespace) -> bool:
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
    elif command == "study":
        # A shell has expanded a pattern of files, or the words are the folders of runs.
        key = "answers" if bare[0].endswith(".json") else "runs"
        line = line_of(command, [*others, f"{key}=[{','.join(bare)}]"])
    else:
        key = "ply" if bare[0].endswith((".ply", ".splat", ".spz")) and command != "eval" else "run"
        line = line_of(command, [*others, f"{key}={bare[0]}"])
    raise UserError(f"{bare[0]!r}: expected key=value. Try: {line}")
