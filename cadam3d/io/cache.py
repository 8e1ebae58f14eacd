"""Cache: the user's folder for files that are expensive but can be made again."""

import os
import stat
from pathlib import Path

from cadam3d.core.errors import UserError

ROOT = 0  # the number of the user that may write any file


def default_cache_dir() -> Path:
    """Return ``cadam3d`` in the user's cache folder (``$XDG_CACHE_HOME``, else ``~/.cache``).

    Raises ``UserError`` if the user has no home folder, as in some containers and services.
    """
    root = os.environ.get("XDG_CACHE_HOME")
    try:
        return (Path(root) if root else Path("~/.cache").expanduser()) / "cadam3d"
    except RuntimeError as error:
        raise UserError(
            "$HOME: expected a home folder, which holds the cache of this user, got none. "
            'Try: export XDG_CACHE_HOME="$PWD/.cache"'
        ) from error


def kernels_dir(chosen: str | None) -> Path:
    """Return the folder for compiled kernels: the chosen one, else ``kernels`` in the user's cache folder.

    They are in a separate folder, because no other user may write there.
    """
    return Path(chosen).expanduser() if chosen else default_cache_dir() / "kernels"


def make_private(folder: Path) -> None:
    """Create a folder that only this user can open. A folder that exists does not change."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    folder.mkdir(mode=0o700, exist_ok=True)


def other_writers(path: Path) -> str:
    """Return why another user may have written a file or folder; "" if only this user and root can.

    Links are followed. On Windows, files have no such owners, and this returns "". Raises ``OSError``.
    """
    if not hasattr(os, "geteuid"):
        return ""
    facts = path.stat()
    if facts.st_uid not in (os.geteuid(), ROOT):
        return f"it belongs to the user with the number {facts.st_uid}"
    if facts.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        return f"its mode is {stat.S_IMODE(facts.st_mode):o}"
    return ""
