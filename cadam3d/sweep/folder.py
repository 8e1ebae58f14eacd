"""The folder of a sweep: ``jobs.json`` lists its jobs, and the folder of each job shows its progress.

No state is kept elsewhere. However a sweep ends, its state can be read from this folder.
"""

import os
from collections.abc import Callable, Mapping, Sequence
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
class Job:
    """One run of a sweep."""

    arm: str  # "" without a grid
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
    command: str = "sweep"  # of the line; "train" if the jobs are several attempts at one run


@dataclass(frozen=True, kw_only=True)
class Row(Job):
    """A job with its result so far."""

    number: int
    folder: Path
    summary: dict[str, Any] = field(repr=False)  # {} if there is none yet

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
    folders = [sweep / job.name for job in jobs]
    return [
        Row(**vars(job), number=number, folder=folder, summary=read_summary(folder))
        for number, (job, folder) in enumerate(zip(jobs, folders, strict=True))
    ]


def is_sweep(folder: Path) -> bool:
    """Return whether ``folder`` is the folder of a sweep."""
    return (folder / JOBS).is_file()


def write_plan(sweep: Path, plan: Plan) -> None:
    """Write ``jobs.json`` atomically."""
    write_json(sweep / JOBS, asdict(plan))


def read_plan(sweep: Path) -> Plan:
    """Return the plan of a sweep. Raises ``UserError`` if the folder has none that can be read."""
    content = read_json(sweep / JOBS)
    try:
        _require_entries(content, PLAN_ENTRIES)
        for job in content["jobs"]:
            _require_entries(job, JOB_ENTRIES)
        names = [job["name"] for job in content["jobs"]]
        if len(set(names)) != len(names):
            raise ValueError("name: expected a different one for each job")
    except ValueError as error:
        raise UserError(
            f"{sweep / JOBS}: not the plan of a sweep ({error}); the command of the sweep writes it again. "
            "Try: cadam3d sweep --help"
        ) from error
    return Plan(**{**content, "jobs": [Job(**job) for job in content["jobs"]]})


def is_complete(summary: Mapping[str, Any]) -> bool:
    """Return whether training has written its whole summary, of which ``warnings`` is the last entry."""
    return "warnings" in summary


def _require_entries(content: Any, entries: Mapping[str, Callable[[Any], bool]]) -> None:
    """Raise ``ValueError`` unless ``content`` has these entries, each of its type."""
    if not isinstance(content, dict) or content.keys() != entries.keys():
        raise ValueError(f"expected the keys {', '.join(entries)}")
    for key, is_sound in entries.items():
        if not is_sound(content[key]):
            raise ValueError(f"{key}: unexpected {str(content[key])[:80]!r}")


def _is_text(value: Any) -> bool:
    return isinstance(value, str) and "\0" not in value


def _are_texts(value: Any) -> bool:
    return isinstance(value, list) and all(map(_is_text, value))


def _is_name(value: Any) -> bool:
    """Return whether a value names a folder. A path that leads elsewhere would let the sweep write there."""
    is_file_name = _is_text(value) and value not in ("", ".", "..") and not set("/\\") & set(value)
    return is_file_name and len(os.fsencode(value)) <= LONGEST_NAME


PLAN_ENTRIES: Mapping[str, Callable[[Any], bool]] = {
    "cwd": _is_text,
    "flags": _are_texts,
    "threads": lambda value: value is None or (is_whole(value) and 1 <= value <= MOST_THREADS),
    "jobs": lambda value: isinstance(value, list),
    "figures": lambda value: value is None or _are_texts(value),
    "line": _are_texts,
    "paper_table": lambda value: isinstance(value, bool),
    "command": lambda value: value in ("sweep", "train"),
}
JOB_ENTRIES: Mapping[str, Callable[[Any], bool]] = {
    "arm": _is_text,
    "name": _is_name,
    "overrides": _are_texts,
    "swept": lambda value: isinstance(value, dict),
    "prompt_name": _is_text,
    "category": _is_text,
    "brought": _are_texts,
}
