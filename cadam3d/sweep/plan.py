"""From a line to the jobs of a sweep: every one is composed, so that mistakes show before anything runs."""

import copy
import re
from argparse import Namespace
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import InterpolationResolutionError

from cadam3d.advice import ask_for, explain, missing_values
from cadam3d.core.errors import UserError
from cadam3d.launch import compose_line, key_of, refuse_holes
from cadam3d.settings import flatten
from cadam3d.sweep.grid import Axes, Grid, Job, expand, read_grid, read_line, swept_keys

FOLDER = "hydra.sweep.dir"
PLAIN_KEY = re.compile(r"[A-Za-z_][\w.]*=")  # neither an addition nor a deletion nor a package
OF_THE_LAUNCHER = re.compile(r"launcher($|\.)|hydra[./]launcher($|\.)")
OF_THE_GRID = re.compile(r"grid($|\.)")
NOT_FOR_SWEEPS = re.compile(r"hydra\.run\.dir$|hydra\.sweep\.subdir$|hydra[./]sweeper($|\.)")
NOTHING_TO_SWEEP = (
    "sweep: nothing to sweep over. Try: cadam3d sweep grid=thresholds ... or densifier=baseline,cadam"
)
ALWAYS_TOLD = ("prompt", "seed")


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

    values: dict[str, Any]  # by dotted key; what only a running job can resolve is left out
    choices: Mapping[str, Any]  # by group

    def get(self, key: str) -> Any:
        """A value, or what was chosen of a group; None if the job has no such key."""
        return self.choices[key] if key in self.choices else self.values.get(key)


class Composer:
    """Composes ``cadam3d train`` with many lines quickly.

    Composing takes Hydra a sixth of a second, and most jobs of a sweep differ in plain values only. So lines
    that choose the same parts are composed once, and values are put in afterwards, as Hydra itself does.
    """

    def __init__(self, command: str, options: Namespace, common: Sequence[str]) -> None:
        self._command, self._options = command, options
        self._bases: dict[tuple[str, ...], tuple[DictConfig, set[str]]] = {}
        self._common = list(common)
        _, self._leaves = self._base(())

    def compose(self, overrides: Sequence[str]) -> Composed:
        """The settings under ``overrides``. Raises ``UserError`` for what cannot be composed or is missing."""
        cfg = self._composed(overrides)
        if missing := missing_values(cfg):
            raise ask_for(missing, self._command)
        refuse_holes(cfg, self._command, overrides)
        return Composed(values=dict(_resolved(cfg)), choices=cfg.hydra.runtime.choices)

    def has(self, overrides: Sequence[str], key: str) -> bool:
        """Whether a job under ``overrides`` has a setting or a group called ``key``."""
        cfg, _ = self._base(tuple(overrides))
        return key in cfg.hydra.runtime.choices or OmegaConf.select(cfg, key, default=self) is not self

    def _composed(self, overrides: Sequence[str]) -> DictConfig:
        is_value = {line: bool(PLAIN_KEY.match(line)) and key_of(line) in self._leaves for line in overrides}
        cfg, leaves = self._base(tuple(line for line in overrides if not is_value[line]))
        values = [line for line in overrides if is_value[line]]
        if not leaves.issuperset(map(key_of, values)):
            return self._base(tuple(overrides))[0]  # Hydra says what is wrong
        cfg = copy.deepcopy(cfg)
        for line in values:
            value = OverridesParser.create().parse_override(line).value()
            OmegaConf.update(cfg, key_of(line), value, merge=True)
        return cfg

    def _base(self, overrides: tuple[str, ...]) -> tuple[DictConfig, set[str]]:
        if overrides not in self._bases:
            cfg = compose_line("train", [*self._common, *overrides], self._options)
            raw = OmegaConf.to_container(cfg, resolve=False)
            self._bases[overrides] = cfg, {key for key, _ in flatten(raw)}
        return self._bases[overrides]


def read_sweep(command: str, overrides: Sequence[str], options: Namespace) -> tuple[Sweep, Composer]:
    """What the line asks for. Raises ``UserError`` for a line that asks for no sweep or for too much."""
    line = sort_out(overrides)
    cfg = compose_line("sweep", [*line.grid, *line.launcher, *line.folder], options)
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
    """Tell the overrides of jobs from those of the sweep itself."""
    line = Line(grid=[], launcher=[], folder=[], jobs=[])
    for override in overrides:
        key = key_of(override)
        if NOT_FOR_SWEEPS.match(key):
            raise UserError(
                f"{key}: not for sweeps, whose jobs lie in one folder. Try: {FOLDER}=multirun/mine"
            )
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
    """The settings of every job. Raises ``UserError``, with the name of the arm, for a job that cannot run."""
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


def _resolved(cfg: DictConfig) -> Iterator[tuple[str, Any]]:
    raw = OmegaConf.to_container(cfg, resolve=False)
    assert isinstance(raw, dict)
    raw.pop("hydra", None)
    for key, value in flatten(raw):
        if not _may_refer(value):
            yield key, value
            continue
        try:
            node = OmegaConf.select(cfg, key)
        except InterpolationResolutionError:  # such as ${hydra:...}
            continue
        yield key, OmegaConf.to_container(node, resolve=True) if OmegaConf.is_config(node) else node


def _may_refer(value: Any) -> bool:
    return "${" in str(value)
