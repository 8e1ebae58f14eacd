"""Lock: keep a second process away from a folder, on systems with file locks.

A lock belongs to an open file and is released when the file is closed, however its process ends. On Linux and
macOS a child process that inherits the open file holds the lock too. Windows does not pass locks on to
children.
"""

from typing import IO

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None
    import msvcrt


def try_lock(file: IO[str]) -> bool:
    """Lock an open file without waiting. Return False if another process holds its lock.

    On a file system without locks this returns True, so the work continues without protection.
    """
    try:
        if fcntl is not None:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        else:
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)  # pyright: ignore[reportAttributeAccessIssue]
    # Windows raises PermissionError.
    except (BlockingIOError, PermissionError):
        return False
    except OSError:
        pass
    return True


def unlock(file: IO[str]) -> None:
    """Release the lock of an open file, even if a child process has inherited the file."""
    try:
        if fcntl is not None:
            fcntl.flock(file, fcntl.LOCK_UN)
        else:
            msvcrt.locking(file.fileno(), msvcrt.LK_UNLCK, 1)  # pyright: ignore[reportAttributeAccessIssue]
    except OSError:  # a file system without locks
        pass
