"""Live: the files through which a run that trains and the pages that show it exchange data.

They work across processes, and for all users of one file system. The folder ``live/`` exists while its run
trains. A request to the run is an empty file: its name is the whole message. It has no content that could be
damaged, any number of pages can make requests at once, and so can a shell (``touch RUN/live/pause``).
"""

import os
import stat
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Optional

from cadam3d.core.errors import UserError
from cadam3d.io.atomic import TEMPORARY
from cadam3d.io.jsonl import Real, Whole, fits, parse_json, to_json
from cadam3d.io.lock import process_name
from cadam3d.io.reading import read_bytes, regular_descriptor
from cadam3d.io.run_folder import (
    LIVE,
    LIVE_PAUSE,
    LIVE_SAVE,
    LIVE_SNAPSHOT,
    LIVE_STATE,
    LIVE_STOP,
    LIVE_WATCHED,
)

REQUESTS = {"pause": LIVE_PAUSE, "save": LIVE_SAVE, "stop": LIVE_STOP}
FILES = (*REQUESTS.values(), LIVE_SNAPSHOT, LIVE_STATE, LIVE_WATCHED)
LARGEST_STATE = 1 << 16  # bytes
# An open page touches a file about once a second. After this time without a touch, it counts as closed.
WATCHED_SECONDS = 5.0
# The kinds of the entries of state.json.
KINDS = {
    "process": str,
    **dict.fromkeys(("step", "total_steps", "num_gaussians"), Whole),
    "seconds": Real,
    "loss": Optional[Real],  # noqa: UP045  (an annotated type has no operator |)
    **dict.fromkeys(("is_paused", "has_ended"), bool),
    "statistics": dict[str, Real],
}


# --- what training does ----------------------------------------------------------------------------------


def begin(run: Path) -> None:
    """Create the empty folder ``live/`` of a run. Raises ``OSError`` if that is impossible."""
    clear(run)
    (run / LIVE).mkdir(exist_ok=True)


def clear(run: Path) -> None:
    """Remove the files of this module, and ``live/`` if it is empty then. Files with other names stay."""
    folder = run / LIVE
    with suppress(OSError):
        if is_own_folder(run):
            for path in [*(run / name for name in FILES), *folder.glob(f"{TEMPORARY}*")]:
                with suppress(OSError):
                    path.unlink()
            folder.rmdir()


def publish(path: Path, content: bytes) -> None:
    """Replace a file of ``live/`` in a single step. Raises ``OSError`` if that is impossible.

    The content need not survive a power cut, so this does not wait for the disk.
    """
    temporary = path.with_name(f"{TEMPORARY}{os.getpid()}-{path.name}")
    try:
        temporary.write_bytes(content)
        temporary.replace(path)
    finally:
        with suppress(OSError):
            temporary.unlink()


def publish_state(run: Path, entries: Mapping[str, Any]) -> None:
    """Write ``state.json`` with ``entries`` and the name of this process. Raises ``OSError``."""
    publish(run / LIVE_STATE, to_json({"process": process_name(), **entries}).encode())


def is_asked(run: Path, request: str) -> bool:
    """Return whether the file of a request exists; links, folders and the like do not count."""
    try:
        return stat.S_ISREG((run / REQUESTS[request]).lstat().st_mode)
    except OSError:
        return False


def take_request(run: Path, request: str) -> bool:
    """Return whether the file of a request existed, and remove it.

    A request that cannot be removed does not count, because it would be carried out again and again.
    """
    return is_asked(run, request) and withdraw(run, request)


@dataclass
class Watch:
    """A watch for open pages, which touch a file: ``is_watched`` follows its modification time.

    Only changes of the time count, because the clock of another machine may differ.
    """

    run: Path
    _touched: int | None = field(default=None, init=False)  # nanoseconds
    _changed_at: float = field(default=float("-inf"), init=False)  # of the monotonic clock

    def is_watched(self) -> bool:
        """Return whether a page has touched the file within the last few seconds."""
        try:
            touched = (self.run / LIVE_WATCHED).lstat().st_mtime_ns
        except OSError:
            return False
        now = time.monotonic()
        if touched != self._touched:
            self._touched, self._changed_at = touched, now
        return now - self._changed_at < WATCHED_SECONDS


# --- what a page does ------------------------------------------------------------------------------------


def is_own_folder(run: Path) -> bool:
    """Return whether ``live/`` is a folder in the folder of the run, and not a link."""
    try:
        return stat.S_ISDIR((run / LIVE).lstat().st_mode)
    except OSError:
        return False


def touch_watched(run: Path) -> bool:
    """Touch ``live/watched``, by which a run that trains notices that a page is open.

    Return False if that is impossible. Without the folder ``live/``, nothing is written.
    """
    return is_own_folder(run) and _touch(run / LIVE_WATCHED)


def ask(run: Path, request: str) -> bool:
    """Make the file of a request. Return False if that is impossible."""
    return is_own_folder(run) and _touch(run / REQUESTS[request])


def withdraw(run: Path, request: str) -> bool:
    """Remove the file of a request. Return False if that is impossible."""
    if not is_own_folder(run):
        return False
    try:
        (run / REQUESTS[request]).unlink(missing_ok=True)
    except OSError:
        return False
    return True


def read_state(run: Path) -> dict[str, Any] | None:
    """Return the entries of ``state.json``; None if there is no such file, or if it is damaged."""
    path = run / LIVE_STATE
    if not is_own_folder(run) or path.is_symlink():
        return None
    try:
        state = parse_json(read_bytes(path, largest=LARGEST_STATE))
    except (UserError, ValueError):
        return None
    is_sound = isinstance(state, dict) and all(
        name in state and fits(state[name], kind) for name, kind in KINDS.items()
    )
    return state if is_sound else None


def _touch(path: Path) -> bool:
    """Create a file if it is missing, and set its time to now, without following a link."""
    try:
        descriptor = regular_descriptor(path, os.O_WRONLY | os.O_CREAT, follows_links=False)
        try:
            os.utime(descriptor if os.utime in os.supports_fd else path)
        finally:
            os.close(descriptor)
    except (OSError, UserError):
        return False
    return True
