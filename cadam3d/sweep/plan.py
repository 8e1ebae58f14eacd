"""Plan: list the jobs of a sweep and compose each of them, so that mistakes show before anything runs."""

import re
from argparse import Namespace
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import InterpolationResolutionError

from cadam3d.core.checks import require
from cadam3d.core.errors import UserError
from cadam3d.settings.advice import RefusedJobError, line_of, require_values
from cadam3d.settings.check import require_settings
from cadam3d.settings.compose import flatten
from cadam3d.settings.hydra import compose_line, refuse_missing_settings, refuse_unread_settings
from cadam3d.settings.line import DRY_RUN, LAUNCHER_KEY, RUN_FOLDER, SWEEP_FOLDER, key_of
from cadam3d.sweep.choice import require_attempts
from cadam3d.sweep.grid import (
    ALWAYS_SHOWN,
    Axes,
    Grid,
    Job,
    expand,
    prompt_axis,
    read_grid,
    read_line,
    swept_keys,
)
from cadam3d.sweep.prompts import FILE, KEY, PromptChoice, read_choice

# An override that is neither an addition nor a deletion and names no package.
PLAIN_KEY = re.compile(r"[A-Za-z_][\w.]*=")
GRID_KEY = re.compile(r"(grid|prompts)($|\.)")
REFUSED_KEY = re.compile(r"hydra\.run\.dir$|hydra\.sweep\.subdir$|hydra[./]sweeper($|\.)")
NOTHING_TO_SWEEP = "sweep: nothing to sweep over. Try: densifier=baseline,cadam"


@dataclass(frozen=True)
class Parts:
    """The overrides of a line, sorted by what they change. A search path for YAML files applies to all."""

    grid: list[str]  # and the choice of prompts, and whether to list the jobs only
    launcher: list[str]
    folder: list[str]
    jobs: list[str]


@dataclass(frozen=True)
class Sweep:
    """A sweep that a line describes."""

    cfg: DictConfig  # the grid, the launcher, Hydra's node
    parts: Parts  # of the line
    grid: Grid
    axes: Axes  # of the line
    prompts: PromptChoice | None  # None if the line and the grid name no file or set of prompts
    jobs: list[Job]
    command: str = "sweep"  # of the line; "train" if the jobs are several attempts at one run
    # The folder, unless the line has one; None stands for a name that says what is swept.
    place: Path | None = None

    @property
    def grid_name(self) -> str | None:
        """Return the name of the grid in the line; None without one."""
        return self.cfg.hydra.runtime.choices.get("grid")

    @property
    def is_dry(self) -> bool:
        """Return whether the jobs are only listed."""
        return self.cfg[DRY_RUN]

    @property
    def folder_key(self) -> str:
        """Return the setting that chooses the folder."""
        return RUN_FOLDER if self.command == "train" else SWEEP_FOLDER

    @property
    def noun(self) -> str:
        """Return what a job is called in messages."""
        return "attempt" if self.command == "train" else "job"


@dataclass(frozen=True)
class Composed:
    """The settings that a job would run with."""

    values: dict[str, Any]  # by dotted key
    choices: Mapping[str, Any]  # by group
    unknown: set[str]  # keys with values that only a running job has

    def get(self, key: str) -> Any:
        """Return a value, or the option chosen of a group; None if the job has no such key."""
        return self.choices[key] if key in self.choices else self.values.get(key)


@dataclass(frozen=True)
class Base:
    """A composed job from which other jobs differ in plain values only."""

    cfg: DictConfig
    plain: dict[str, Any]  # by dotted key
    referring: list[str]  # keys of interpolations

    @classmethod
    def of(cls, cfg: DictConfig) -> "Base":
        """Return ``cfg`` with its values sorted into plain ones and interpolations, without Hydra's own."""
        raw = OmegaConf.to_container(cfg, resolve=False)
        assert isinstance(raw, dict)
        raw.pop("hydra", None)
        leaves = dict(flatten(raw))
        referring = [key for key, value in leaves.items() if "${" in str(value)]
        return cls(cfg, {key: leaves[key] for key in leaves.keys() - set(referring)}, referring)

    def composed(self, values: Mapping[str, Any]) -> Composed:
        """Return the job with other ``values``, set as Hydra sets them."""
        for key, value in values.items():
            OmegaConf.update(self.cfg, key, value, merge=True)
        resolved: dict[str, Any] = {}
        unknown = set(self.referring)
        for key in self.referring:
            with suppress(InterpolationResolutionError):  # such as ${hydra:...}
                node = OmegaConf.select(self.cfg, key)
                # A reference to a whole part, such as ${prompting}, stands for all its settings.
                plain = OmegaConf.to_container(node, resolve=True) if OmegaConf.is_config(node) else node
                resolved.update(flatten(plain, key))
                unknown.remove(key)
        return Composed(
            values={**self.plain, **values, **resolved},
            choices=self.cfg.hydra.runtime.choices,
            unknown=unknown,
        )


class Composer:
    """Composes many lines of ``cadam3d train`` quickly.

    Hydra needs a sixth of a second for one line, and most jobs of a sweep differ in plain values only. Lines
    that choose the same parts and set the same keys are therefore composed only once.
    """

    def __init__(self, options: Namespace, common: Sequence[str]) -> None:
        self._options, self._common = options, list(common)
        self._bases: dict[tuple[str, ...], Base] = {}
        self._keys: dict[tuple[str, ...], list[str]] = {}  # settings and groups, by overrides
        self._leaves = set(self._base([]).plain)

    def compose(self, overrides: Sequence[str]) -> Composed:
        """Return the settings under ``overrides``. Raises if they cannot be composed or lack a value."""
        # Values of keys that not every option has are set on a composed job too, unless they replace a part.
        dotted = [line for line in overrides if self._is_value(line) or self._may_be_value(line)]
        plain = [line for line in dotted if self._is_value(line)]
        base = self._base_of(overrides, dotted)
        if not {key_of(line) for line in dotted} <= base.plain.keys():
            base, dotted = self._base_of(overrides, plain), plain
        composed = base.composed({key_of(line): _value(line) for line in dotted})
        require_settings(composed.values)
        return composed

    def has(self, overrides: Sequence[str], key: str) -> bool:
        """Return whether a job under ``overrides`` has a setting or a group called ``key``."""
        # Which settings there are does not depend on plain values.
        arm = tuple(line for line in overrides if not self._is_value(line))
        if arm not in self._keys:
            base = self._base(arm)
            self._keys[arm] = [*base.plain, *base.referring, *base.cfg.hydra.runtime.choices]
        return any(f"{known}.".startswith(f"{key}.") for known in self._keys[arm])

    def _is_value(self, line: str) -> bool:
        """Return whether an override sets a plain value that the jobs have by default."""
        return bool(PLAIN_KEY.match(line)) and key_of(line) in self._leaves and "${" not in line

    @staticmethod
    def _may_be_value(line: str) -> bool:
        """Return whether an override may set a plain value of an option, and surely chooses no option."""
        return bool(PLAIN_KEY.match(line)) and "." in key_of(line) and "${" not in line

    def _base_of(self, overrides: Sequence[str], values: Sequence[str]) -> Base:
        """Return a job under ``overrides`` that differs from others in ``values``, composed only once."""
        known = tuple(key_of(line) if line in values else line for line in overrides)
        if known not in self._bases:
            base = self._base(overrides)
            require_values(base.cfg)
            refuse_missing_settings(base.cfg, "sweep", overrides)
            refuse_unread_settings(base.cfg, "sweep", overrides)
            self._bases[known] = base
        return self._bases[known]

    def _base(self, overrides: Sequence[str]) -> Base:
        return Base.of(compose_line("train", [*self._common, *overrides], self._options))


def read_sweep(command: str, overrides: Sequence[str], options: Namespace) -> tuple[Sweep, Composer]:
    """Return the sweep that a line describes, and the composer of its jobs.

    Raises ``UserError`` for a line with a single job or with settings that a sweep cannot have.
    """
    parts = sort_overrides(overrides)
    cfg = compose_sweep(parts, options)
    node = cfg.get("grid")
    grid = read_grid(None if node is None else OmegaConf.to_container(node, resolve=True))
    axes = read_line(parts.jobs)
    prompts = _read_prompts(cfg, grid, axes, overrides)
    if prompts is not None:
        axes = {"prompt": prompt_axis(prompts.read())} | axes
    composer = Composer(options, search_path(overrides))
    jobs = expand(grid, axes, composer.has)
    if command == "sweep" and node is None and prompts is None and len(jobs) == 1:
        raise UserError(NOTHING_TO_SWEEP)
    return Sweep(cfg=cfg, parts=parts, grid=grid, axes=axes, prompts=prompts, jobs=jobs), composer


def compose_sweep(parts: Parts, options: Namespace) -> DictConfig:
    """Return the settings of a sweep itself, which are its grid, its launcher and Hydra's node.

    Raises ``UserError`` for wrong values, and Hydra's exceptions.
    """
    # The flag --config-name is for the jobs and not for the sweep itself.
    own = Namespace(**{**vars(options), "config_name": None})
    cfg = compose_line("sweep", [*parts.grid, *parts.launcher, *parts.folder], own)
    # A wrong setting of the launcher is found now, and not when the jobs are there.
    OmegaConf.to_container(cfg.hydra.launcher, resolve=True)
    is_answer = isinstance(cfg[DRY_RUN], bool)
    require(is_answer, DRY_RUN, expected="true or false", got=cfg[DRY_RUN], example=f"{DRY_RUN}=true")
    return cfg


def _read_prompts(cfg: DictConfig, grid: Grid, axes: Axes, overrides: Sequence[str]) -> PromptChoice | None:
    """Return the choice of prompts of a line or its grid. A prompt in the line replaces those of the grid.

    Raises ``UserError`` if the line has both a prompt and a choice of prompts.
    """
    node = cfg.get(KEY)
    choice = None if node is None else OmegaConf.to_container(node, resolve=True)
    assert choice is None or isinstance(choice, dict), "the line gives a file, not this node"
    if "prompt" not in axes:
        return read_choice(choice, grid.prompts)
    if read_choice(choice, None) is not None:
        kept = line_of("sweep", [override for override in overrides if key_of(override) != "prompt"])
        raise UserError(f"{KEY}: expected either {KEY}= or prompt=, got both. Try: {kept}")
    return None


def sort_overrides(overrides: Sequence[str]) -> Parts:
    """Separate the overrides of jobs from those of the sweep. Raises ``UserError`` for keys of neither."""
    parts = Parts(grid=[], launcher=[], folder=[], jobs=[])
    for override in overrides:
        key = key_of(override)
        if REFUSED_KEY.match(key):
            kept = [other for other in overrides if key_of(other) not in (key, SWEEP_FOLDER)]
            line = line_of("sweep", [*kept, f"{SWEEP_FOLDER}=multirun/mine"])
            raise UserError(f"{key}: not for sweeps; their jobs share one folder. Try: {line}")
        if key == "hydra.mode":
            continue
        if key == KEY and "=" in override:
            parts.grid.append(f"{FILE}={override.partition('=')[2]}")
        elif GRID_KEY.match(key) or key == DRY_RUN:
            parts.grid.append(override)
        elif LAUNCHER_KEY.match(key):
            parts.launcher.append(override.lstrip("+") if key == "launcher" else override)
        elif key == SWEEP_FOLDER:
            parts.folder.append(override)
        else:
            parts.jobs.append(override)
    parts.grid.extend(search_path(overrides))
    return parts


def compose_all(sweep: Sweep, composer: Composer) -> list[Composed]:
    """Return the settings of every job. Raises ``RefusedJobError`` for the first one that cannot run."""
    composed = []
    for job in sweep.jobs:
        try:
            composed.append(composer.compose(job.overrides))
            _refuse_attempts(composed[-1])
        except Exception as error:
            raise RefusedJobError(job.arm, job.overrides) from error
    return composed


def _refuse_attempts(job: Composed) -> None:
    """Refuse a job that would be several attempts. A train.yaml from elsewhere may lack this setting."""
    attempts = job.values.get("attempts", 1)
    require_attempts(attempts)
    if attempts > 1:
        raise UserError(
            f"attempts: expected 1 in a sweep, whose jobs may have different seeds, got {attempts}. "
            f"Try: attempts=1 'seed=range(0,{attempts})'"
        )


def shown_keys(sweep: Sweep) -> list[str]:
    """Return the keys whose values a table of this sweep must show."""
    return list(dict.fromkeys([*ALWAYS_SHOWN, *swept_keys(sweep.grid, sweep.axes)]))


def search_path(overrides: Sequence[str]) -> list[str]:
    """Return the overrides that name more folders of YAML files."""
    return [line for line in overrides if key_of(line) == "hydra.searchpath"]


@cache
def _value(line: str) -> Any:
    return OverridesParser.create().parse_override(line).value()
