"""Launch: read a command line, refuse one that cannot work before any work starts, and run its command."""

import gc
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from importlib import import_module
from pathlib import Path

from omegaconf import DictConfig, OmegaConf, open_dict

from cadam3d.core.checks import fail
from cadam3d.core.errors import UserError
from cadam3d.io.run_folder import JOBS, RUN_FOLDER, expanded, has_file, typed_path
from cadam3d.settings.advice import explain, line_of, refused_path, reraise_interrupt
from cadam3d.settings.check import require_effective, require_settings
from cadam3d.settings.compose import Call, compose_line, run_hydra
from cadam3d.settings.help import help_text
from cadam3d.settings.line import (
    DRY_RUN,
    HYDRA_KEYS,
    LAUNCHER_KEY,
    Line,
    key_of,
    quoted,
    read_flags,
    resumed,
    split,
    text_of,
)
from cadam3d.settings.options import config_dir, with_example
from cadam3d.sweep.plan import require_attempts

TRAINING = ("train", "sweep")  # the commands that have a run folder
EXPORTING = ("render", "export")  # the commands with output=
COMPARING = "render"  # the command that accepts several runs


def launch(command: str, words: Sequence[str]) -> int:
    """Run ``cadam3d <command> <words>`` and return its exit code.

    Raises ``UserError`` for mistakes of the user.
    """
    with explaining(command, words):
        line = read_line(command, words)
        if line.wants_page:
            _show_page(line)
            return 0
        if line.is_sweep:
            from cadam3d.commands import sweep

            return sweep.run(command, line.overrides, line.flags, line.options)
        cfg = _composed(_without_sweeps(line))
        if cfg.get("attempts", 1) > 1:
            from cadam3d.commands import attempts

            return attempts.run(cfg, line.overrides, line.flags, line.options, line.words)
        _refuse_sweeps(line)
        call = _call(line, cfg)
        module = import_module(f"cadam3d.commands.{command}")
    # Imported modules stay in memory, so the garbage collector need not scan them.
    gc.freeze()
    gc.enable()
    with completing(words):
        return module.run(cfg, call) or 0


def prepare(command: str, words: Sequence[str]) -> tuple[DictConfig, Call]:
    """Return the settings of a line that runs a command once, for callers in Python.

    All checks have passed except those that run when components are built. Raises ``UserError`` for mistakes
    of the user, and for a line that sweeps or shows a page, which only the command line can do.
    """
    with explaining(command, words):
        line = read_line(command, words)
        shell = f"in a shell: {line_of(command, words)}"
        if line.is_sweep or line.wants_page:
            raise fail(command, expected="a single run without a page", got=line.words, example=shell)
        _refuse_sweeps(line)
        cfg = _composed(line)
        if cfg.get("attempts", 1) > 1:
            raise fail("attempts", expected="1 in Python", got=cfg.attempts, example=shell)
        return cfg, _call(line, cfg)


@contextmanager
def completing(words: Sequence[str]) -> Iterator[None]:
    """Add an example to a mistake of the user that a running command finds; a bug keeps its traceback."""
    try:
        yield
    except UserError as error:
        raise with_example(error) from error.__cause__
    except OSError as error:
        if advice := refused_path(error):
            raise advice from error
        raise


@contextmanager
def explaining(command: str, words: Sequence[str]) -> Iterator[None]:
    """Translate the exceptions of Hydra and OmegaConf into ``UserError``, here and nowhere else."""
    try:
        with completing(words):
            yield
    except UserError:
        raise
    except Exception as error:
        reraise_interrupt(error)
        advice = explain(error, command, words)
        if advice is None:
            raise
        raise advice from error


def read_line(command: str, words: Sequence[str]) -> Line:
    """Parse a line: quote its overrides and, if it resumes a run, add the overrides of that run.

    Raises ``UserError`` for a line that is wrong whatever the settings are.
    """
    if command == "doctor":
        words = ["json=true" if word == "--json" else word for word in words]
    typed, flags = split(words)
    options = read_flags(flags)
    is_sweep = command == "sweep" or options.multirun or "hydra.mode=MULTIRUN" in typed
    line = Line(command, typed, flags, options, is_sweep=is_sweep, words=typed)
    if options.help:
        return line
    _refuse_words(line)
    overrides = [quoted(override, is_sweep=is_sweep) for override in typed]
    folders = [Path(options.config_dir)] if options.config_dir else []
    folders.append(Path(options.config_path) if options.config_path else config_dir())
    if command in TRAINING:
        _refuse_resumed_jobs(overrides)
        overrides = resumed(overrides, is_sweep=is_sweep, folders=folders, retry=line.trusting)
    elif command in EXPORTING:
        # The exporters load torch.
        from cadam3d.settings.output import exporting

        overrides = exporting(overrides, folders)
    return replace(line, overrides=overrides)


def _show_page(line: Line) -> None:
    """Print a page: our help, the settings, or one of the pages about Hydra."""
    if line.options.help:
        print(help_text(line.command, line.overrides, line.options))
    elif line.is_sweep and line.options.cfg:
        from cadam3d.sweep.plan import read_sweep

        # The page of a sweep shows the settings of its first job.
        sweep = read_sweep(line.command, line.overrides, line.options)
        flags = [flag for flag in line.flags if flag not in ("-m", "--multirun")]
        run_hydra("sweep", [*sweep.parts.own, *sweep.jobs[0].overrides, *flags])
    else:
        has_attempts = any(key_of(override) == "attempts" for override in line.overrides)
        shown = _without_sweeps(line) if has_attempts else line
        run_hydra(line.command, [*shown.overrides, *line.flags])


def _composed(line: Line) -> DictConfig:
    """Return the checked configuration of a line, with Hydra's own node.

    Raises ``UserError`` and Hydra's exceptions.
    """
    cfg = compose_line(line.command, line.overrides, line.options)
    require_effective(cfg, line.command, line.overrides)
    require_settings(cfg)
    _refuse_several_runs(cfg, line)
    if line.command == "train":
        require_attempts(cfg.get("attempts", 1))
    return cfg


def _call(line: Line, cfg: DictConfig) -> Call:
    """Return how a line calls its command, and remove Hydra's own node from ``cfg``, in place."""
    text = OmegaConf.select(cfg, RUN_FOLDER)
    if not text:
        raise UserError(f"{RUN_FOLDER}: expected a folder, got nothing. Try: {RUN_FOLDER}=outputs/mine")
    with open_dict(cfg):
        return Call(
            words=line.words,
            hydra=cfg.pop("hydra"),
            folder=expanded(str(text)).absolute(),
            has_chosen_folder=any(key_of(override) == RUN_FOLDER for override in line.overrides),
        )


def _is_of_sweeps(override: str) -> bool:
    """Return whether an override is a setting of sweeps and not of the runs in them."""
    return key_of(override) == DRY_RUN or LAUNCHER_KEY.match(key_of(override)) is not None


def _without_sweeps(line: Line) -> Line:
    """Return a line of training without settings of sweeps, which several attempts can have."""
    if line.command != "train":
        return line
    return replace(line, overrides=[each for each in line.overrides if not _is_of_sweeps(each)])


def _refuse_sweeps(line: Line) -> None:
    """Refuse a setting of sweeps in a line that trains a single run."""
    own = [word for word in line.words if _is_of_sweeps(word)]
    if line.command == "train" and own:
        raise fail(key_of(own[0]), expected="a sweep or several attempts", got=own[0], example="attempts=2")


def _refuse_words(line: Line) -> None:
    """Refuse overrides that no command accepts, and a sweep of a command that cannot be swept."""
    command = line.command
    for word in line.words:
        key = key_of(word)
        if "=" not in word and not word.startswith("~"):
            expected = "key=value, in quotes if it has spaces"
            raise fail(repr(word), expected=expected, got=word, example=f"cadam3d {command} --help")
        if key.partition(".")[0].partition("/")[0] == "hydra" and not HYDRA_KEYS.match(key):
            raise UserError(f"{key}: cadam3d has no such setting of Hydra. Try: {RUN_FOLDER}=outputs/mine")
    if line.is_sweep and command not in TRAINING:
        raise UserError(f"{command}: only training can be swept. Try: cadam3d {command} --help")


def _refuse_several_runs(cfg: DictConfig, line: Line) -> None:
    """Raise ``UserError`` if a line names several runs and its command does not compare them."""
    runs = cfg.get("run")
    if line.command != COMPARING and OmegaConf.is_list(runs):
        raise fail("run", expected="one run", got=[*runs], example=f"run={runs[0]}")


def _refuse_resumed_jobs(overrides: Sequence[str]) -> None:
    """Refuse ``resume=`` with the folder of a sweep or of attempts, with the line that continues its jobs."""
    texts = [text_of(override) for override in overrides if key_of(override) == "resume"]
    if not texts or not has_file(folder := typed_path(texts[-1]), JOBS):
        return
    from cadam3d.sweep.folder import read_plan

    plan = read_plan(folder)
    line = line_of(plan.command, plan.line)
    raise fail("resume", expected="the folder of a run, not of several", got=texts[-1], example=line)
