"""Launch: read a command line, refuse one that cannot work before any work starts, and run its command."""

import errno
import gc
import re
import shlex
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from importlib import import_module

from omegaconf import DictConfig, OmegaConf, open_dict

from cadam3d.core.checks import fail, require
from cadam3d.core.console import show
from cadam3d.core.errors import UserError
from cadam3d.io.run_folder import RUN_FOLDER, expanded
from cadam3d.settings.advice import explain
from cadam3d.settings.check import require_effective, require_settings
from cadam3d.settings.compose import Call, compose, run_hydra
from cadam3d.settings.help import help_text
from cadam3d.settings.line import HYDRA_KEYS, OF_SWEEPS, Line, key_of, quoted, read_flags, resumed
from cadam3d.settings.options import with_example

EXPORTING = ("render", "export")  # the commands with output=
MULTIRUN = ("--multirun", "-m")  # flags that make a sweep of a training


def launch(command: str, words: Sequence[str]) -> int:
    """Run ``cadam3d <command> <words>`` and return its exit code.

    Raises ``UserError`` for mistakes of the user.
    """
    if command == "train" and any(flag in words for flag in MULTIRUN):
        command, words = "sweep", [word for word in words if word not in MULTIRUN]
    with explaining(command, words):
        line = read_line(command, words)
        if line.wants_page:
            _show_page(line)
            return 0
        if command == "sweep":
            from cadam3d.commands import sweep

            return sweep.run(line)
        cfg = _composed(line)
        if cfg.get("attempts", 1) > 1:
            from cadam3d.commands import attempts

            return attempts.run(cfg, line)
        call = _call(line, cfg)
        module = import_module(f"cadam3d.commands.{command}")
    # Imported modules stay in memory, so the garbage collector need not scan them.
    gc.freeze()
    gc.enable()
    with completing():
        return module.run(cfg, call) or 0


def prepare(command: str, words: Sequence[str]) -> tuple[DictConfig, Call]:
    """Return the settings of a line that runs a command once, for callers in Python.

    All checks have passed except those that run when components are built. Raises ``UserError`` for mistakes
    of the user, and for a line that sweeps or shows a page, which only the command line can do.
    """
    with explaining(command, words):
        line = read_line(command, words)
        cfg = None if command == "sweep" or line.wants_page else _composed(line)
        if cfg is None or cfg.get("attempts", 1) > 1:
            shell = f"in a shell: {shlex.join(['cadam3d', command, *words])}"
            raise fail(command, expected="a single run without a page", got=line.words, example=shell)
        return cfg, _call(line, cfg)


@contextmanager
def completing() -> Iterator[None]:
    """Add an example to a mistake of the user that a running command finds; a bug keeps its traceback."""
    try:
        yield
    except UserError as error:
        raise with_example(error) from error.__cause__
    except OSError as error:
        if error.errno not in (errno.ENAMETOOLONG, errno.ELOOP):
            raise
        expected = f"one without this problem: {error.strerror}"
        raise fail("path", expected=expected, got=error.filename, example="a shorter one") from error


@contextmanager
def explaining(command: str, words: Sequence[str]) -> Iterator[None]:
    """Translate the exceptions of Hydra and OmegaConf into ``UserError``, here and nowhere else."""
    try:
        with completing():
            yield
    except Exception as error:
        # The clean-up of OmegaConf can raise after an interrupt.
        if isinstance(error.__context__, KeyboardInterrupt):
            raise KeyboardInterrupt from error
        advice = explain(error, command, words)
        if advice is None or advice is error:
            raise
        raise advice from error


def read_line(command: str, words: Sequence[str]) -> Line:
    """Parse a line: quote its overrides and, if it resumes a run, add the overrides of that run.

    Raises ``UserError`` for a line that is wrong whatever the settings are.
    """
    if command == "doctor":
        words = ["json=true" if word == "--json" else word for word in words]
    options, typed = read_flags(words)
    flags = [word for word in words if word not in typed]
    line = Line(command, words=typed, overrides=typed, flags=flags, options=options)
    if options.help:
        return line
    for word in typed:
        key, example = key_of(word), f"cadam3d {command} --help"
        is_override = "=" in word or word.startswith("~")
        expected = "key=value, in quotes if it has spaces"
        require(is_override, repr(word), expected=expected, got=word, example=example)
        if re.split(r"[./]", key)[0] == "hydra" and not HYDRA_KEYS.match(key):
            raise UserError(f"{key}: cadam3d has no such setting of Hydra. Try: {RUN_FOLDER}=outputs/mine")
    is_sweep = command == "sweep"
    overrides = [quoted(override, is_sweep=is_sweep) for override in typed]
    if is_sweep or command == "train":
        retry = shlex.join(["cadam3d", command, *words, "trust=true"])
        overrides = resumed(overrides, is_sweep=is_sweep, folders=line.folders, retry=retry)
    elif command in EXPORTING:
        # The exporters load torch.
        from cadam3d.settings.output import exporting

        overrides = exporting(overrides, line.folders)
    return replace(line, overrides=overrides)


def _show_page(line: Line) -> None:
    """Print a page: our help, the settings, or one of Hydra's own."""
    if line.options.help:
        show(help_text(line.command, line.overrides, line.folders))
    elif line.command == "sweep" and line.options.cfg:
        from cadam3d.sweep.plan import read_sweep

        # The page of a sweep shows the settings of its first job.
        sweep = read_sweep(line)
        run_hydra("sweep", [*sweep.parts.own, *sweep.plan.jobs[0].overrides, *line.flags])
    else:
        run_hydra(line.command, [*line.overrides, *line.flags])


def _composed(line: Line) -> DictConfig:
    """Return the checked configuration of a line, with Hydra's own node.

    Raises ``UserError`` and Hydra's exceptions.
    """
    is_training = line.command == "train"
    # Only a line that trains several attempts may have settings of sweeps.
    of_sweeps = [word for word in line.overrides if is_training and OF_SWEEPS.match(key_of(word))]
    own = [word for word in line.overrides if word not in of_sweeps]
    cfg = compose(own, line.command, line.options)
    require_effective(cfg, line.command, own)
    require_settings(cfg)
    runs = cfg.get("run")
    is_comparison = OmegaConf.is_list(runs) and line.command != "render"
    require(not is_comparison, "run", expected="one run", got=runs, example="run=outputs/latest")
    if of_sweeps and cfg.get("attempts", 1) == 1:
        key = key_of(of_sweeps[0])
        raise fail(key, expected="a sweep or several attempts", got=of_sweeps[0], example="attempts=2")
    return cfg


def _call(line: Line, cfg: DictConfig) -> Call:
    """Return how a line calls its command, and remove Hydra's own node from ``cfg``, in place."""
    text = OmegaConf.select(cfg, RUN_FOLDER)
    require(bool(text), RUN_FOLDER, expected="a folder", got=text, example=f"{RUN_FOLDER}=outputs/mine")
    with open_dict(cfg):
        return Call(
            words=[*line.flags, *line.words],
            hydra=cfg.pop("hydra"),
            folder=expanded(str(text)).absolute(),
            has_chosen_folder=any(key_of(override) == RUN_FOLDER for override in line.overrides),
        )
