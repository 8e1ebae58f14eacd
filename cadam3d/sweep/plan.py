"""From a line to the jobs of a sweep: every one is composed, so that mistakes show before anything runs."""

import re
from argparse import Namespace
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import InterpolationResolutionError

from cadam3d.core.errors import UserError
from cadam3d.launch import compose_line, key_of, refuse_holes
from cadam3d.settings.advice import ask_for, explain, missing_values
from cadam3d.settings.compose import flatten
from cadam3d.sweep.grid import ALWAYS_TOLD, Axes, Grid, Job, expand, read_grid, read_line, swept_keys

FOLDER = "hydra.sweep.dir"
PLAIN_KEY = re.compile(r"[A-Za-z_][\w.]*=")  # neither an addition nor a deletion nor a package
OF_THE_LAUNCHER = re.compile(r"launcher($|\.)|hydra[./]launcher($|\.)")
OF_THE_GRID = re.compile(r"grid($|\.)")
NOT_FOR_SWEEPS = re.compile(r"hydra\.run\.dir$|hydra\.sweep\.subdir$|hydra[./]sweeper($|\.)")
NOTHING_TO_SWEEP = (
    "sweep: nothing to sweep over. Try: cadam3d sweep grid=thresholds ... or densifier=baseline,cadam"
)


@dataclass(frozen=True)
class Line:
    """The overrides of a line by whom they concern; a search path for YAML files concerns all of them."""

    grid: list[str]
    launcher: list[str]
    folder: list[str]
    jobs: list[str]


@dataclass(frozen=True)
class Sweep:
    """What a line asks for."""

    cfg: DictConfig  # of the sweep itself: the grid, the launcher, Hydra's node
    line: Line
    grid: Grid
    axes: Axes  # of the line
    jobs: list[Job]

    @property
    def grid_name(self) -> str | None:
        """The grid as the line names it."""
        return self.cfg.hydra.runtime.choices.get("grid")


@dataclass(frozen=True)
class Composed:
    """The settings that a job would run with."""

    values: dict[str, Any]  # by dotted key
    choices: Mapping[str, Any]  # by group
    unknown: set[str]  # keys whose value only the running job knows

    def get(self, key: str) -> Any:
        """A value, or what was chosen of a group; None if the job has no such key."""
        return self.choices[key] if key in self.choices else self.values.get(key)


@dataclass(frozen=True)
class Base:
    """A composed job, of which others differ in values only."""

    cfg: DictConfig
    plain: dict[str, Any]  # leaves by dotted key
    referring: list[str]  # leaves that interpolations make

    @classmethod
    def of(cls, cfg: DictConfig) -> "Base":
        """Sort the leaves of ``cfg``, apart from Hydra's own."""
        raw = OmegaConf.to_container(cfg, resolve=False)
        assert isinstance(raw, dict)
        raw.pop("hydra", None)
        leaves = dict(flatten(raw))
        referring = [key for key, value in leaves.items() if "${" in str(value)]
        return cls(cfg, {key: leaves[key] for key in leaves.keys() - set(referring)}, referring)

    def composed(self, values: Mapping[str, Any]) -> Composed:
        """The job with ``values`` instead, put in as Hydra does."""
        for key, value in values.items():
            OmegaConf.update(self.cfg, key, value, merge=True)
        resolved = {}
        for key in self.referring:
            with suppress(InterpolationResolutionError):  # such as ${hydra:...}
                node = OmegaConf.select(self.cfg, key)
                resolved[key] = (
                    OmegaConf.to_container(node, resolve=True) if OmegaConf.is_config(node) else node
                )
        return Composed(
            values={**self.plain, **values, **resolved},
            choices=self.cfg.hydra.runtime.choices,
            unknown=set(self.referring) - resolved.keys(),
        )


class Composer:
    """Composes ``cadam3d train`` with many lines quickly.

    One line takes Hydra a sixth of a second, and most jobs of a sweep differ in plain values only. So lines
    that choose the same parts and set the same keys are composed once.
    """

    def __init__(self, command: str, options: Namespace, common: Sequence[str]) -> None:
        self._command, self._options, self._common = command, options, list(common)
        self._bases: dict[tuple[str, ...], Base] = {}
        self._leaves = set(self._base([]).plain)

    def compose(self, overrides: Sequence[str]) -> Composed:
        """The settings under ``overrides``. Raises ``UserError`` if they do not compose or lack a value."""
        values = {}
        key_lines = []
        for line in overrides:
            is_value = PLAIN_KEY.match(line) and key_of(line) in self._leaves and "${" not in line
            if is_value:
                values[key_of(line)] = _value(line)
            key_lines.append(key_of(line) if is_value else line)
        known = tuple(key_lines)
        if known not in self._bases:
            base = self._base(overrides)
            if missing := missing_values(base.cfg):
                raise ask_for(missing, self._command)
            refuse_holes(base.cfg, self._command, overrides)
            self._bases[known] = base
        return self._bases[known].composed(values)

    def has(self, overrides: Sequence[str], key: str) -> bool:
        """Whether a job under ``overrides`` has a setting or a group called ``key``."""
        base = self._base(overrides)
        leaves = (*base.plain, *base.referring, *base.cfg.hydra.runtime.choices)
        return any(f"{leaf}.".startswith(f"{key}.") for leaf in leaves)

    def _base(self, overrides: Sequence[str]) -> Base:
        return Base.of(compose_line("train", [*self._common, *overrides], self._options))


def read_sweep(command: str, overrides: Sequence[str], options: Namespace) -> tuple[Sweep, Composer]:
    """What the line asks for. Raises ``UserError`` for a line that asks for no sweep or for too much."""
    line = sort_out(overrides)
    own = Namespace(**{**vars(options), "config_name": None})  # another name concerns the jobs
    cfg = compose_line("sweep", [*line.grid, *line.launcher, *line.folder], own)
    node = cfg.get("grid")
    grid = read_grid(None if node is None else OmegaConf.to_container(node, resolve=True))
    try:
        axes = read_line(line.jobs)
    except UserError:
        raise
    except Exception as error:
        raise explain(error, command, overrides) or error from error
    composer = Composer(command, options, _search_path(overrides))
    jobs = expand(grid, axes, composer.has)
    if command == "sweep" and node is None and len(jobs) == 1:
        raise UserError(NOTHING_TO_SWEEP)
    return Sweep(cfg=cfg, line=line, grid=grid, axes=axes, jobs=jobs), composer


def sort_out(overrides: Sequence[str]) -> Line:
    """Tell the overrides of jobs from those of the sweep. Raises ``UserError`` for what fits in none."""
    line = Line(grid=[], launcher=[], folder=[], jobs=[])
    for override in overrides:
        key = key_of(override)
        if NOT_FOR_SWEEPS.match(key):
            raise UserError(f"{key}: not for sweeps. Try: {FOLDER}=multirun/mine, where all jobs are")
        if key == "hydra.mode":
            continue
        if OF_THE_GRID.match(key):
            line.grid.append(override)
        elif OF_THE_LAUNCHER.match(key):
            line.launcher.append(override.lstrip("+") if key == "launcher" else override)
        elif key == FOLDER:
            line.folder.append(override)
        else:
            line.jobs.append(override)
    line.grid.extend(_search_path(overrides))
    return line


def compose_all(sweep: Sweep, composer: Composer) -> list[Composed]:
    """The settings of every job. Raises ``UserError``, naming the arm, for a job that cannot run."""
    composed = []
    for job in sweep.jobs:
        try:
            composed.append(composer.compose(job.overrides))
        except UserError as error:
            raise UserError(f"arm {job.arm}: {error}" if job.arm else str(error)) from error
    return composed


def told_keys(sweep: Sweep) -> list[str]:
    """The keys whose values a table of this sweep must tell."""
    return list(dict.fromkeys([*ALWAYS_TOLD, *swept_keys(sweep.grid, sweep.axes)]))


def _search_path(overrides: Sequence[str]) -> list[str]:
    return [line for line in overrides if key_of(line) == "hydra.searchpath"]


@cache
def _value(line: str) -> Any:
    return OverridesParser.create().parse_override(line).value()
