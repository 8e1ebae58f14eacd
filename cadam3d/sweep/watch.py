"""Watch: print one line for each job of a running sweep that has ended, wherever it ran."""

import textwrap
import threading
import time
from collections.abc import Sequence
from typing import Any

from cadam3d.core.outcome import Outcome
from cadam3d.io.records import psnr_of, read_summary
from cadam3d.io.run_folder import ENDED
from cadam3d.sweep.folder import Row
from cadam3d.sweep.table import brief, varying_keys

POLL_SECONDS = 0.5


class Watch:
    """While this is open, a thread watches the folders of the jobs and reports those that end."""

    def __init__(self, rows: Sequence[Row], pending: Sequence[Row]) -> None:
        self._waiting = list(pending)
        self._count = len(rows)
        self._keys = varying_keys(rows)
        self._started = time.monotonic()
        self._ended = 0
        self._is_over = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> "Watch":
        # Files of an earlier attempt would be reported as new results.
        for row in self._waiting:
            (row.folder / ENDED).unlink(missing_ok=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._is_over.set()
        self._thread.join()
        self._look()

    def _watch(self) -> None:
        while not self._is_over.wait(POLL_SECONDS):
            self._look()

    def _look(self) -> None:
        for row in [row for row in self._waiting if (row.folder / ENDED).exists()]:
            self._waiting.remove(row)
            self._ended += 1
            position = f"{self._count - len(self._waiting):>{len(str(self._count))}}/{self._count}"
            news = f"{describe(row, self._keys)}: {result(read_summary(row.folder))}{self._left()}"
            print(f"[{position}] {news}", flush=True)

    def _left(self) -> str:
        if not self._waiting:
            return ""
        seconds = (time.monotonic() - self._started) / self._ended * len(self._waiting)
        return f"; about {duration(seconds)} left"


def describe(row: Row, keys: Sequence[str]) -> str:
    """Describe a job in a few words: its arm, and the settings in which it differs within that arm."""
    values = {key: row.swept[key] for key in keys if row.swept.get(key) is not None}
    parts = [brief(value) if key == "prompt" else f"{key}={brief(value)}" for key, value in values.items()]
    return ", ".join([*([row.arm] if row.arm else []), *parts]) or brief(row.swept.get("prompt"))


def result(summary: dict[str, Any]) -> str:
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
