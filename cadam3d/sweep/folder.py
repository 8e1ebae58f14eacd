"""The folder of a sweep: ``jobs.json`` lists its jobs, and the folder of each job shows its progress.

Nothing is remembered elsewhere. Whatever way a sweep ends, its state is what can be read from the disk.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from cadam3d.core.errors import UserError
from cadam3d.core.outcome import Outcome
from cadam3d.io.jsonl import read_json, write_json
from cadam3d.io.run_folder import JOBS, has_checkpoint, read_summary

UNFINISHED = "unfinished"  # the outcome of a job that waits, runs, or has ended without a summary
RESULTS = (Outcome.FINISHED, Outcome.MAX_GAUSSIANS, Outcome.VANISHED, Outcome.OUT_OF_MEMORY)


@dataclass(frozen=True)
class PlannedJob:
    """A job that a sweep has to run."""

    arm: str  # of the grid; "" without one
    folder: str  # inside the sweep's
    overrides: list[str]  # of ``cadam3d train``
    swept: dict[str, Any]  # the values of the keys in which jobs of this sweep differ; always prompt and seed


@dataclass(frozen=True)
class Plan:
    """The content of ``jobs.json``: all that a worker has to know about a sweep."""

    cwd: str  # the folder in which the line was typed; its relative paths start there
    flags: list[str]  # of every job, such as --config-dir
    threads: int | None  # OpenMP threads of a job; None: the default of its machine
    jobs: list[PlannedJob]
    figures: list[str] | None = None  # of the report; None: all that the jobs have data for
    line: list[str] = field(default_factory=list)  # what was typed after ``cadam3d sweep``


@dataclass(frozen=True)
class Row:
    """One job and its result so far."""

    number: int
    arm: str
    folder: Path
    overrides: list[str]
    swept: dict[str, Any]
    summary: dict[str, Any] = field(repr=False)  # {} where there is none yet

    @property
    def outcome(self) -> str:
        """An :class:`~cadam3d.core.outcome.Outcome`, or ``unfinished``."""
        return self.summary.get("outcome", UNFINISHED)

    @property
    def has_result(self) -> bool:
        """Return whether the job is done; running out of memory is a result, being killed is not."""
        return self.outcome in RESULTS and is_complete(self.summary)

    @property
    def has_checkpoint(self) -> bool:
        """Return whether the job can continue from a checkpoint."""
        return has_checkpoint(self.folder)


def load(sweep: Path) -> list[Row]:
    """Return every job of the sweep in the folder ``sweep``, in order, with its results on disk now.

    Tables and figures are made from this: ``row.folder`` is the folder of a run, and ``row.swept`` has the
    values in which the jobs differ. Raises ``UserError`` if ``sweep`` is not the folder of a sweep.
    """
    return rows_of(sweep, read_plan(sweep).jobs)


def rows_of(sweep: Path, jobs: Sequence[PlannedJob]) -> list[Row]:
    """Return the state of ``jobs`` on disk. They may never have run."""
    return [
        Row(
            number=number,
            arm=job.arm,
            folder=sweep / job.folder,
            overrides=job.overrides,
            swept=job.swept,
            summary=read_summary(sweep / job.folder),
        )
        for number, job in enumerate(jobs)
    ]


def is_sweep(folder: Path) -> bool:
    """Return whether ``folder`` is the folder of a sweep."""
    return (folder / JOBS).is_file()


def read_plan(sweep: Path) -> Plan:
    """Return the plan of a sweep. Raises ``UserError`` if the folder has none that can be read."""
    content = read_json(sweep / JOBS)
    try:
        return Plan(**{**content, "jobs": [PlannedJob(**job) for job in content["jobs"]]})
    except (TypeError, KeyError) as error:
        raise UserError(
            f"{sweep / JOBS}: not the plan of a sweep ({error}). Try: the command of the sweep again"
        ) from error


def write_plan(sweep: Path, plan: Plan) -> None:
    """Write ``jobs.json``."""
    write_json(sweep / JOBS, asdict(plan))


def is_complete(summary: dict[str, Any]) -> bool:
    """Return whether training has written its whole summary, of which ``warnings`` is the last entry."""
    return "warnings" in summary


def outcomes(rows: Sequence[Row]) -> dict[str, int]:
    """Return how often each outcome occurred among the jobs without a result."""
    left = [row.outcome for row in rows if not row.has_result]
    return {outcome: left.count(outcome) for outcome in dict.fromkeys(left)}
