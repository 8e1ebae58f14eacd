"""Cache: the user's folder for files that are expensive but can be made again."""

import os
import stat
from pathlib import Path

# The environment variable with the folder that the jobs of a sweep share.
TRACES = "CADAM3D_TRACES"


def default_cache_dir() -> Path:
    """Return ``cadam3d`` in the user's cache folder (``$XDG_CACHE_HOME``, else ``~/.cache``)."""
    root = os.environ.get("XDG_CACHE_HOME")
    return (Path(root) if root else Path("~/.cache").expanduser()) / "cadam3d"


def make_private(folder: Path) -> None:
    """Create a folder of the cache that only this user can open. An existing folder does not change."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    folder.mkdir(mode=0o700, exist_ok=True)


def foreign(path: Path) -> str:
    """Return why another user may have written a file or folder; "" if only this user and root can.

    Links are followed. Windows has no such owners, so everything there counts as that of the user.
    """
    if not hasattr(os, "geteuid"):
        return ""
    facts = path.stat()
    if facts.st_uid not in (os.geteuid(), 0):
        return f"it belongs to another user, number {facts.st_uid}"
    if facts.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        return f"other users can write it, mode {stat.S_IMODE(facts.st_mode):o}"
    return ""
