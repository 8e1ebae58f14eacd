"""Rows: the jobs of a sweep as tidy records, each with its setting and its cell.

A *setting* is an arm (a choice of ``densifier``) with its thresholds. A *cell* is everything else: prompt,
seed, noise, objective and whatever other key the sweep varies. The jobs of one cell start from the same
Gaussians and see the same views and noise, so settings are compared within cells.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import yaml
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from cadam3d.io.jsonl import read_json, read_jsonl
from cadam3d.report.page import number
from cadam3d.settings.compose import compose, config_dir, flatten

UNFINISHED = "unfinished"  # the outcome of a job that is running, or that was killed
COMPLETE = "finished"
WITH_ASSET = (COMPLETE, "max_gaussians", "out_of_memory")  # the others left nothing to measure
PLAN, LINES = "jobs.json", ".hydra/overrides.yaml"  # how sweeps remember their jobs, and what a job was told
ARM, PREFIX = "densifier", "densifier."
SEED, PROMPT, NOISE, GUIDANCE = "seed", "prompt", "noise", "guidance"
NO_NOISE = ("none", "photometric")  # the levels whose gradients have no noise
NOISE_ORDER = (*NO_NOISE, "weak", "medium", "strong")  # other levels follow, by name


@dataclass(frozen=True)
class Setting:
    """An arm and the thresholds that the sweep varies in it; none where it varies none."""

    arm: str
    thresholds: tuple[tuple[str, float | str], ...] = ()

    @property
    def name(self) -> str:
        """Such as ``cadam`` or ``baseline (tau_pos 0.001)``."""
        return f"{self.arm} ({self.short})" if self.thresholds else self.arm

    @property
    def short(self) -> str:
        """The thresholds alone; empty if there are none."""
        return ", ".join(f"{key} {_written(value)}" for key, value in self.thresholds)

    @property
    def values(self) -> str:
        """The values of the thresholds without their names, for a label where there is no room."""
        return ", ".join(_written(value) for _, value in self.thresholds)

    @property
    def order(self) -> tuple:
        """What settings are sorted by: arm, then thresholds, numbers before words."""
        return (self.arm, *((key, isinstance(value, str), value) for key, value in self.thresholds))


@dataclass(frozen=True, order=True)
class Cell:
    """What the jobs that are compared with one another share, as sorted pairs of key and value."""

    axes: tuple[tuple[str, str], ...]

    def __getitem__(self, key: str) -> str:
        return dict(self.axes).get(key, "")

    def without(self, *keys: str) -> "Cell":
        """The cell with some axes left out, such as the seed."""
        return Cell(tuple(pair for pair in self.axes if pair[0] not in keys))


@dataclass(frozen=True, kw_only=True)
class Row:
    """One job."""

    folder: Path
    setting: Setting
    is_standard: bool  # every threshold has the value of the shipped configuration
    cell: Cell
    outcome: str
    message: str  # why it failed; empty otherwise
    count: float | None  # Gaussians at the end
    initial: float | None  # Gaussians at the start
    psnr: float | None  # dB
    ssim: float | None
    mib: float | None  # size of asset.ply
    seconds: float | None
    steps: float | None

    @property
    def arm(self) -> str:
        """The arm of its setting."""
        return self.setting.arm

    @property
    def is_measured(self) -> bool:
        """Whether it left an asset whose count and quality may be compared."""
        return self.outcome in WITH_ASSET and bool(self.count) and self.psnr is not None

    @property
    def ended_early(self) -> bool:
        """Whether it stopped before its last step: its numbers are those of an unfinished asset."""
        return self.outcome != COMPLETE


def read(sweep_folder: Path) -> list[Row]:
    """The rows of every job that the sweep in ``sweep_folder`` has, in order, done or not."""
    plan = sweep_folder / PLAN
    if plan.is_file():
        planned = read_json(plan)["jobs"]
        return rows_of([_job(sweep_folder / j["folder"], j["overrides"], j["arm"]) for j in planned])
    folders = sorted((path.parent.parent for path in sweep_folder.glob(f"*/{LINES}")), key=_order)
    return rows_of([_job(folder, _lines(folder / LINES)) for folder in folders])


@dataclass(frozen=True)
class Job:
    """What is known of a job by itself, before it is known what the sweep varies."""

    arm: str
    folder: Path
    overrides: Mapping[str, Any]  # what its line said: key to value
    summary: Mapping[str, Any]


def rows_of(jobs: Sequence[Job]) -> list[Row]:
    """Rows, once all jobs are known.

    What varies within an arm makes the difference: a key of the densifier is a threshold there, any other key
    an axis of the cells. What only tells arms apart belongs to the arm.
    """
    arms = {job.arm: [other for other in jobs if other.arm == job.arm] for job in jobs}
    varied = {arm: _varied(members) for arm, members in arms.items()}
    axes = dict.fromkeys(key for keys in varied.values() for key in keys if not key.startswith(PREFIX))
    thresholds = {arm: [key for key in keys if key.startswith(PREFIX)] for arm, keys in varied.items()}
    shipped = {name: _shipped(name) for name in {_densifier(job) for job in jobs}}
    return [_row(job, thresholds[job.arm], list(axes), shipped[_densifier(job)]) for job in jobs]


def _row(job: Job, thresholds: Sequence[str], axes: Sequence[str], shipped: Mapping[str, Any]) -> Row:
    summary = job.summary
    numbers = {key: number(value) for key, value in summary.items()}
    size = numbers.get("asset_bytes")
    told = {key: value for key, value in job.overrides.items() if key.startswith(PREFIX)}
    return Row(
        folder=job.folder,
        setting=Setting(
            job.arm, tuple((key.removeprefix(PREFIX), _value(job, key, shipped)) for key in thresholds)
        ),
        is_standard=all(_same(shipped.get(key.removeprefix(PREFIX)), value) for key, value in told.items()),
        cell=_cell(job, axes),
        outcome=str(summary.get("outcome", UNFINISHED)),
        message=str(summary.get("message") or ""),
        count=numbers.get("num_gaussians"),
        initial=numbers.get("num_gaussians_initial"),
        psnr=numbers.get("psnr"),
        ssim=numbers.get("ssim"),
        mib=size / (1 << 20) if size is not None else None,
        seconds=numbers.get("seconds"),
        steps=numbers.get("steps"),
    )


def _cell(job: Job, axes: Sequence[str]) -> Cell:
    known = {key: job.overrides.get(key, job.summary.get(key, "")) for key in (PROMPT, SEED)}
    known[NOISE] = job.overrides.get(NOISE, "")
    known |= {key: job.overrides.get(key, "default") for key in axes if key not in known}
    return Cell(tuple(sorted((key, str(value)) for key, value in known.items())))


def _value(job: Job, key: str, shipped: Mapping[str, Any]) -> float | str:
    value = job.overrides.get(key, shipped.get(key.removeprefix(PREFIX)))
    as_number = number(value)
    return str(value) if as_number is None else as_number


def _same(one: object, other: object) -> bool:
    return one == other or (number(one) is not None and number(one) == number(other))


def _varied(jobs: Sequence[Job]) -> list[str]:
    """The keys of which these jobs have several values, one of which may be that of the configuration."""
    keys = dict.fromkeys(key for job in jobs for key in job.overrides if key != ARM)
    return [key for key in keys if len({repr(job.overrides.get(key)) for job in jobs}) > 1]


def _densifier(job: Job) -> str:
    return str(job.overrides.get(ARM, job.summary.get(ARM, "")))


def _job(folder: Path, lines: Sequence[str], arm: str = "") -> Job:
    """One job; without a name for its arm, that is the choice of its densifier."""
    summary = folder / "summary.json"
    job = Job(
        arm=arm,
        folder=folder,
        overrides=_parsed(lines),
        summary=read_json(summary) if summary.is_file() else {"outcome": UNFINISHED},
    )
    return replace(job, arm=arm or _densifier(job) or "default")


def _parsed(lines: Sequence[str]) -> dict[str, Any]:
    return dict(_pair(str(line)) for line in lines)


@cache  # the lines of a sweep's jobs repeat, and the parser takes milliseconds for each
def _pair(line: str) -> tuple[str, Any]:
    override = OverridesParser.create().parse_override(line)
    return override.get_key_element().lstrip("+~"), override.value()


def counts(row: Row) -> list[tuple[float, float]]:
    """Steps and Gaussians of a job over time; a refinement is two points at its step, before and after."""
    points: list[tuple[float, int, float]] = []
    for line in read_jsonl(row.folder / "metrics.jsonl"):
        step = number(line.get("step"))
        for key, order in (("num_gaussians", 0), ("before", 0), ("after", 1)):
            value = number(line.get(key))
            if step is not None and value is not None:
                points.append((step, order, value))
    return [(step, value) for step, _, value in sorted(points)]


@dataclass(frozen=True)
class Histogram:
    """One score of one population: bin ``i`` starts at ``10 ** ((first + i) / bins_per_decade)``."""

    step: float
    bins_per_decade: int
    first: int
    counts: list[int]
    selected: list[int]


def histograms(row: Row, score: str | None = None) -> list[Histogram]:
    """What the candidates callback counted of one score, in order of steps; [] without that callback.

    ``None`` is the first score there is: all of them count the same population.
    """
    lines = read_jsonl(row.folder / "candidates/histograms.jsonl")
    score = lines[0].get("score") if lines and score is None else score
    return [
        Histogram(*(line[key] for key in ("step", "bins_per_decade", "first", "counts", "selected")))
        for line in lines
        if line.get("score") == score
    ]


def config(row: Row) -> dict[str, Any]:
    """All settings that a job ran with; {} if it failed before it knew them."""
    path = row.folder / "config.yaml"
    return (yaml.safe_load(path.read_text(encoding="utf-8")) or {}) if path.is_file() else {}


def _written(value: float | str) -> str:
    return value if isinstance(value, str) else f"{value:g}"


def in_noise_order(levels: Iterable[str]) -> list[str]:
    """Noise levels from none to strong, each once."""
    position = {level: i for i, level in enumerate(NOISE_ORDER)}
    return sorted(set(levels), key=lambda level: (position.get(level, len(position)), level))


def at_noise(rows: Iterable[Row], level: str) -> list[Row]:
    """The rows of one noise level."""
    return [row for row in rows if row.cell[NOISE] == level]


def with_noise(rows: Sequence[Row]) -> Sequence[Row]:
    """The rows with noise in their gradients, of which the paper speaks; all rows where none has any."""
    return [row for row in rows if row.cell[NOISE] not in NO_NOISE] or rows


def measured(rows: Iterable[Row]) -> list[Row]:
    """The rows whose count and quality may be compared."""
    return [row for row in rows if row.is_measured]


@cache
def _shipped(arm: str) -> Mapping[str, Any]:
    """The settings of ``configs/densifier/<arm>.yaml`` by dotted key; empty for an arm from elsewhere.

    What has keys of its own, such as a schedule, is there as a whole too: a line may replace it by a number.
    """
    if not arm or not (config_dir() / ARM / f"{arm}.yaml").is_file():
        return {}
    node = compose([f"{ARM}={arm}", "prompt=any"])[ARM]
    plain = OmegaConf.to_container(node, resolve=True)
    assert isinstance(plain, dict)
    return dict(flatten(plain, with_nodes=True))


def _order(folder: Path) -> tuple[float, str]:
    head = folder.name.partition("_")[0]
    return (int(head) if head.isdigit() else math.inf, folder.name)


def _lines(path: Path) -> list[str]:
    return yaml.safe_load(path.read_text(encoding="utf-8")) or []
