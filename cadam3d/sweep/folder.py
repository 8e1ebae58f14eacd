"""The folder of a sweep: ``jobs.json`` lists its jobs, and the folder of each job shows its progress.

No state is kept elsewhere. However a sweep ends, its state can be read from this folder.
"""

import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from cadam3d.core.errors import UserError
from cadam3d.core.outcome import Outcome
from cadam3d.io.jsonl import is_whole, read_json, write_json
from cadam3d.io.records import read_summary
from cadam3d.io.run_folder import JOBS, has_checkpoint

# The outcome of a job that waits, runs, or has ended without a summary.
UNFINISHED = "unfinished"
# Bytes of a file name, in almost every file system.
LONGEST_NAME = 255
MOST_THREADS = 1 << 16
RESULTS = (Outcome.FINISHED, Outcome.MAX_GAUSSIANS, Outcome.VANISHED, Outcome.OUT_OF_MEMORY)


@dataclass(frozen=True)
class PlannedJob:
    """A job that a sweep has to run."""

    arm: str  # "" without a grid
    folder: str  # relative to that of the sweep
    overrides: list[str]  # of ``cadam3d train``
    # The prompt, the seed, and the values of all other keys in which jobs of this sweep differ.
    swept: dict[str, Any]
    # What the file or the set of prompts says about the prompt; "" if it says nothing.
    prompt_name: str = ""
    category: str = ""


@dataclass(frozen=True)
class Plan:
    """The content of ``jobs.json``: everything that a worker needs to run a job of the sweep."""

    cwd: str  # to which the paths in the line are relative
    flags: list[str]  # of every job, such as --config-dir
    threads: int | None  # OpenMP threads of a job; None: the default of its machine
    jobs: list[PlannedJob]
    figures: list[str] | None = None  # of the report; None: all for which there are data
    line: list[str] = field(default_factory=list)  # what was typed after ``cadam3d sweep``


@dataclass(frozen=True)
class Row:
    """One job and its result so far."""

    number: int
    arm: str
    folder: Path
    overrides: list[str]
    swept: dict[str, Any]
    summary: dict[str, Any] = field(repr=False)  # {} if there is none yet
    prompt_name: str = ""  # from the file or the set of prompts; "" if it gives none
    category: str = ""

    @property
    def outcome(self) -> str:
        """Return an :class:`~cadam3d.core.outcome.Outcome`, or ``unfinished``."""
        return self.summary.get("outcome", UNFINISHED)

    @property
    def has_result(self) -> bool:
        """Return whether the job is done. Lack of memory is a result; a kill or an interrupt is not."""
        return self.outcome in RESULTS and is_complete(self.summary)

    @property
    def has_checkpoint(self) -> bool:
        """Return whether the job can continue from a checkpoint."""
        return has_checkpoint(self.folder)


def load(sweep: Path) -> list[Row]:
    """Return every job of the sweep in the folder ``sweep``, in order, with its results on disk now.

    Tables and figures are made from these rows. ``row.folder`` is the folder of a run, and ``row.swept`` has
    the values in which the jobs differ. Raises ``UserError`` if ``sweep`` is not the folder of a sweep.
    """
    return rows_of(sweep, read_plan(sweep).jobs)


def rows_of(sweep: Path, jobs: Sequence[PlannedJob]) -> list[Row]:
    """Return ``jobs`` with their results on disk. Jobs that have never started have an empty summary."""
    return [
        Row(
            number=number,
            arm=job.arm,
            folder=sweep / job.folder,
            overrides=job.overrides,
            swept=job.swept,
            summary=read_summary(sweep / job.folder),
            prompt_name=job.prompt_name,
            category=job.category,
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
        _require_plan(content)
        return Plan(**{**content, "jobs": [PlannedJob(**job) for job in content["jobs"]]})
    except (TypeError, KeyError, ValueError) as error:
        reason = " ".join(str(error).split())[:200]
        raise UserError(
            f"{sweep / JOBS}: not the plan of a sweep ({reason}); the command of the sweep writes it again. "
            "Try: cadam3d sweep --help"
        ) from error


def _require_plan(content: Any) -> None:
    """Raise an exception unless every entry of a plan has the type that its class declares."""
    _require(isinstance(content, dict) and isinstance(content["jobs"], list), "jobs: expected a list")
    _require(_is_text(content["cwd"]), "cwd: expected a folder")
    threads, figures = content.get("threads"), content.get("figures")
    is_count = is_whole(threads) and 1 <= threads <= MOST_THREADS
    _require(threads is None or is_count, "threads: expected a whole number")
    _require(figures is None or _are_texts(figures), "figures: expected names")
    for name in ("flags", "line"):
        _require(_are_texts(content.get(name, [])), f"{name}: expected words")
    for job in content["jobs"]:
        _require(isinstance(job, dict) and _is_text(job["arm"]), "arm: expected a name")
        _require(_are_texts(job["overrides"]), "overrides: expected a list of key=value")
        _require(isinstance(job["swept"], dict), "swept: expected keys and values")
        for name in ("prompt_name", "category"):
            _require(_is_text(job.get(name, "")), f"{name}: expected a text")
        # A name that leads elsewhere would let the sweep write there.
        folder = job["folder"]
        is_inside = _is_text(folder) and folder not in ("", ".", "..") and not set("/\\") & set(folder)
        is_inside = is_inside and len(os.fsencode(folder)) <= LONGEST_NAME
        _require(is_inside, "folder: expected the name of a folder in that of the sweep")
    folders = [job["folder"] for job in content["jobs"]]
    _require(len(set(folders)) == len(folders), "folder: expected a different name for each job")


def _require(claim: bool, problem: str) -> None:
    if not claim:
        raise ValueError(problem)


def _is_text(value: Any) -> bool:
    return isinstance(value, str) and "\0" not in value


def _are_texts(value: Any) -> bool:
    return isinstance(value, list) and all(map(_is_text, value))


def write_plan(sweep: Path, plan: Plan) -> None:
    """Write ``jobs.json`` atomically."""
    write_json(sweep / JOBS, asdict(plan))


def is_complete(summary: dict[str, Any]) -> bool:
    """Return whether training has written its whole summary, of which ``warnings`` is the last entry."""
    return "warnings" in summary


def outcomes(rows: Sequence[Row]) -> dict[str, int]:
    """Return how often each outcome occurred among the jobs without a result."""
    left = [row.outcome for row in rows if not row.has_result]
    return {outcome: left.count(outcome) for outcome in dict.fromkeys(left)}
