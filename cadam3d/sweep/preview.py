"""Preview: list the jobs of a sweep and estimate how long they will take, without running the sweep.

The estimate is based on the jobs of the same sweep that have a result already. Without any, the first job is
run for some seconds in a temporary folder.
"""

import sys
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from cadam3d.core.errors import UserError
from cadam3d.io.jsonl import read_json
from cadam3d.io.run_folder import CONFIG, ENDED, STOP
from cadam3d.sweep.folder import Plan, Row, load, write_plan
from cadam3d.sweep.process import run_job
from cadam3d.sweep.table import aligned, brief, varying_keys
from cadam3d.sweep.watch import duration, result

MEASURED_SECONDS = 10.0  # of training
STARTING_SECONDS = 300.0  # at most, until training begins
POLL_SECONDS = 0.2


@dataclass(frozen=True)
class Pace:
    """The time that a job takes: a part for each step, and a part for its start and its outputs."""

    step_seconds: float
    other_seconds: float

    def seconds(self, steps: float) -> float:
        """Return the seconds of a job of that many steps."""
        return self.other_seconds + steps * self.step_seconds


def listing(rows: Sequence[Row]) -> str:
    """Return a table of the jobs: arm, settings in which they differ, what is to be done, and folder."""
    keys = varying_keys(rows)
    has_arms = any(row.arm for row in rows)
    lines = [["job", *(["arm"] if has_arms else []), *keys, "state", "folder"]]
    for row in rows:
        values = [row.number, *([row.arm] if has_arms else []), *(brief(row.swept.get(key)) for key in keys)]
        lines.append([*values, _state(row), row.folder.name])
    return aligned(lines)


def estimate(
    rows: Sequence[Row], steps: Sequence[float], plan: Plan, side_by_side: int | None, scratch: Path
) -> str:
    """Return how long the jobs without a result will take, in a sentence that says what this is based on.

    ``steps`` are those of each job, and ``side_by_side`` is how many jobs run at once; None if that is not
    known. ``scratch`` is an empty folder for a measurement, which a mark to stop in it ends early.
    """
    pending = [row for row in rows if not row.has_result]
    if not pending:
        return "Every job has a result, so there is nothing left to run."
    done = {row.number: seconds for row in rows if row.has_result and (seconds := _seconds(row))}
    if done:
        total = sum(_from_results(row, steps[row.number], rows, done) for row in pending)
        basis = f"Based on the {_jobs(len(done))} with a result."
    else:
        first = pending[0]
        steps_done, outcome, pace = _measure(plan, first.number, scratch)
        if pace is None:
            return f"No estimate: job {first.number} has not done a single step ({outcome})."
        total = sum(pace.seconds(steps[row.number]) for row in pending)
        basis = (
            f"Based on {steps_done} of the {steps[first.number]:.0f} steps of job {first.number}, which ran "
            "alone in a temporary folder; steps become slower as Gaussians are added."
        )
    return f"{_time(total, len(pending), side_by_side)} {basis}"


def _state(row: Row) -> str:
    if row.has_result:
        return f"has a result: {row.outcome}"
    return "to continue" if row.has_checkpoint else "to run"


def _time(total: float, count: int, side_by_side: int | None) -> str:
    if side_by_side is None:
        return f"About {duration(total)} of computing for {_jobs(count)}, divided by how many run at once."
    at_once = min(side_by_side, count)
    how = "one after another" if at_once == 1 else f"{at_once} at a time"
    return f"About {duration(total / at_once)} for {_jobs(count)}, {how}."


def _seconds(row: Row) -> float | None:
    """Return the seconds that the process of a job took, or at least its training; None if unknown."""
    try:
        ended = read_json(row.folder / ENDED).get("seconds") if (row.folder / ENDED).is_file() else None
    except UserError:
        ended = None
    return _positive(ended) or _positive(row.summary.get("seconds"))


def _from_results(row: Row, steps: float, rows: Sequence[Row], done: Mapping[int, float]) -> float:
    """Return the mean time of the jobs of the same arm, or of all jobs, each scaled to ``steps``."""
    of_arm = [other for other in rows if other.number in done and other.arm == row.arm]
    others = of_arm or [other for other in rows if other.number in done]
    shares = [steps / (_positive(other.summary.get("steps_asked")) or steps) for other in others]
    times = [done[other.number] * share for other, share in zip(others, shares, strict=True)]
    return sum(times) / len(times)


def _measure(plan: Plan, number: int, scratch: Path) -> tuple[int, str, Pace | None]:
    """Run one job for some seconds; return its steps, its result in words, and its pace, None if unknown."""
    print(f"Measuring job {number} for about {MEASURED_SECONDS:.0f} s ...", file=sys.stderr, flush=True)
    write_plan(scratch, replace(plan, jobs=[replace(plan.jobs[number], folder="job")]))
    is_over = threading.Event()
    thread = threading.Thread(target=_stop_later, args=(scratch, is_over), daemon=True)
    thread.start()
    try:
        run_job(scratch, 0)
    finally:
        is_over.set()
        thread.join()
    [row] = load(scratch)
    steps, training = _positive(row.summary.get("steps")), _positive(row.summary.get("seconds"))
    if steps is None or training is None:
        return 0, result(row.summary), None
    other = max((_seconds(row) or training) - training, 0.0)
    return round(steps), result(row.summary), Pace(training / steps, other)


def _stop_later(scratch: Path, is_over: threading.Event) -> None:
    """Stop the job when it has trained long enough, or if it does not begin to train."""
    # The configuration is written right before the first step.
    started, begun = time.monotonic(), None
    while not is_over.wait(POLL_SECONDS):
        now = time.monotonic()
        if begun is None and (scratch / "job" / CONFIG).is_file():
            begun = now
        if now >= (started + STARTING_SECONDS if begun is None else begun + MEASURED_SECONDS):
            (scratch / STOP).touch()
            return


def _positive(value: Any) -> float | None:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return float(value) if is_number and 0 < value < float("inf") else None


def _jobs(count: int) -> str:
    return "1 job" if count == 1 else f"{count} jobs"
