"""Progress: the jobs of a sweep as they end, wherever they run, and the time that the others will take."""

import textwrap
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import copy_context
from typing import Any

from cadam3d.core.console import show
from cadam3d.core.outcome import Outcome
from cadam3d.io.records import psnr_of, read_summary
from cadam3d.io.run_folder import ENDED
from cadam3d.sweep.folder import Row
from cadam3d.sweep.table import brief, varying_keys

POLL_SECONDS = 0.5


@contextmanager
def reporting(rows: Sequence[Row]) -> Iterator[None]:
    """Print one line for each job that ends during the block. ``rows`` are all jobs of the sweep."""
    waiting = [row for row in rows if not row.has_result]
    # Files of an earlier attempt would be reported as new results.
    for row in waiting:
        (row.folder / ENDED).unlink(missing_ok=True)
    count, keys, started = len(waiting), varying_keys(rows), time.monotonic()
    is_over = threading.Event()

    def report() -> None:
        for row in [row for row in waiting if (row.folder / ENDED).exists()]:
            waiting.remove(row)
            left = (time.monotonic() - started) / (count - len(waiting)) * len(waiting)
            then = f"; about {duration(left)} left" if waiting else ""
            position = f"{len(rows) - len(waiting):>{len(str(len(rows)))}}/{len(rows)}"
            result = describe_result(read_summary(row.folder))
            show(f"[{position}] {describe_job(row, keys)}: {result}{then}")

    def watch() -> None:
        while not is_over.wait(POLL_SECONDS):
            report()

    # Messages of the thread go where those of the sweep go.
    thread = threading.Thread(target=copy_context().run, args=(watch,), daemon=True)
    thread.start()
    try:
        yield
    finally:
        is_over.set()
        thread.join()
        report()


def describe_job(row: Row, keys: Sequence[str]) -> str:
    """Describe a job in a few words: its arm, and the settings in which it differs within that arm."""
    values = {key: row.swept[key] for key in keys if row.swept.get(key) is not None}
    parts = [brief(value) if key == "prompt" else f"{key}={brief(value)}" for key, value in values.items()]
    return ", ".join([row.arm, *parts])


def describe_result(summary: Mapping[str, Any]) -> str:
    """Describe the result of a job in a few words."""
    outcome = summary.get("outcome", "ended without a summary")
    if message := summary.get("message"):
        return f"{outcome}: {textwrap.shorten(message, 160, placeholder=' ...')}"
    facts = [] if outcome == Outcome.FINISHED else [str(outcome)]
    if "num_gaussians" in summary:
        facts.append(f"{summary['num_gaussians']:,} Gaussians")
    if (psnr := psnr_of(summary)) is not None:
        facts.append(f"{psnr:.2f} dB")
    if "seconds" in summary:
        facts.append(f"{summary['seconds']:.0f} s")
    return ", ".join(facts)


def duration(seconds: float) -> str:
    """Return an estimated time as text, in whole seconds, whole minutes, or tenths of an hour."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    minutes = seconds / 60
    return f"{minutes:.0f} min" if minutes < 100 else f"{minutes / 60:.1f} h"
