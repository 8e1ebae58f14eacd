"""The folder of a sweep: ``jobs.json`` lists its jobs, and the folder of each job shows its progress.

No state is kept elsewhere. However a sweep ends, its state can be read from this folder.
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from cadam3d.core.errors import UserError
from cadam3d.core.number import Number
from cadam3d.core.outcome import Outcome
from cadam3d.io.jsonl import is_number, read_json, to_json, write_json
from cadam3d.io.records import (
    Score,
    declared,
    latest_scores,
    read_evaluation,
    read_quality,
    read_summary,
)
from cadam3d.io.run_folder import JOBS, has_checkpoint

# The outcome of a job that waits, runs, or has ended without a summary.
UNFINISHED = "unfinished"
# The arm of a job without a grid of which no densifier is known.
UNNAMED = "default"
# Bytes of a file name, in almost every file system.
LONGEST_NAME = 255
RESULTS = (Outcome.FINISHED, Outcome.MAX_GAUSSIANS, Outcome.VANISHED, Outcome.OUT_OF_MEMORY)


@dataclass(frozen=True)
class Job:
    """One run of a sweep."""

    arm: str  # of the grid; without a grid, the densifier
    name: str  # of its folder; depends only on its arm and its settings
    overrides: list[str]  # of ``cadam3d train``
    # The prompt, the seed, and the values of all other keys in which jobs of this sweep differ.
    swept: dict[str, Any] = field(default_factory=dict)
    # What the file or the set of prompts says about the prompt; "" if it says nothing.
    prompt_name: str = ""
    category: str = ""
    brought: list[str] = field(default_factory=list)  # keys of the settings that come with the prompt


@dataclass(frozen=True)
class Plan:
    """The content of ``jobs.json``: everything that a worker needs to run a job of the sweep."""

    cwd: str  # to which the paths in the line are relative
    flags: list[str]  # of every job, such as --config-dir
    threads: int | None  # OpenMP threads of a job; None: the default of its machine
    jobs: list[Job]
    figures: list[str] | None = None  # of the report; None: all for which there are data
    line: list[str] = field(default_factory=list)  # what was typed after ``cadam3d COMMAND``
    paper_table: bool = False  # whether the paper's table 1 is made of its jobs
    command: Literal["sweep", "train"] = (
        "sweep"  # of the line; "train" if the jobs are several attempts at one run
    )


@dataclass(frozen=True, kw_only=True)
class Row(Job):
    """A job with its result so far."""

    number: int
    folder: Path
    summary: dict[str, Any] = field(repr=False)  # {} if there is none yet

    @property
    def densifier(self) -> str:
        """Return the name of its densifier; empty if that is not known."""
        return str(self.swept.get("densifier") or self.summary.get("densifier", ""))

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


def rows_of(sweep: Path, jobs: Sequence[Job]) -> list[Row]:
    """Return ``jobs`` with their results on disk. Jobs that have never started have an empty summary."""
    rows = [
        Row(**vars(job), number=number, folder=sweep / job.name, summary=read_summary(sweep / job.name))
        for number, job in enumerate(jobs)
    ]
    # The plan of an earlier version has no arm for a job without a grid.
    return [row if row.arm else replace(row, arm=row.densifier or UNNAMED) for row in rows]


def numbers_of(row: Row) -> tuple[dict[str, Number], dict[str, float], dict[str, Score]]:
    """Return what is declared about the numbers of a job's asset, these numbers, and those with a record.

    Those of ``eval.json`` replace those from the end of training, except that comparisons with a truth all
    come from one of the two, as in ``sweep.csv``. A number that another one replaces is left out.
    """
    evaluation = read_evaluation(row.folder, row.summary)
    known = declared(evaluation) | declared(row.summary)
    later = {
        name: value for name, value in evaluation.items() if not (name in known and known[name].needs_truth)
    }
    sources = ({**row.summary, **read_quality(row.folder, row.summary)}, later)
    merged = {name: each[name] for each in sources for name in known if name in each}
    found = {name: float(value) for name, value in merged.items() if is_number(value)}
    replaced = {known[name].replaces for name in found}
    values = {name: value for name, value in found.items() if name not in replaced}
    return known, values, latest_scores(sources)


def is_sweep(folder: Path) -> bool:
    """Return whether ``folder`` is the folder of a sweep."""
    return (folder / JOBS).is_file()


def write_plan(sweep: Path, plan: Plan) -> None:
    """Write ``jobs.json`` atomically."""
    write_json(sweep / JOBS, asdict(plan))


def read_plan(sweep: Path) -> Plan:
    """Return the plan of a sweep. Raises ``UserError`` if the folder has none that can be read."""
    from pydantic import TypeAdapter  # takes a tenth of a second to load

    text = to_json(read_json(sweep / JOBS))
    try:
        plan = TypeAdapter(Plan).validate_json(text, strict=True)
        if r"\u0000" in text or not all(_is_name(job.name) for job in plan.jobs):
            raise ValueError("a job outside the folder of the sweep")
    except ValueError as error:
        reason = " ".join(str(error).split())[:200]
        raise UserError(
            f"{sweep / JOBS}: not the plan of a sweep ({reason}). Try: cadam3d sweep --help"
        ) from error
    return plan


def is_complete(summary: Mapping[str, Any]) -> bool:
    """Return whether training has written its whole summary, of which ``warnings`` is the last entry."""
    return "warnings" in summary


def _is_name(name: str) -> bool:
    """Return whether a text names a folder. A path that leads elsewhere would let the sweep write there."""
    is_plain = name not in ("", ".", "..") and not set("/\\") & set(name)
    return is_plain and len(os.fsencode(name)) <= LONGEST_NAME
