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

from omegaconf import OmegaConf

from cadam3d.core.number import COUNT, Number
from cadam3d.core.outcome import Outcome
from cadam3d.io.records import Score, read_histograms
from cadam3d.report.formatting import number
from cadam3d.settings.compose import compose, flatten
from cadam3d.settings.options import option_names
from cadam3d.sweep.folder import UNFINISHED, Row, load, numbers_of

# The other outcomes leave nothing to measure.
WITH_ASSET = (Outcome.FINISHED, Outcome.MAX_GAUSSIANS, Outcome.OUT_OF_MEMORY)
ARM, PREFIX = "densifier", "densifier."
SEED, PROMPT, NOISE, GUIDANCE, RECIPE = "seed", "prompt", "noise", "guidance", "experiment"
BASIC = (PROMPT, SEED, NOISE)  # axes of every cell


@dataclass(frozen=True)
class ArmSetting:
    """An arm, with the thresholds that the sweep varies, if there are any."""

    arm: str
    thresholds: tuple[tuple[str, float | str], ...] = ()

    @property
    def name(self) -> str:
        """Return a name such as ``cadam`` or ``baseline (tau_pos 0.001)``."""
        listed = ", ".join(f"{key} {_written(value)}" for key, value in self.thresholds)
        return f"{self.arm} ({listed})" if listed else self.arm

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
class JobResult(Row):
    """One job with the numbers it ended with."""

    setting: ArmSetting
    is_standard: bool  # every threshold has the value of the shipped configuration
    cell: Cell
    # The numbers of its asset, what their metrics have declared about them, and those that have a record of
    # how they were measured; see numbers_of.
    numbers: Mapping[str, float] = field(repr=False)
    declared: Mapping[str, Number] = field(repr=False)
    scores: Mapping[str, Score] = field(repr=False)

    @property
    def count(self) -> float:
        """Return the number of Gaussians at the end; 0 if it is unknown."""
        return self.numbers.get(COUNT.name, 0.0)

    @property
    def seconds(self) -> float | None:
        """Return the time of training; None if it is not known."""
        return number(self.summary.get("seconds"))

    @property
    def grows(self) -> bool:
        """Return whether its densifier may add Gaussians."""
        return self.summary.get("grows") is not False

    @property
    def objective(self) -> str:
        """Return the option of ``guidance`` it ran with; empty if that is not known."""
        return str(self.swept.get(GUIDANCE) or self.summary.get(GUIDANCE) or "")

    @property
    def is_measured(self) -> bool:
        """Return whether the job left an asset that may be compared."""
        return self.outcome in WITH_ASSET and self.count > 0

    @property
    def is_unfinished(self) -> bool:
        """Return whether the job waits, runs, or was killed before it could report an outcome."""
        return self.outcome == UNFINISHED

    @property
    def ended_early(self) -> bool:
        """Return whether the job stopped before its last step, so that its asset is unfinished."""
        return self.outcome != Outcome.FINISHED


def read(sweep_folder: Path) -> list[JobResult]:
    """Return every job of the sweep in ``sweep_folder``, in order, whether it is done or not.

    Raises ``UserError`` if the folder holds no sweep.
    """
    return results_of(load(sweep_folder))


def results_of(rows: Sequence[Row]) -> list[JobResult]:
    """Return the jobs with their settings and cells.

    Keys that vary within an arm are distinguished: the densifier's are thresholds, all others are axes
    of the cells. A key that only differs between arms belongs to the arm.
    """
    of_arms: dict[str, list[Row]] = {}
    for row in rows:
        of_arms.setdefault(row.arm, []).append(row)
    varied = {arm: _varied(members) for arm, members in of_arms.items()}
    axes = [key for keys in varied.values() for key in keys if not key.startswith(PREFIX)]
    return [_result(row, varied[row.arm], axes) for row in rows]


def _result(row: Row, varied: Sequence[str], axes: Sequence[str]) -> JobResult:
    known = {key: row.swept.get(key, row.summary.get(key, "")) for key in BASIC}
    known |= {key: row.swept.get(key) for key in axes}
    thresholds = {key: _threshold(row.swept.get(key)) for key in varied if key.startswith(PREFIX)}
    declared, numbers, scores = numbers_of(row)
    return JobResult(
        **vars(row),
        setting=ArmSetting(
            row.arm, tuple((key.removeprefix(PREFIX), value) for key, value in thresholds.items())
        ),
        is_standard=all(
            _threshold(_shipped(row.densifier).get(key)) == _threshold(value)
            for key, value in row.swept.items()
            if key.startswith(PREFIX)
        ),
        cell=Cell(tuple(sorted((key, str(value)) for key, value in known.items()))),
        numbers=numbers,
        declared=declared,
        scores=scores,
    )


def _threshold(value: object) -> float | str:
    as_number = number(value)
    return str(value) if as_number is None else as_number


def _varied(rows: Sequence[Row]) -> list[str]:
    """Return the keys with several values among these jobs.

    Settings that come with a prompt belong to the prompt.
    """
    brought = {key for row in rows for key in row.brought}
    keys = dict.fromkeys(key for row in rows for key in row.swept if key not in {ARM, *brought})
    return [key for key in keys if len({repr(row.swept.get(key)) for row in rows}) > 1]


def histograms(result: JobResult, score: str | None = None) -> list[dict[str, Any]]:
    """Return the lines of ``histograms.jsonl`` about one score; [] without the candidates callback.

    Bin ``i`` of a line starts at ``10 ** ((first + i) / bins_per_decade)``. ``None`` stands for the first
    score in the file, because all scores count the same population.
    """
    lines = read_histograms(result.folder)
    score = lines[0].get("score") if lines and score is None else score
    return [line for line in lines if line.get("score") == score]


def arms_of(results: Iterable[JobResult]) -> list[str]:
    """Return the arms that left something to measure, in the order of the sweep."""
    return list(dict.fromkeys(result.arm for result in measured(results)))


def levels_of(results: Iterable[JobResult]) -> list[str]:
    """Return the noise levels at which something was measured, in the order of the sweep."""
    return list(dict.fromkeys(result.cell[NOISE] for result in measured(results)))


def level_title(level: str) -> str:
    """Return the title of a panel for a noise level; empty if the sweep does not vary the noise."""
    return f"{'no' if level == 'none' else level} noise" if level else ""


def at_noise(results: Iterable[JobResult], level: str) -> list[JobResult]:
    """Return the results at one noise level."""
    return [result for result in results if result.cell[NOISE] == level]


def objective_axis(results: Iterable[JobResult]) -> str:
    """Return the key of the cells that chooses the objective: ``guidance`` if it varies."""
    return GUIDANCE if any(result.cell[GUIDANCE] for result in results) else RECIPE


def measured(results: Iterable[JobResult]) -> list[JobResult]:
    """Return the results whose count and quality may be compared."""
    return [result for result in results if result.is_measured]


@cache
def _shipped(densifier: str) -> Mapping[str, Any]:
    """Return the settings of ``configs/densifier/<densifier>.yaml`` by dotted key; empty for another one."""
    # The name may be any text, also the path of another file.
    if densifier not in option_names(ARM):
        return {}
    cfg = compose([f"{ARM}={densifier}", "prompt=any"])
    return dict(flatten(OmegaConf.to_container(cfg[ARM], resolve=True), ARM))


def _written(value: float | str) -> str:
    return value if isinstance(value, str) else f"{value:g}"
