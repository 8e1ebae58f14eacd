"""Subject: what a page shows, which is a run (finished, training, or neither) or a single file.

Every answer is read from the files at the moment of the question, so a page follows a run that begins or ends
while it is open. A stranger may have written the folder: no link in it is followed, and numbers are checked.
"""

import re
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, Generic, TypeVar

from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.io import live
from cadam3d.io.declarations import read_declarations
from cadam3d.io.jsonl import is_whole
from cadam3d.io.lock import holder_name, is_held
from cadam3d.io.reading import open_contained, open_regular, signature
from cadam3d.io.records import psnr_of, read_config, read_metrics, read_summary
from cadam3d.io.run_folder import (
    ASSET,
    CHARTS,
    CONFIG,
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
    setting_word,
    shown,
)
from cadam3d.live.curves import curves_of, drawn
from cadam3d.viewer.pack import pack

LARGEST_SNAPSHOT = 1 << 30  # bytes; ten million Gaussians of SH degree 3 have less
MOST_SAVED = 100  # files that a page lists
CURVES = ("num_gaussians", "seconds", "loss")  # entries of both the log and the live state
# Files of a run that the page, or the report, offers under their own names.
OFFERED = (ASSET, CONFIG, METRICS, PREVIEW, SUMMARY, TURNTABLE)

Version = tuple[int, int, int, int]
Value = TypeVar("Value")


@dataclass
class Kept(Generic[Value]):
    """A value that is computed from a file, and again only if the file has changed."""

    open: Callable[[], BinaryIO]
    read: Callable[[], Value]
    _version: Version | None = field(default=None, init=False)
    _value: Value | None = field(default=None, init=False)

    def version(self) -> Version | None:
        """Return what identifies the content of the file; None if it cannot be opened."""
        return version_of(self.open)

    def get(self) -> Value | None:
        """Return the value; None if the file cannot be read."""
        version = self.version()
        if version is None:
            return None
        if version != self._version:
            try:
                self._value = self.read()
            except UserError:
                self._value = None
            self._version = version
        return self._value

    def load(self) -> None:
        """Compute the value now. Raises ``UserError`` if the file cannot be read."""
        self._value, self._version = self.read(), self.version()


@dataclass
class ShownFile:
    """A file of Gaussians; :class:`ShownRun` adds everything that only a run has.

    The methods change what is kept, so a thread calls them while it holds ``turns``.
    """

    place: Path  # the file, or the folder of the run
    read: Callable[[], Gaussians]  # raises UserError if the Gaussians cannot be read
    turns: threading.Lock = field(default_factory=threading.Lock, init=False)

    def __post_init__(self) -> None:
        self._packed = Kept(lambda: open_regular(self.place), lambda: pack(self.read()))

    def load(self) -> None:
        """Read the Gaussians now. Raises ``UserError`` if there are none that can be read."""
        self._packed.load()

    def state(self) -> dict[str, Any]:
        """Return what the page shows beside the picture, as plain data."""
        picture = _name(self._packed.version())
        return {"kind": "file", "status": "idle", "title": self.place.name, "picture": picture}

    def picture(self) -> bytes | None:
        """Return the packed Gaussians; None if there are none."""
        return self._packed.get()

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

    def __post_init__(self) -> None:
        self._packed = Kept(partial(self._open, ASSET), lambda: pack(self.read()))
        self._curves = Kept(partial(self._open, METRICS), lambda: curves_of(read_metrics(self.place)))
        self._summary = Kept(partial(self._open, SUMMARY), lambda: read_summary(self.place))
        self._config = Kept(partial(self._open, CONFIG), lambda: read_config(self.place / CONFIG))
        self._declared = Kept(partial(self._open, CHARTS), lambda: read_declarations(self.place))

    def load(self) -> None:
        """Read the asset now, unless there is something else to show. Raises ``UserError``."""
        if not is_held(self.place / LOCK) and self._version(LIVE_SNAPSHOT) is None:
            self._packed.load()

    def state(self) -> dict[str, Any]:
        """Return what the page shows beside the picture, and tell the run that a page is open."""
        is_writable = live.touch_watched(self.place)
        config, now, curves = self._config.get() or {}, self._live(), self._curves.get() or {}
        title, total = config.get("prompt"), config.get("steps")
        log = {key: curves[key][-1][1] if curves.get(key) else None for key in CURVES}
        log["step"] = max((points[-1][0] for points in curves.values() if points), default=0)
        facts = {
            "kind": "run",
            "title": title if isinstance(title, str) else self.place.name,
            "resume": f"cadam3d train {setting_word('resume', shown(self.place))}",
            "picture": _name(self._version(LIVE_SNAPSHOT if self._shows_snapshot(now) else ASSET)),
            "charts": f"{_name(self._curves.version())} {_name(self._declared.version())}",
            "saved": self._saved(),
            "has_asset": self._version(ASSET) is not None,
            "has_report": self._version(REPORT) is not None,
            "total_steps": total if is_whole(total) else None,
        }
        if now is not None:
            status = "ending" if now["has_ended"] else "paused" if now["is_paused"] else "training"
            asked = [request for request in live.REQUESTS if live.is_asked(self.place, request)]
            # The log may be ahead, because the process writes its numbers for open pages only.
            newest = now | log if log["step"] > now["step"] else log | now
            return facts | newest | {"status": status, "asked": asked, "is_writable": is_writable}
        facts |= log
        if is_held(self.place / LOCK):
            return facts | {"status": "busy"}
        summary = self._summary.get() or {}
        done = {key: summary.get(key) for key in ("num_gaussians", "seconds", "outcome")}
        done |= {"step": summary.get("steps"), "psnr": psnr_of(summary)}
        known = {key: value for key, value in done.items() if value is not None}
        return facts | {"status": "idle"} | known

    def picture(self) -> bytes | None:
        """Return the snapshot of a run that trains, else the packed asset; None if there is none."""
        if not self._shows_snapshot(self._live()):
            return self._packed.get()
        try:
            with self._open(LIVE_SNAPSHOT) as file:
                return file.read(LARGEST_SNAPSHOT)
        except (OSError, UserError):
            return None

    def charts(self) -> list[dict[str, Any]]:
        """Return the curves of the run, as it has declared them."""
        return drawn(self._curves.get() or {}, self._declared.get() or ())

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
            return self._open(files[name]) if name in files else None
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

    def _open(self, name: str) -> BinaryIO:
        return open_contained(self.place, name)

    def _version(self, name: str) -> Version | None:
        return version_of(partial(self._open, name))


def version_of(opener: Callable[[], BinaryIO]) -> Version | None:
    """Return what identifies the content of a file; None if it cannot be opened."""
    try:
        with opener() as file:
            return signature(file)
    except (OSError, UserError, ValueError):
        return None


def _name(version: Version | None) -> str | None:
    return None if version is None else "-".join(map(str, version))
