"""The folder of a sweep: ``jobs.json`` says what belongs to it, and each job's folder how far that job is.

Nothing else is remembered, so the truth survives any way to end: whoever asks reads it from the disk.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from cadam3d.core.errors import UserError
from cadam3d.core.outcome import Outcome
from cadam3d.io.jsonl import read_json, write_json

JOBS = "jobs.json"  # the mark of a sweep
STOP = ".stop"  # while this is there, running jobs save and end, and no further one starts
LOCK = ".lock"  # held while a sweep runs
TRACED = "traces"  # what jobs that look at the same scene from the same places share, while the sweep runs
ENDED = "job.json"  # in the folder of a job whose process has ended
SUMMARY = "summary.json"  # of a run
CONSOLE = "console.txt"  # what the process of a job said
UNFINISHED = "unfinished"  # the outcome of a job that waits, runs, or ended without a word
RESULTS = (Outcome.FINISHED, Outcome.MAX_GAUSSIANS, Outcome.VANISHED, Outcome.OUT_OF_MEMORY)


@dataclass(frozen=True)
class PlannedJob:
    """What one job is to run."""

    arm: str  # of the grid; "" without one
    folder: str  # inside the sweep's
    overrides: list[str]  # of ``cadam3d train``
    swept: dict[str, Any]  # the values of the keys in which jobs of this sweep differ; always prompt and seed


@dataclass(frozen=True)
class Plan:
    """What a sweep is to run, as ``jobs.json`` holds it."""

    cwd: str  # where the line was typed: what its relative paths start from
    flags: list[str]  # of every job, such as --config-dir
    threads: int | None  # OpenMP threads of a job; None: whatever its machine finds right
    jobs: list[PlannedJob]
    figures: list[str] | None = None  # of the report; None: whatever the jobs have data for
    line: list[str] = field(default_factory=list)  # what was typed after ``cadam3d sweep``


@dataclass(frozen=True)
class Row:
    """One job and what became of it."""

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
        """Whether the job is done. Running out of memory is a result; being killed or interrupted is none."""
        return self.outcome in RESULTS and is_complete(self.summary)

    @property
    def has_checkpoint(self) -> bool:
        """Whether the job can go on where it was."""
        return any((self.folder / "checkpoints").glob("step_*.pt"))


def load(sweep: Path) -> list[Row]:
    """Every job of the sweep in the folder ``sweep``, in order, with what is on disk of it now.

    Tables and figures are made of this: ``row.folder`` holds ``metrics.jsonl``, ``asset.ply`` and the other
    files of a run, ``row.swept`` the values that jobs differ in. Raises ``UserError`` if ``sweep`` is none.
    """
    return rows_of(sweep, read_plan(sweep).jobs)


def rows_of(sweep: Path, jobs: Sequence[PlannedJob]) -> list[Row]:
    """What is on disk of ``jobs``, which may never have run."""
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
    """Whether ``folder`` holds a sweep."""
    return (folder / JOBS).is_file()


def read_plan(sweep: Path) -> Plan:
    """The plan of a sweep. Raises ``UserError`` if there is none that can be read."""
    content = read_json(sweep / JOBS)
    try:
        return Plan(**{**content, "jobs": [PlannedJob(**job) for job in content["jobs"]]})
    except (TypeError, KeyError) as error:
        raise UserError(
            f"{sweep / JOBS}: not the plan of a sweep ({error}). Try: the line of the sweep again"
        ) from error


def write_plan(sweep: Path, plan: Plan) -> None:
    """Write ``jobs.json``."""
    write_json(sweep / JOBS, asdict(plan))


def read_summary(job: Path) -> dict[str, Any]:
    """The facts of a job; {} if there are none, or none that can be read."""
    try:
        summary = read_json(job / SUMMARY)
    except UserError:
        return {}
    return summary if isinstance(summary, dict) else {}


def is_complete(summary: dict[str, Any]) -> bool:
    """Whether training has told all: it writes its numbers first, its ``warnings`` after all else."""
    return "warnings" in summary


def outcomes(rows: Sequence[Row]) -> dict[str, int]:
    """How often each outcome occurred among the jobs without a result."""
    left = [row.outcome for row in rows if not row.has_result]
    return {outcome: left.count(outcome) for outcome in dict.fromkeys(left)}
