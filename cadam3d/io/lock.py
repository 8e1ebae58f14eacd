"""Lock: keep a second process away from a folder, on file systems and machines that offer file locks.

A lock belongs to an open file and ends with it, however its process ends. On Linux and macOS a child process
that inherits the open file holds the lock too. Windows does not pass locks on to children.
"""

from typing import IO

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None
    import msvcrt


def try_lock(file: IO[str]) -> bool:
    """Lock an open file without waiting. Return False if another process holds its lock.

    A file system without locks answers with an error. Work goes on there without protection.
    """
    try:
        if fcntl is not None:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        else:
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)  # pyright: ignore[reportAttributeAccessIssue]
    except (BlockingIOError, PermissionError):  # the latter is what Windows answers
        return False
    except OSError:
        pass
    return True


def unlock(file: IO[str]) -> None:
    """Release the lock of an open file, also if a child process has inherited the file."""
    try:
        if fcntl is not None:
            fcntl.flock(file, fcntl.LOCK_UN)
        else:
            msvcrt.locking(file.fileno(), msvcrt.LK_UNLCK, 1)  # pyright: ignore[reportAttributeAccessIssue]
    except OSError:  # a file system without locks
        pass
