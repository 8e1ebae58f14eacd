"""Plan: list the jobs of a sweep and compose each of them, so that mistakes show before anything runs."""

import re
from argparse import Namespace
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import InterpolationResolutionError

from cadam3d.core.checks import fail, require, require_whole
from cadam3d.core.errors import UserError
from cadam3d.io.run_folder import RUN_FOLDER, typed_path
from cadam3d.settings.advice import explain
from cadam3d.settings.check import require_effective, require_settings
from cadam3d.settings.compose import compose, flatten, value_of
from cadam3d.settings.line import DRY_RUN, LAUNCHER_KEY, SWEEP_FOLDER, key_of
from cadam3d.settings.options import with_example
from cadam3d.sweep.folder import Job
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
# In an interpolation: a reference to another setting, or the call of a function of this package.
REFERENCE = re.compile(r"\$\{(?:cadam3d\.\w+:|([A-Za-z_][\w.]*)\})")
MOST_ATTEMPTS = 1000
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
    unknown: set[str]  # keys with values that only a running job has

    def get(self, key: str) -> Any:
        """Return a value, or the option chosen of a group; None if the job has no such key."""
        return self.choices[key] if key in self.choices else self.values.get(key)


@dataclass(frozen=True)
class Sweep:
    """A sweep that a line describes, planned but not started."""

    cfg: DictConfig  # the grid, the launcher, Hydra's node
    parts: Parts  # of the line
    folder: Path  # which may not exist yet
    jobs: list[Job]
    composed: list[Composed]  # the settings of each job
    figures: list[str] | None = None  # of its report; None: all for which there are data
    paper_table: bool = False
    command: Literal["sweep", "train"] = (
        "sweep"  # of the line; "train" if the jobs are several attempts at one run
    )

    @property
    def is_dry(self) -> bool:
        """Return whether the jobs are only listed."""
        return self.cfg[DRY_RUN]

    @property
    def folder_key(self) -> str:
        """Return the setting that chooses the folder."""
        return RUN_FOLDER if self.command == "train" else SWEEP_FOLDER

    def count(self, number: int) -> str:
        """Return a number of jobs in words."""
        noun = "attempt" if self.command == "train" else "job"
        return f"1 {noun}" if number == 1 else f"{number} {noun}s"


@dataclass(frozen=True)
class Base:
    """A composed job from which other jobs differ in plain values of the same keys only."""

    cfg: DictConfig
    plain: dict[str, Any]  # by dotted key
    referring: dict[str, list[str]]  # by key of an interpolation: the keys on whose values it depends
    # What interpolations have become, by key and by the values on which they depend. OmegaConf would parse
    # each of them again for every job.
    _resolved: dict[tuple[str, ...], dict[str, Any]] = field(default_factory=dict)

    @classmethod
    def of(cls, cfg: DictConfig, varying: Collection[str]) -> "Base":
        """Return ``cfg`` with its values sorted into plain ones and interpolations, without Hydra's own.

        Jobs differ in the values of the keys ``varying``.
        """
        raw = OmegaConf.to_container(cfg, resolve=False)
        assert isinstance(raw, dict)
        raw.pop("hydra", None)
        leaves = dict(flatten(raw))
        texts = {key: str(value) for key, value in leaves.items() if "${" in str(value)}
        plain = {key: leaves[key] for key in leaves.keys() - texts.keys()}
        return cls(cfg, plain, {key: _causes(key, texts, varying) for key in texts})

    def composed(self, values: Mapping[str, Any]) -> Composed:
        """Return the job with other ``values``, set as Hydra sets them."""
        for key, value in values.items():
            OmegaConf.update(self.cfg, key, value, merge=True)
        resolved: dict[str, Any] = {}
        unknown: set[str] = set()
        for key, causes in self.referring.items():
            state = (key, *(repr(values.get(cause)) for cause in causes))
            if state not in self._resolved:
                self._resolved[state] = self._resolve(key)
            resolved |= self._resolved[state]
            unknown |= set() if self._resolved[state] else {key}
        return Composed(
            values={**self.plain, **values, **resolved},
            choices=self.cfg.hydra.runtime.choices,
            unknown=unknown,
        )

    def _resolve(self, key: str) -> dict[str, Any]:
        """Return the value of an interpolation by key; {} if only a running job has it.

        A reference to a whole part, such as ``${prompting}``, stands for all its settings.
        """
        try:
            node = OmegaConf.select(self.cfg, key)
        except InterpolationResolutionError:  # such as ${hydra:...}
            return {}
        plain = OmegaConf.to_container(node, resolve=True) if OmegaConf.is_config(node) else node
        return dict(flatten(plain, key))


def _causes(key: str, texts: Mapping[str, str], varying: Collection[str]) -> list[str]:
    """Return the keys of ``varying`` on which an interpolation depends, directly or by way of others."""
    seen, new = {key}, [key]
    causes: set[str] = set()
    while new:
        text = texts[new.pop()]
        references = REFERENCE.findall(text)
        if len(references) < text.count("${"):
            return list(varying)
        for one in filter(None, references):
            causes |= {each for each in varying if _overlap(each, one)}
            more = {each for each in texts if _overlap(each, one)} - seen
            seen |= more
            new += more
    return sorted(causes)


def _overlap(one: str, other: str) -> bool:
    """Return whether two dotted keys are equal, or one is a part of the other."""
    return f"{one}.".startswith(f"{other}.") or f"{other}.".startswith(f"{one}.")


class Composer:
    """Composes many lines of ``cadam3d train`` quickly.

    Hydra needs a sixth of a second for one line, and most jobs of a sweep differ in plain values only. Lines
    that choose the same parts and set the same keys are therefore composed only once.
    """

    def __init__(self, options: Namespace, common: Sequence[str]) -> None:
        self._options, self._common = options, list(common)
        self._bases: dict[tuple[str, ...], Base] = {}
        self._keys: dict[tuple[str, ...], list[str]] = {}  # settings and groups, by overrides
        self._leaves = self._base([]).plain.keys()

    def compose(self, overrides: Sequence[str]) -> Composed:
        """Return the settings under ``overrides``. Raises if they cannot be composed or lack a value."""
        # An override that chooses an option, or replaces a part, is no value of the composed job.
        lines = {key_of(line): line for line in overrides if self._may_be_value(line)}
        while not lines.keys() <= (base := self._base_without(lines.values(), overrides)).plain.keys():
            lines = {key: line for key, line in lines.items() if key in base.plain}
        composed = base.composed({key: value_of(line) for key, line in lines.items()})
        require_settings(composed.values)
        return composed

    def has(self, overrides: Sequence[str], key: str) -> bool:
        """Return whether a job under ``overrides`` has a setting or a group called ``key``."""
        # Which settings there are does not depend on plain values.
        arm = tuple(line for line in overrides if not self._may_be_value(line))
        if arm not in self._keys:
            base = self._base(arm)
            self._keys[arm] = [*base.plain, *base.referring, *base.cfg.hydra.runtime.choices]
        return any(f"{known}.".startswith(f"{key}.") for known in self._keys[arm])

    def _may_be_value(self, line: str) -> bool:
        """Return whether an override may set a plain value, and surely chooses no option."""
        return bool(VALUE.match(line)) and ("." in (key := key_of(line)) or key in self._leaves)

    def _base_without(self, values: Collection[str], overrides: Sequence[str]) -> Base:
        """Return a job under ``overrides`` that differs from others in ``values``, composed only once."""
        known = tuple(key_of(line) if line in values else line for line in overrides)
        if known not in self._bases:
            base = self._base(overrides, [key_of(line) for line in values])
            require_effective(base.cfg, "sweep", overrides)
            self._bases[known] = base
        return self._bases[known]

    def _base(self, overrides: Sequence[str], varying: Collection[str] = ()) -> Base:
        return Base.of(compose([*self._common, *overrides], "train", self._options), varying)


def read_sweep(overrides: Sequence[str], options: Namespace) -> Sweep:
    """Return the sweep that a line describes.

    Raises ``UserError`` for a line with a single job or with settings that a sweep cannot have, and for the
    first job that cannot run.
    """
    parts = sort_overrides(overrides)
    cfg = compose_sweep(parts, options)
    node = cfg.get("grid")
    grid = read_grid(None if node is None else OmegaConf.to_container(node, resolve=True))
    axes = read_line(parts.jobs)
    prompts = _read_prompts(cfg, grid, axes)
    if prompts is not None:
        axes = {"prompt": prompt_axis(prompts.read())} | axes
    composer = Composer(options, search_path(overrides))
    jobs = expand(grid, axes, composer.has)
    if node is None and prompts is None and len(jobs) == 1:
        raise UserError(NOTHING_TO_SWEEP)
    composed = compose_all(jobs, composer)
    # A report must know a threshold that is not the shipped one, even if all jobs share it.
    thresholds = [key for key in axes if key.startswith("densifier.")]
    keys = dict.fromkeys([*ALWAYS_SHOWN, *swept_keys(grid, axes), *thresholds])
    name = sweep_name(cfg.hydra.runtime.choices.get("grid"), axes, prompts)
    return Sweep(
        cfg=cfg,
        parts=parts,
        folder=folder_of(cfg, parts, PARENT / name),
        jobs=[
            replace(job, swept={key: settings.get(key) for key in keys})
            for job, settings in zip(jobs, composed, strict=True)
        ],
        composed=composed,
        figures=grid.figures,
        paper_table=grid.paper_table,
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


def require_attempts(attempts: object) -> None:
    """Raise ``UserError`` for a wrong value of the setting ``attempts``."""
    require_whole("attempts", attempts, low=1, high=MOST_ATTEMPTS)


def search_path(overrides: Sequence[str]) -> list[str]:
    """Return the overrides that name more folders of YAML files."""
    return [line for line in overrides if key_of(line) == "hydra.searchpath"]
