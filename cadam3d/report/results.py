"""Results: the jobs of a sweep as tidy records, each with its setting and its cell.

A *setting* is an arm (a choice of ``densifier``) with its thresholds. A *cell* is everything else: prompt,
seed, noise, objective and whatever other key the sweep varies. The jobs of one cell start from the same
Gaussians and see the same views and noise, so settings are compared within cells.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from cadam3d.core.number import COUNT, Number
from cadam3d.core.outcome import Outcome
from cadam3d.io.records import (
    Score,
    declared,
    latest_scores,
    read_config,
    read_evaluation,
    read_histograms,
    read_quality,
)
from cadam3d.io.run_folder import CONFIG
from cadam3d.report.formatting import number
from cadam3d.settings.compose import compose, flatten
from cadam3d.settings.options import option_names
from cadam3d.sweep.folder import UNFINISHED, load

# The other outcomes leave nothing to measure.
WITH_ASSET = (Outcome.FINISHED, Outcome.MAX_GAUSSIANS, Outcome.OUT_OF_MEMORY)
ARM, PREFIX = "densifier", "densifier."
SEED, PROMPT, NOISE, GUIDANCE, RECIPE = "seed", "prompt", "noise", "guidance", "experiment"
NO_NOISE = "none"  # the level whose gradients have no noise
NOISE_ORDER = (NO_NOISE, "weak", "medium", "strong")  # other levels follow in alphabetical order


@dataclass(frozen=True)
class ArmSetting:
    """An arm and those of its thresholds that the sweep varies, if there are any."""

    arm: str
    thresholds: tuple[tuple[str, float | str], ...] = ()

    @property
    def name(self) -> str:
        """Return a name such as ``cadam`` or ``baseline (tau_pos 0.001)``."""
        return f"{self.arm} ({self.short})" if self.thresholds else self.arm

    @property
    def short(self) -> str:
        """Return the thresholds without the arm; empty if there are none."""
        return ", ".join(f"{key} {_written(value)}" for key, value in self.thresholds)

    @property
    def values(self) -> str:
        """Return the values of the thresholds without their names, for labels with little room."""
        return ", ".join(_written(value) for _, value in self.thresholds)

    @property
    def order(self) -> tuple:
        """Return a sorting key within an arm: by threshold, numbers before words."""
        return tuple((key, isinstance(value, str), value) for key, value in self.thresholds)


@dataclass(frozen=True, order=True)
class Cell:
    """The conditions that jobs share if they are compared with each other: sorted pairs of key and value."""

    axes: tuple[tuple[str, str], ...]

    def __getitem__(self, key: str) -> str:
        return dict(self.axes).get(key, "")

    def without(self, *keys: str) -> "Cell":
        """Return the cell without some of its axes, such as the seed."""
        return Cell(tuple(pair for pair in self.axes if pair[0] not in keys))


@dataclass(frozen=True, kw_only=True)
class JobResult:
    """One job with the numbers it ended with."""

    folder: Path
    setting: ArmSetting
    is_standard: bool  # every threshold has the value of the shipped configuration
    cell: Cell
    outcome: str
    message: str  # the reason of a failure; empty otherwise
    grows: bool  # whether its densifier may add Gaussians
    seconds: float | None
    objective: str  # the option of ``guidance`` it ran with; empty if that is not known
    category: str  # of its prompt; empty if it has none
    # The numbers of its asset, what their metrics have declared about them, and those that have a record of
    # how they were measured. Those of eval.json replace those from the end of training, except that
    # comparisons with a truth all come from one of the two, as in sweep.csv. A number that another one
    # replaces is left out.
    numbers: Mapping[str, float] = field(repr=False)
    declared: Mapping[str, Number] = field(repr=False)
    scores: Mapping[str, Score] = field(repr=False)

    @property
    def arm(self) -> str:
        """Return the arm of its setting."""
        return self.setting.arm

    @property
    def count(self) -> float | None:
        """Return the number of Gaussians at the end."""
        return self.numbers.get(COUNT.name)

    @property
    def is_measured(self) -> bool:
        """Return whether the job left an asset that may be compared."""
        return self.outcome in WITH_ASSET and bool(self.count)

    @property
    def is_unfinished(self) -> bool:
        """Return whether the job waits, runs, or was killed before it could report an outcome."""
        return self.outcome == UNFINISHED

    @property
    def ended_early(self) -> bool:
        """Return whether the job stopped before its last step, so that its asset is unfinished."""
        return self.outcome != Outcome.FINISHED


@dataclass(frozen=True)
class _KnownJob:
    """A job with its overrides parsed, before it is known which keys the sweep varies."""

    arm: str
    folder: Path
    overrides: Mapping[str, Any]  # key to value
    summary: Mapping[str, Any]
    outcome: str
    category: str

    @property
    def densifier(self) -> str:
        return str(self.overrides.get(ARM, self.summary.get(ARM, "")))


def read(sweep_folder: Path) -> list[JobResult]:
    """Return every job of the sweep in ``sweep_folder``, in order, whether it is done or not.

    Keys that vary within an arm are distinguished: those of the densifier are thresholds, all others are axes
    of the cells. A key that only differs between arms belongs to the arm. Raises ``UserError`` if
    the folder holds no sweep.
    """
    jobs = [_known(job) for job in load(sweep_folder)]
    arms = {job.arm: [other for other in jobs if other.arm == job.arm] for job in jobs}
    varied = {arm: _varied(members) for arm, members in arms.items()}
    axes = dict.fromkeys(key for keys in varied.values() for key in keys if not key.startswith(PREFIX))
    thresholds = {arm: [key for key in keys if key.startswith(PREFIX)] for arm, keys in varied.items()}
    return [_result(job, thresholds[job.arm], list(axes)) for job in jobs]


def _known(job: Any) -> _KnownJob:
    """Return a job of :func:`cadam3d.sweep.folder.load` with its overrides parsed.

    Without a grid the arm of a job has no name; it is then the densifier. Settings that come with a prompt
    are left out: they belong to the prompt, and arms without such a setting are compared too.
    """
    pairs = (_pair(str(line)) for line in job.overrides)
    overrides = {key: value for key, value in pairs if key not in job.brought}
    known = _KnownJob(job.arm, job.folder, overrides, job.summary, str(job.outcome), job.category)
    return known if job.arm else _KnownJob(**{**vars(known), "arm": known.densifier or "default"})


def _result(job: _KnownJob, thresholds: Sequence[str], axes: Sequence[str]) -> JobResult:
    shipped = _shipped(job.densifier)
    summary = {**job.summary, **read_quality(job.folder, job.summary)}
    # Whether a comparison with a truth comes from training or from eval.json is the same for all tables.
    evaluation = read_evaluation(job.folder, job.summary)
    known = declared(evaluation) | declared(job.summary)
    evaluation = {
        name: value for name, value in evaluation.items() if name not in known or not known[name].needs_truth
    }
    sources = (summary, evaluation)
    given = {key: value for key, value in job.overrides.items() if key.startswith(PREFIX)}
    return JobResult(
        folder=job.folder,
        setting=ArmSetting(
            job.arm, tuple((key.removeprefix(PREFIX), _value(job, key, shipped)) for key in thresholds)
        ),
        is_standard=all(_same(shipped.get(key.removeprefix(PREFIX)), value) for key, value in given.items()),
        cell=_cell(job, axes),
        outcome=job.outcome,
        message=str(job.summary.get("message") or ""),
        grows=summary.get("grows") is not False,
        seconds=number(summary.get("seconds")),
        objective=str(job.overrides.get(GUIDANCE) or job.summary.get(GUIDANCE) or ""),
        category=job.category,
        numbers=_numbers(sources, known),
        declared=known,
        scores=latest_scores(sources),
    )


def _numbers(sources: Iterable[Mapping[str, Any]], known: Mapping[str, Number]) -> dict[str, float]:
    """Return the declared numbers, later sources first, without those that another one replaces."""
    merged = {name: number(each[name]) for each in sources for name in known if name in each}
    found = {name: value for name, value in merged.items() if value is not None}
    replaced = {known[name].replaces for name in found}
    return {name: value for name, value in found.items() if name not in replaced}


def _cell(job: _KnownJob, axes: Sequence[str]) -> Cell:
    known = {key: job.overrides.get(key, job.summary.get(key, "")) for key in (PROMPT, SEED)}
    known[NOISE] = job.overrides.get(NOISE, "")
    known |= {key: job.overrides.get(key, "default") for key in axes if key not in known}
    return Cell(tuple(sorted((key, str(value)) for key, value in known.items())))


def _value(job: _KnownJob, key: str, shipped: Mapping[str, Any]) -> float | str:
    value = job.overrides.get(key, shipped.get(key.removeprefix(PREFIX)))
    as_number = number(value)
    return str(value) if as_number is None else as_number


def _same(one: object, other: object) -> bool:
    return one == other or (number(one) is not None and number(one) == number(other))


def _varied(jobs: Sequence[_KnownJob]) -> list[str]:
    """Return the keys with several values among these jobs, one of which may be the default."""
    keys = dict.fromkeys(key for job in jobs for key in job.overrides if key != ARM)
    return [key for key in keys if len({repr(job.overrides.get(key)) for job in jobs}) > 1]


# The lines of a sweep's jobs repeat, and the parser takes milliseconds for each.
@cache
def _pair(line: str) -> tuple[str, Any]:
    override = OverridesParser.create().parse_override(line)
    return override.get_key_element().lstrip("+~"), override.value()


@dataclass(frozen=True)
class Histogram:
    """One score of one population: bin ``i`` starts at ``10 ** ((first + i) / bins_per_decade)``."""

    step: float
    bins_per_decade: int
    first: int
    counts: list[int]
    selected: list[int]


def histograms(result: JobResult, score: str | None = None) -> list[Histogram]:
    """Return the histograms of one score by step; [] if the job ran without the candidates callback.

    ``None`` stands for the first score in the file, because all scores count the same population.
    """
    lines = read_histograms(result.folder)
    score = lines[0].get("score") if lines and score is None else score
    return [
        Histogram(*(line[key] for key in ("step", "bins_per_decade", "first", "counts", "selected")))
        for line in lines
        if line.get("score") == score
    ]


def config(result: JobResult) -> dict[str, Any]:
    """Return all settings that a job ran with; {} if it failed before they were known."""
    path = result.folder / CONFIG
    return read_config(path) if path.is_file() else {}


def arms_of(results: Iterable[JobResult]) -> list[str]:
    """Return the arms that left something to measure, in the order of the sweep."""
    return list(dict.fromkeys(result.arm for result in measured(results)))


def levels_of(results: Iterable[JobResult]) -> list[str]:
    """Return the noise levels at which something was measured."""
    return in_noise_order(result.cell[NOISE] for result in measured(results))


def level_title(level: str) -> str:
    """Return the title of a panel for a noise level; empty if the sweep does not vary the noise."""
    if level == NO_NOISE:
        return "no noise"
    return f"{level} noise" if level else ""


def in_noise_order(levels: Iterable[str]) -> list[str]:
    """Return the noise levels from none to strong, each once."""
    position = {level: i for i, level in enumerate(NOISE_ORDER)}
    return sorted(set(levels), key=lambda level: (position.get(level, len(position)), level))


def at_noise(results: Iterable[JobResult], level: str) -> list[JobResult]:
    """Return the results at one noise level."""
    return [result for result in results if result.cell[NOISE] == level]


def objective_axis(results: Iterable[JobResult]) -> str:
    """Return the key of the cells that chooses the objective.

    That is ``experiment`` if recipes vary and ``guidance`` does not.
    """
    results = list(results)
    varies = {key: any(result.cell[key] for result in results) for key in (GUIDANCE, RECIPE)}
    return RECIPE if varies[RECIPE] and not varies[GUIDANCE] else GUIDANCE


def measured(results: Iterable[JobResult]) -> list[JobResult]:
    """Return the results whose count and quality may be compared."""
    return [result for result in results if result.is_measured]


@cache
def _shipped(arm: str) -> Mapping[str, Any]:
    """Return the settings of ``configs/densifier/<arm>.yaml`` by dotted key; empty for an arm from elsewhere.

    A setting that has keys, such as a schedule, is there as a whole too: an override may replace it by a
    number.
    """
    # The name of an arm may be any text, also the path of another file.
    if arm not in option_names(ARM):
        return {}
    node = compose([f"{ARM}={arm}", "prompt=any"])[ARM]
    plain = OmegaConf.to_container(node, resolve=True)
    assert isinstance(plain, dict)
    return dict(flatten(plain, with_nodes=True))


def _written(value: float | str) -> str:
    return value if isinstance(value, str) else f"{value:g}"
