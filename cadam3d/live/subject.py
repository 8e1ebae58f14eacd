"""Subject: what a page shows, which is a run (finished, training, or neither) or a single file.

Every answer is read from the files at the moment of the question, so a page follows a run that begins or ends
while it is open. A stranger may have written the folder: no link in it is followed, and numbers are checked.
"""

import re
import threading
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

from cadam3d.core.chart import Chart
from cadam3d.core.errors import UserError
from cadam3d.io import live
from cadam3d.io.asset_file import read_gaussians
from cadam3d.io.declarations import GAUSSIANS, LOSS, read_declarations
from cadam3d.io.jsonl import is_number, is_whole
from cadam3d.io.lock import holder_name, is_held
from cadam3d.io.reading import open_contained, signature
from cadam3d.io.records import psnr_of, read_config, read_metrics, read_summary
from cadam3d.io.run_folder import (
    ASSET,
    CHARTS,
    CONFIG,
    HYDRA_SETTINGS,
    LIVE_SNAPSHOT,
    LOCK,
    METRICS,
    PREVIEW,
    REPORT,
    SAVED,
    SAVED_PATTERN,
    SUMMARY,
    TURNTABLE,
    saved_name,
)
from cadam3d.settings.line import continuing
from cadam3d.viewer.pack import pack

LARGEST_SNAPSHOT = 1 << 30  # bytes; ten million Gaussians of SH degree 3 have less
MOST_SAVED = 100  # files that a page lists
MOST_SENT = 500  # points of a curve
CURVES = ("num_gaussians", "seconds", "loss")  # entries of both the log and the live state
# Files of a run that the page, or the report, offers under their own names.
OFFERED = (ASSET, CONFIG, METRICS, PREVIEW, SUMMARY, TURNTABLE)

Points = list[tuple[int, float]]  # steps, ascending, and values


@dataclass
class ShownFile:
    """A file of Gaussians; :class:`ShownRun` adds everything that only a run has.

    The methods change what is kept, so a thread calls them while it holds ``turns``.
    """

    place: Path  # the file, or the folder of the run
    packed: bytes | None = None  # the Gaussians of the file
    turns: threading.Lock = field(default_factory=threading.Lock, init=False)

    def state(self) -> dict[str, Any]:
        """Return what the page shows beside the picture, as plain data."""
        return {"kind": "file", "status": "idle", "title": self.place.name, "picture": "file"}

    def picture(self) -> bytes | None:
        """Return the packed Gaussians; None if there are none."""
        return self.packed

    def charts(self) -> list[dict[str, Any]]:
        """Return the charts of the page, as plain data."""
        return []

    def ask(self, request: str, process: str) -> bool:
        """Pass a request on to the process that trains. Return False if that is impossible."""
        return False

    def offered(self, name: str) -> BinaryIO | None:
        """Open the file that the page offers under ``name``; None if there is none."""
        return None


@dataclass
class ShownRun(ShownFile):
    """A run. It is live if a process holds the lock of its folder and has written the state in ``live/``."""

    # The version of each file that was read, and what was made of it.
    _kept: dict[str, tuple[str, Any]] = field(default_factory=dict, init=False)

    def state(self) -> dict[str, Any]:
        """Return what the page shows beside the picture, and tell the run that a page is open."""
        is_writable = live.touch_watched(self.place)
        is_at_work = is_held(self.place / LOCK)  # and what it has made before is not its result
        config = self._keep(CONFIG, lambda: read_config(self.place / CONFIG)) or {}
        now, curves = self._live(), self._curves()
        title, total = config.get("prompt"), config.get("steps")
        log = {key: curves[key][-1][1] if curves.get(key) else None for key in CURVES}
        log["step"] = max((points[-1][0] for points in curves.values() if points), default=0)
        facts = {
            "kind": "run",
            "title": title if isinstance(title, str) else self.place.name,
            "resume": self._keep(HYDRA_SETTINGS, lambda: continuing(self.place)),
            "picture": self._version(LIVE_SNAPSHOT if self._shows_snapshot(now) else ASSET),
            "charts": f"{self._version(METRICS)} {self._version(CHARTS)}",
            "saved": self._saved(),
            "has_asset": not is_at_work and self._version(ASSET) is not None,
            "has_report": not is_at_work and self._version(REPORT) is not None,
            "total_steps": total if is_whole(total) else None,
        }
        if now is not None:
            status = "ending" if now["has_ended"] else "paused" if now["is_paused"] else "training"
            asked = [request for request in live.REQUESTS if live.is_asked(self.place, request)]
            # The log may be ahead, because the process writes its numbers for open pages only.
            newest = now | log if log["step"] > now["step"] else log | now
            return facts | newest | {"status": status, "asked": asked, "is_writable": is_writable}
        facts |= log
        if is_at_work:
            return facts | {"status": "busy"}
        summary = self._keep(SUMMARY, lambda: read_summary(self.place)) or {}
        done = {key: summary.get(key) for key in ("num_gaussians", "seconds", "outcome")}
        done |= {"step": summary.get("steps"), "psnr": psnr_of(summary)}
        known = {key: value for key, value in done.items() if value is not None}
        return facts | {"status": "idle"} | known

    def picture(self) -> bytes | None:
        """Return the snapshot of a run that trains, else the packed asset; None if there is none."""
        if not self._shows_snapshot(self._live()):
            return self._keep(ASSET, lambda: pack(read_gaussians(self.place / ASSET)))
        try:
            with open_contained(self.place, LIVE_SNAPSHOT) as file:
                return file.read(LARGEST_SNAPSHOT)
        except (OSError, UserError):
            return None

    def charts(self) -> list[dict[str, Any]]:
        """Return the curves of the run, as it has declared them."""
        return drawn(self._curves(), self._keep(CHARTS, lambda: read_declarations(self.place)) or ())

    def ask(self, request: str, process: str) -> bool:
        """Pass a request on, unless another process has taken the place of ``process``."""
        now = self._live()
        if now is None or now["process"] != process:
            return False
        if request == "resume":
            return live.withdraw(self.place, "pause")
        return live.ask(self.place, request)

    def offered(self, name: str) -> BinaryIO | None:
        """Open ``report``, ``saved/STEP`` or one of ``OFFERED``; None if it is missing or behind a link."""
        step = re.fullmatch(r"saved/([0-9]{1,12})", name)
        files = {"report": REPORT, **{each: each for each in OFFERED}}
        if step is not None:
            files[name] = f"{SAVED}/{saved_name(int(step.group(1)))}"
        try:
            return open_contained(self.place, files[name]) if name in files else None
        except (OSError, UserError):
            return None

    def _live(self) -> dict[str, Any] | None:
        """Return the state of the process that trains; None if none does, or not with ``callback=live``."""
        if not is_held(self.place / LOCK) or (now := live.read_state(self.place)) is None:
            return None
        # A killed process leaves its state behind, and the next one needs a while before it removes that.
        return now if holder_name(self.place / LOCK) in (None, now["process"]) else None

    def _shows_snapshot(self, now: dict[str, Any] | None) -> bool:
        # Without an asset, what a killed run has left is better than nothing.
        return now is not None or self._version(ASSET) is None

    def _saved(self) -> list[int]:
        """Return the steps of the newest assets that users have saved, in order."""
        folder = self.place / SAVED
        try:
            names = [] if folder.is_symlink() else [path.name for path in folder.iterdir()]
        except OSError:
            return []
        steps = [int(found.group(1)) for name in names if (found := re.fullmatch(SAVED_PATTERN, name))]
        return sorted(steps)[-MOST_SAVED:]

    def _curves(self) -> dict[str, Points]:
        return self._keep(METRICS, lambda: curves_of(read_metrics(self.place))) or {}

    def _keep(self, name: str, read: Callable[[], Any]) -> Any:
        """Return what ``read`` makes of a file, which is read again if it changes; None if that fails."""
        version = self._version(name)
        if version is None:
            return None
        if name not in self._kept or self._kept[name][0] != version:
            try:
                self._kept[name] = version, read()
            except UserError:
                self._kept[name] = version, None
        return self._kept[name][1]

    def _version(self, name: str) -> str | None:
        """Return what identifies the content of a file; None if it cannot be opened."""
        try:
            with open_contained(self.place, name) as file:
                return "-".join(map(str, signature(file)))
        except (OSError, UserError, ValueError):
            return None


def curves_of(lines: Iterable[Mapping[str, Any]]) -> dict[str, Points]:
    """Return the points of every number in the lines of a log."""
    found: dict[str, Points] = defaultdict(list)
    for line in lines:
        values = {**line, **line.get("statistics", {})}
        if line["kind"] == "refine":
            values = {**line.get("statistics", {}), "num_gaussians": line.get("after")}
        for key, value in values.items():
            # A step counts the Gaussians before its refinement, whose line comes first.
            is_later = not found[key] or found[key][-1][0] < line["step"]
            if is_number(value) and is_later:
                found[key].append((line["step"], value))
    return found


def drawn(curves: Mapping[str, Points], charts: Sequence[Chart]) -> list[dict[str, Any]]:
    """Return the common charts and ``charts``, with their numbers so far, as plain data."""

    def sent(key: str) -> Points:
        points = curves.get(key, [])
        every = -(-len(points) // MOST_SENT) or 1
        return points[:-1:every] + points[-1:]

    return [
        {
            **{name: getattr(chart, name) for name in ("title", "caption", "log_y", "percent", "band_label")},
            "band": [{"key": key, "points": sent(key)} for key in chart.band or ()],
            "curves": [{**vars(curve), "points": sent(curve.key)} for curve in chart.curves],
        }
        for chart in (GAUSSIANS, LOSS, *charts)
    ]
