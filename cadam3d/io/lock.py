"""Lock: keep a second process away from a folder, on systems with file locks.

A lock belongs to an open file and is released when the file is closed, however its process ends. The file
itself locks nothing, so one that a killed process has left behind has no effect. On Linux and macOS a child
process that inherits the open file holds the lock too. Windows does not pass locks on to children.
"""

import os
import shlex
import socket
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from cadam3d.core.errors import UserError
from cadam3d.io.reading import regular_descriptor

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None
    import msvcrt

# A process that starts another one under its lock sets this variable to the descriptor of the lock file.
INHERITED = "CADAM3D_LOCK"
# On Windows, other processes cannot read a locked byte, so the byte that is locked is far behind the text.
LOCKED_BYTE = 1 << 30
LONGEST_NOTE = 300  # bytes of a lock file that are read
LOOKING_SECONDS = 0.02  # for which :func:`is_held` may hold a lock


@contextmanager
def locked(path: Path, refusal: Callable[[str], UserError]) -> Iterator[None]:
    """Hold the lock file ``path``, with a note in it about this process.

    If another process holds the lock, raises ``refusal(holder)``, where ``holder`` describes that process.
    Raises ``UserError`` if ``path`` is not a regular file, and ``OSError`` if it cannot be opened.
    """
    file = take(path)
    if file is None:
        raise refusal(describe_holder(path))
    # Closing the file releases the lock, unless another process has passed the lock on to this one.
    with file:
        try:
            yield
        finally:
            # Otherwise the note would describe this process until the next one has written its own. If the
            # parent process has passed the lock on, it still holds it.
            if INHERITED not in os.environ:
                with suppress(OSError):
                    file.truncate(0)


def take(path: Path) -> IO[bytes] | None:
    """Lock ``path`` without waiting and return the open file, or None if another process holds the lock.

    The lock that the parent process has passed on counts as free. Raises the exceptions of :func:`locked`.
    """
    while True:
        file = _inherited(path) or _open(path)
        # Windows does not pass on the lock of the parent process, so there the variable is believed.
        is_passed_on = fcntl is None and INHERITED in os.environ
        if not is_passed_on and not try_lock(file.fileno()):
            # The function is_held may hold the lock for an instant.
            time.sleep(LOOKING_SECONDS)
            if not try_lock(file.fileno()):
                file.close()
                return None
        # A run that was refused removes its lock file, and locking a removed file has no effect.
        if _is_open_at(file, path):
            since = time.strftime("%Y-%m-%d %H:%M:%S")
            note = f"{process_name()} since {since} ({shlex.join(['cadam3d', *sys.argv[1:]])})"
            # The lock works without the note, for example on a full disk.
            with suppress(OSError):
                file.truncate(0)
                file.write(note.encode(errors="replace"))
            return file
        file.close()


def try_lock(descriptor: int) -> bool:
    """Lock an open file without waiting. Return False if another process holds its lock.

    On a file system without locks this returns True, so the work continues without protection.
    """
    try:
        if fcntl is not None:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        else:
            os.lseek(descriptor, LOCKED_BYTE, os.SEEK_SET)
            msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)  # pyright: ignore[reportAttributeAccessIssue]
    # Windows raises PermissionError.
    except (BlockingIOError, PermissionError):
        return False
    except OSError:
        pass
    return True


def unlock(descriptor: int) -> None:
    """Release the lock of an open file, even if a child process has inherited the file."""
    # A file system without locks raises OSError.
    with suppress(OSError):
        if fcntl is not None:
            fcntl.flock(descriptor, fcntl.LOCK_UN)
        else:
            os.lseek(descriptor, LOCKED_BYTE, os.SEEK_SET)
            msvcrt.locking(descriptor, msvcrt.LK_UNLCK, 1)  # pyright: ignore[reportAttributeAccessIssue]


def is_held(path: Path) -> bool:
    """Return whether a process holds the lock file ``path``.

    A process removes its note when it ends, so a file without a note is free, and only after a kill is there
    a note without a process. If there is a note, the lock is held for an instant to find out; :func:`take`
    waits for that.
    """
    if _read_note(path) is None:
        return False
    try:
        # A shared lock needs no right to write, so that other users can look too.
        with _open(path, os.O_RDWR if fcntl is None else os.O_RDONLY) as file:
            if fcntl is None:
                return not try_lock(file.fileno())
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    # Either another process holds the lock, or the file system has no locks, and then the note decides.
    except (OSError, UserError):
        return True
    return False


def process_name() -> str:
    """Return a name of this process that no other process on any machine has at the same time."""
    return f"{os.getpid()} on {socket.gethostname()}"


def holder_name(path: Path) -> str | None:
    """Return the :func:`process_name` in the note of the lock file ``path``; None without a note."""
    note = _read_note(path)
    return None if note is None else note.partition(" since ")[0]


@contextmanager
def taking_turns(folder: Path, on_wait: Callable[[], None]) -> Iterator[None]:
    """Wait until no other process holds ``folder`` in this way, and hold it while the block runs.

    The lock belongs to the folder itself, so it leaves no file. ``on_wait`` is called before a wait. Without
    locks on folders, as on Windows, or if the folder cannot be opened, the block runs at once.
    """
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except OSError:  # Windows opens no folders
        yield
        return
    try:
        if fcntl is not None and not try_lock(descriptor):
            on_wait()
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        # Closing would not release the lock if a child process had inherited the descriptor.
        unlock(descriptor)
        os.close(descriptor)


def describe_holder(path: Path) -> str:
    """Describe the process that holds the lock file ``path``, as far as its note can be read."""
    note = _read_note(path)
    return "another process" if note is None else f"process {note}"


def _read_note(path: Path) -> str | None:
    """Return the note in a lock file, in one line; None if there is none that can be read."""
    try:
        with _open(path, os.O_RDONLY) as file:
            note = file.read(LONGEST_NOTE).decode(errors="replace").strip()
    except (OSError, UserError):
        return None
    # The file may come from elsewhere, and a terminal would obey control characters.
    return "".join(letter if letter.isprintable() else "?" for letter in note) or None


def _open(path: Path, flags: int = os.O_RDWR | os.O_CREAT) -> IO[bytes]:
    """Open a lock file without changing its content, without following a link, and without waiting."""
    descriptor = regular_descriptor(path, flags, follows_links=False)
    return os.fdopen(descriptor, "r+b" if flags & os.O_RDWR else "rb", buffering=0)


def _inherited(path: Path) -> IO[bytes] | None:
    """Return the lock file that the parent process has passed on, if it is the file ``path``."""
    try:
        # Closing the copy keeps the lock, because the copy and the original are the same open file.
        file = os.fdopen(os.dup(int(os.environ[INHERITED])), "r+b", buffering=0)
    except (OSError, OverflowError, ValueError, KeyError):
        return None
    if fcntl is not None and _is_open_at(file, path):
        file.seek(0)
        return file
    file.close()
    return None


def _is_open_at(file: IO[bytes], path: Path) -> bool:
    """Return whether ``path`` is still the name of the open file."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), os.lstat(path))
    except OSError:
        return False
