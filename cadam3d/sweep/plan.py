"""Plan: list the jobs of a sweep and compose each of them, so that mistakes show before anything runs."""

import re
from argparse import Namespace
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from omegaconf import DictConfig, OmegaConf, open_dict

from cadam3d.core.checks import fail, require
from cadam3d.core.errors import UserError
from cadam3d.io.run_folder import RUN_FOLDER, typed_path
from cadam3d.settings.advice import explain
from cadam3d.settings.check import require_effective, require_settings
from cadam3d.settings.compose import compose, flatten, value_of
from cadam3d.settings.line import DRY_RUN, LAUNCHER_KEY, SWEEP_FOLDER, Line, key_of
from cadam3d.settings.options import with_example
from cadam3d.sweep.folder import UNNAMED, Job, Plan
from cadam3d.sweep.grid import (
    ALWAYS_SHOWN,
    Axes,
    Grid,
    expand,
    prompt_axis,
    read_grid,
    read_line,
    sweep_name,
    swept_keys,
)
from cadam3d.sweep.prompts import FILE, KEY, PromptChoice, read_choice

PARENT = Path("multirun")
# An override that is neither an addition nor a deletion, names no package and refers to no other setting.
VALUE = re.compile(r"[A-Za-z_][\w.]*=(?!.*\$\{)", re.DOTALL)
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

    @property
    def own(self) -> list[str]:
        """Return the overrides of the sweep itself."""
        return [*self.grid, *self.launcher, *self.folder]


@dataclass(frozen=True)
class Composed:
    """The settings that a job would run with."""

    values: dict[str, Any]  # by dotted key
    choices: Mapping[str, Any]  # by group

    def get(self, key: str) -> Any:
        """Return a value, or the option chosen of a group; None if the job has no such key."""
        return self.choices[key] if key in self.choices else self.values.get(key)


@dataclass(frozen=True)
class Sweep:
    """A sweep that a line describes, planned but not started."""

    line: Line
    cfg: DictConfig  # the grid, the launcher, Hydra's node
    parts: Parts  # of the line
    folder: Path  # which may not exist yet
    plan: Plan
    composed: list[Composed]  # the settings of each job

    @property
    def is_dry(self) -> bool:
        """Return whether the jobs are only listed."""
        return self.cfg[DRY_RUN]

    @property
    def folder_key(self) -> str:
        """Return the setting that chooses the folder."""
        return RUN_FOLDER if self.plan.command == "train" else SWEEP_FOLDER

    def count(self, number: int) -> str:
        """Return a number of jobs in words."""
        noun = "attempt" if self.plan.command == "train" else "job"
        return f"1 {noun}" if number == 1 else f"{number} {noun}s"


class Base:
    """A composed job from which other jobs differ in plain values of its settings only."""

    def __init__(self, cfg: DictConfig) -> None:
        """Keep ``cfg``, which has Hydra's own node."""
        with open_dict(cfg):
            self.choices: Mapping[str, Any] = cfg.pop("hydra").runtime.choices
        self._cfg = cfg
        # All settings by dotted key; an interpolation is text.
        self.leaves = dict(flatten(OmegaConf.to_container(cfg, resolve=False)))
        self._referring = {key: str(value) for key, value in self.leaves.items() if "${" in str(value)}
        self._plain = {key: value for key, value in self.leaves.items() if key not in self._referring}
        # What interpolations refer to, apart from the names of functions.
        self._words = set(re.findall(r"\w+", " ".join(self._referring.values())))
        # What interpolations have become, by the values on which they depend. OmegaConf would parse each of
        # them again for every job.
        self._resolved: dict[tuple[str, ...], dict[str, Any]] = {}

    def composed(self, values: Mapping[str, Any], overrides: Sequence[str]) -> Composed:
        """Return the job with other ``values``, which the ``overrides`` of the job set.

        Raises ``UserError`` if a setting has no value, or an override no effect.
        """
        causes = [key for key in values if key.partition(".")[0] in self._words]
        state = (*sorted(values), *(repr(values[key]) for key in causes))
        if state not in self._resolved:
            self._resolved[state] = self._resolve(values, overrides)
        return Composed({**self._plain, **self._resolved[state], **values}, self.choices)

    def _resolve(self, values: Mapping[str, Any], overrides: Sequence[str]) -> dict[str, Any]:
        """Return the values of all interpolations by key.

        A reference to a whole part, such as ``${prompting}``, stands for all its settings.
        """
        cfg = self._cfg.copy()
        for key, value in values.items():
            OmegaConf.update(cfg, key, value)
        require_effective(cfg, "sweep", overrides)
        found: dict[str, Any] = {}
        for key in self._referring.keys() - values.keys():
            node = OmegaConf.select(cfg, key)
            plain = OmegaConf.to_container(node, resolve=True) if OmegaConf.is_config(node) else node
            found |= flatten(plain, key)
        return found


class Composer:
    """Composes many lines of ``cadam3d train`` quickly.

    Hydra needs a sixth of a second for one line, and most jobs of a sweep differ in plain values only. Lines
    that choose the same parts are therefore composed only once.
    """

    def __init__(self, options: Namespace, common: Sequence[str]) -> None:
        self._options, self._common = options, list(common)
        self._bases: dict[tuple[str, ...], Base] = {}

    def compose(self, overrides: Sequence[str]) -> Composed:
        """Return the settings under ``overrides``. Raises if they cannot be composed or lack a value."""
        settings = self._base(self._parts(overrides)).leaves
        values = {key_of(line): value_of(line) for line in overrides if VALUE.match(line)}
        # An override that chooses an option, or replaces a part, is no value of the composed job.
        values = {key: each for key, each in values.items() if key in settings and not isinstance(each, dict)}
        base = self._base(line for line in overrides if key_of(line) not in values)
        composed = base.composed(values, overrides)
        require_settings(composed.values)
        return composed

    def has(self, overrides: Sequence[str], key: str) -> bool:
        """Return whether a job under ``overrides`` has a setting or a group called ``key``."""
        base = self._base(self._parts(overrides))
        return any(f"{known}.".startswith(f"{key}.") for known in (*base.leaves, *base.choices))

    def _parts(self, overrides: Sequence[str]) -> list[str]:
        """Return the overrides that may choose parts of a job; which settings it has depends on no others."""
        values = self._base(()).leaves
        return [
            line
            for line in overrides
            if not VALUE.match(line) or ("." not in (key := key_of(line)) and key not in values)
        ]

    def _base(self, overrides: Iterable[str]) -> Base:
        """Return the job under ``overrides``, composed only once."""
        known = tuple(overrides)
        if known not in self._bases:
            self._bases[known] = Base(compose([*self._common, *known], "train", self._options))
        return self._bases[known]


def read_sweep(line: Line) -> Sweep:
    """Return the sweep that a line describes.

    Raises ``UserError`` for a line with a single job or with settings that a sweep cannot have, and for the
    first job that cannot run.
    """
    parts = sort_overrides(line.overrides)
    cfg = compose_sweep(parts, line.options)
    node = cfg.get("grid")
    grid = read_grid(None if node is None else OmegaConf.to_container(node, resolve=True))
    axes = read_line(parts.jobs)
    prompts = _read_prompts(cfg, grid, axes)
    if prompts is not None:
        axes = {"prompt": prompt_axis(prompts.read())} | axes
    composer = Composer(line.options, search_path(line.overrides))
    jobs = expand(grid, axes, composer.has)
    if node is None and prompts is None and len(jobs) == 1:
        raise UserError(NOTHING_TO_SWEEP)
    composed = compose_all(jobs, composer)
    # A report must know a threshold that is not the shipped one, even if all jobs share it.
    thresholds = [key for key in axes if key.startswith("densifier.")]
    keys = dict.fromkeys([*ALWAYS_SHOWN, *swept_keys(grid, axes), *thresholds])
    jobs = [
        replace(job, swept={key: settings.get(key) for key in keys})
        for job, settings in zip(jobs, composed, strict=True)
    ]
    plan = plan_of(line, jobs, composed, "sweep", grid.figures, grid.paper_table)
    name = sweep_name(cfg.hydra.runtime.choices.get("grid"), axes, prompts)
    return Sweep(line, cfg, parts, folder_of(cfg, parts, PARENT / name), plan, composed)


def plan_of(
    line: Line,
    jobs: list[Job],
    composed: Sequence[Composed],
    command: Literal["sweep", "train"],
    figures: list[str] | None,
    paper_table: bool = False,
) -> Plan:
    """Return what a worker needs to run ``jobs``, before the number of their threads is known.

    Jobs without a grid get an arm: the densifier that they are ``composed`` with.
    """
    arms = [
        job.arm or str(each.get("densifier") or UNNAMED) for job, each in zip(jobs, composed, strict=True)
    ]
    name = line.options.config_name
    flags = [*line.config_flags, *(["--config-name", name] if name else [])]
    return Plan(
        cwd=str(Path.cwd()),
        flags=flags,
        threads=None,
        jobs=[replace(job, arm=arm) for job, arm in zip(jobs, arms, strict=True)],
        figures=figures,
        line=[*flags, *line.words],
        paper_table=paper_table,
        command=command,
    )


def compose_sweep(parts: Parts, options: Namespace) -> DictConfig:
    """Return the settings of a sweep itself, which are its grid, its launcher and Hydra's node.

    Raises ``UserError`` for wrong values, and Hydra's exceptions.
    """
    # The flag --config-name is for the jobs and not for the sweep itself.
    cfg = compose(parts.own, "sweep", Namespace(**{**vars(options), "config_name": None}))
    # A wrong setting of the launcher is found now, and not when the jobs are there.
    OmegaConf.to_container(cfg.hydra.launcher, resolve=True)
    is_answer = isinstance(cfg[DRY_RUN], bool)
    require(is_answer, DRY_RUN, expected="true or false", got=cfg[DRY_RUN], example=f"{DRY_RUN}=true")
    return cfg


def folder_of(cfg: DictConfig, parts: Parts, usual: Path) -> Path:
    """Return the folder that a line chooses for a sweep, or else the ``usual`` one."""
    text = OmegaConf.select(cfg, SWEEP_FOLDER) if parts.folder else str(usual)
    if not text:
        raise fail(SWEEP_FOLDER, expected="a folder", got=text, example=f"{SWEEP_FOLDER}=multirun/mine")
    return typed_path(str(text))


def _read_prompts(cfg: DictConfig, grid: Grid, axes: Axes) -> PromptChoice | None:
    """Return the choice of prompts of a line or its grid. A prompt in the line replaces the grid's prompts.

    Raises ``UserError`` if the line has both a prompt and a choice of prompts.
    """
    node = cfg.get(KEY)
    choice = None if node is None else OmegaConf.to_container(node, resolve=True)
    assert choice is None or isinstance(choice, dict), "the line gives a file, not this node"
    if "prompt" not in axes:
        return read_choice(choice, grid.prompts)
    if read_choice(choice, None) is not None:
        raise fail(KEY, expected=f"either {KEY}= or prompt=", got="both", example=f"{KEY}=paper50")
    return None


def sort_overrides(overrides: Sequence[str]) -> Parts:
    """Separate the overrides of jobs from the sweep's own. Raises ``UserError`` for keys of neither."""
    parts = Parts(grid=search_path(overrides), launcher=[], folder=[], jobs=[])
    for override in overrides:
        key = key_of(override)
        if REFUSED_KEY.match(key):
            raise fail(key, expected=SWEEP_FOLDER, got=key, example=f"{SWEEP_FOLDER}=multirun/mine")
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
    return parts


def compose_all(jobs: Sequence[Job], composer: Composer) -> list[Composed]:
    """Return the settings of every job. Raises ``UserError`` for the first one that cannot run."""
    composed = []
    for job in jobs:
        try:
            composed.append(composer.compose(job.overrides))
            # A train.yaml from elsewhere may lack this setting.
            attempts, example = composed[-1].values.get("attempts", 1), "attempts=1 'seed=range(0,3)'"
            require(attempts == 1, "attempts", expected="1 in a sweep", got=attempts, example=example)
        except Exception as error:
            if (reason := explain(error, "train", job.overrides)) is None:
                raise
            arm = f"arm {job.arm}: " if job.arm else ""
            raise UserError(f"{arm}{with_example(reason)}") from error
    return composed


def search_path(overrides: Sequence[str]) -> list[str]:
    """Return the overrides that name more folders of YAML files."""
    return [line for line in overrides if key_of(line) == "hydra.searchpath"]
